"""Plants that change within a run, against filters in plain numpy that vary in time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.comparing import assert_same_run
from helpers.simulation import MAKERS, D, Integrator, S, Stepwise, X, constraint

from kfopc_filterpy import HardClipAmplifier, LinearAmplifier, Plant, simulate
from kfopc_filterpy.realtime import SimulatedInterface

FS, N = 1000.0, X.size  # so a time of 0.1 is the sample 100
RNG = np.random.default_rng(3)
Pairs = list[tuple[float, Any]]
SECONDARY: Pairs = [(0.0, S), (0.05, -0.5 * RNG.standard_normal(7)), (0.2, S[:2])]
PRIMARY: Pairs = [(0.0, RNG.standard_normal(4)), (0.1, RNG.standard_normal(9))]
FEEDBACK: Pairs = [(0.0, np.zeros(1)), (0.12, np.array([0.0, 0.3])), (0.25, np.array([0.0, 0.0, 0.0, -0.3]))]
AMPLIFIER: Pairs = [(0.0, None), (0.15, HardClipAmplifier(0.2)), (0.25, LinearAmplifier())]


def changing(fade_s: float = 0.0, sensor_noise_std: float = 0.0, **pairs: Pairs) -> Plant:
    """Return a plant with the changes of pairs (time, value), by the names of what changes."""
    begin = {name: values[0][1] for name, values in pairs.items()}
    plant = Plant(**begin, fs=FS, sensor_noise_std=sensor_noise_std)
    changes = sorted(
        ((time, name, value) for name, values in pairs.items() for time, value in values[1:]), key=lambda c: c[:2]
    )
    for time, name, value in changes:
        plant = plant.changed_at(time, **{name: value}, crossfade_s=fade_s)
    return plant


def everything(fade_s: float, sensor_noise_std: float = 0.0) -> Plant:
    return changing(
        fade_s, sensor_noise_std, secondary=SECONDARY, primary=PRIMARY, feedback=FEEDBACK, amplifier=AMPLIFIER
    )


def value_at(pairs: Pairs, fade: int) -> np.ndarray:
    """Return a value that is an array in each sample, (N, ...): knots, and straight lines between them."""
    longest = max(np.shape(value)[-1] for _, value in pairs)
    values = np.array(
        [np.pad(v, [(0, 0)] * (np.ndim(v) - 1) + [(0, longest - np.shape(v)[-1])]) for _, v in pairs], dtype=float
    )
    knots = [knot for time, _ in pairs[1:] for knot in (time * FS, time * FS + max(fade, 1e-6))]
    index = np.interp(np.arange(N) + (0.0 if fade else 2e-6), knots, np.repeat(np.arange(len(pairs)), 2)[1:-1])
    low, part = np.floor(index).astype(int), (index % 1).reshape(-1, *[1] * (values.ndim - 1))
    return (1 - part) * values[low] + part * values[np.minimum(low + 1, len(pairs) - 1)]


def through(taps: np.ndarray, signals: np.ndarray) -> np.ndarray:
    """Return signals (I, N) after taps (N, K, I, n) that are others in each sample, (K, N)."""
    out = np.zeros((taps.shape[1], N))
    for n in range(N):
        for m in range(min(taps.shape[3], n + 1)):
            out[:, n] += taps[n, :, :, m] @ signals[:, n - m]
    return out


def single(pairs: Pairs, fade: int, signal: np.ndarray) -> np.ndarray:
    return through(value_at(pairs, fade)[:, np.newaxis, np.newaxis], signal[np.newaxis])[0]


class Gain:
    """A controller that plays half of what it hears, of one channel or of several."""

    def control_signal(self, reference: Any) -> Any:
        return 0.5 * reference

    def update(self, error: Any) -> None:
        pass

    def listen(self, references: Any, errors: Any) -> None:
        pass


# `on` is the first sample with control: the times count from the start of the reference.
@pytest.mark.parametrize("on", [0, 60])
@pytest.mark.parametrize("fade", [0, 20, 130])  # the last is all the time between two changes of the feedback
def test_everything_changes_as_in_plain_numpy(fade: int, on: int) -> None:
    run = simulate(Gain(), X, everything(fade / FS), switch_on_s=on / FS)
    y, played = (np.concatenate((np.zeros(on), part)) for part in (run.control_signal, run.amplifier_output))
    # sums of ten products of order 1
    np.testing.assert_allclose(run.disturbance, single(PRIMARY, fade, X)[on:], rtol=0, atol=1e-13)
    np.testing.assert_allclose(run.anti_noise, single(SECONDARY, fade, played)[on:], rtol=0, atol=1e-13)
    np.testing.assert_array_equal(run.error, run.disturbance - run.anti_noise)
    heard = X + single(FEEDBACK, fade, played)
    np.testing.assert_allclose(run.control_signal, 0.5 * heard[on:], rtol=0, atol=1e-13)
    n = np.arange(N)
    np.testing.assert_array_equal(played, np.where((n < 150) | (n >= 250), y, np.clip(y, -0.2, 0.2)))


@pytest.mark.parametrize("fade_s", [0.0, 0.02])
@pytest.mark.parametrize("name", MAKERS)
def test_the_compiled_loop_gives_the_same_bits(name: str, fade_s: float) -> None:
    own = {"constraint": constraint(fs=FS)} if name in ("KF-OPC", "MOV-FxLMS") else {}
    plant = everything(fade_s, sensor_noise_std=0.1)
    assert_same_run(
        simulate(MAKERS[name](**own), X, plant, rng=1), simulate(Stepwise(MAKERS[name](**own)), X, plant, rng=1)
    )


def test_several_channels_change_too() -> None:
    rng = np.random.default_rng(4)
    references = rng.standard_normal((2, N))
    primary = [(0.0, rng.standard_normal((3, 2, 6))), (0.1, rng.standard_normal((3, 2, 9)))]
    secondary = [(0.0, rng.standard_normal((3, 2, 5))), (0.05, rng.standard_normal((3, 2, 3)))]
    feedback = [(0.0, np.zeros((2, 2, 4))), (0.2, 0.2 * rng.standard_normal((2, 2, 3)))]
    feedback[1][1][:, :, 0] = 0.0
    amplifiers: Any = [(0.0, [np.tanh, None]), (0.1, [None, np.tanh])]
    plant = changing(0.05, secondary=secondary, primary=primary, feedback=feedback, amplifier=amplifiers)
    run = simulate(Gain(), references, plant)
    y = run.control_signal
    np.testing.assert_allclose(run.disturbance, through(value_at(primary, 50), references), rtol=0, atol=1e-12)
    np.testing.assert_allclose(run.anti_noise, through(value_at(secondary, 50), run.amplifier_output), atol=1e-12)
    heard = references + through(value_at(feedback, 50), run.amplifier_output)
    np.testing.assert_allclose(y, 0.5 * heard, rtol=0, atol=1e-12)
    saturated = np.array([np.arange(N) < 100, np.arange(N) >= 100])
    np.testing.assert_allclose(run.amplifier_output, np.where(saturated, np.tanh(y), y), rtol=1e-15)


@pytest.mark.parametrize("fade", [0, 20])
def test_a_simulated_interface_is_that_plant_and_changes_too(fade: int) -> None:
    """The blocks end between two changes, and in the midst of a cross-fade; the amplifier changes within a block."""
    plant = changing(
        fade / FS,
        0.1,
        secondary=SECONDARY,
        primary=PRIMARY,
        feedback=FEEDBACK,
        amplifier=[(0.0, lambda y: max(-0.8, min(y, 0.8))), (0.149, HardClipAmplifier(0.4))],  # the first of a sample
    )
    interface = SimulatedInterface(X, plant, block=12, latency=24, rng=3)
    y = np.random.default_rng(5).standard_normal(N)
    blocks = []
    while (block := interface.read()) is not None:
        interface.write(y[np.newaxis, 12 * len(blocks) : 12 * len(blocks) + 12])
        blocks.append(block)
    limit = np.where(np.arange(N) < 149, 0.8, 0.4)
    played = np.clip(np.concatenate((np.zeros(24), y[:-24])), -limit, limit)
    found = [np.concatenate([getattr(block, name)[0] for block in blocks]) for name in ("references", "errors")]
    np.testing.assert_allclose(found[0], X + single(FEEDBACK, fade, played), rtol=0, atol=1e-13)
    expected = single(PRIMARY, fade, X) - single(SECONDARY, fade, played)
    expected += 0.1 * np.random.default_rng(3).standard_normal(N)
    np.testing.assert_allclose(found[1], expected, rtol=0, atol=1e-13)


def test_the_plant_of_a_time_is_the_last_change_that_began() -> None:
    plant = everything(0.02)
    assert plant.changes
    assert not plant.at(0.26).changes
    np.testing.assert_array_equal(plant.at(0.0).secondary[0, 0], S)
    np.testing.assert_array_equal(plant.at(0.26).secondary[0, 0], S[:2])
    assert plant.at(0.2).amplifiers == (HardClipAmplifier(0.2),)


REFUSED = [
    ({"at": 0.0, "secondary": S}, "time_s must be greater than 0 s"),
    ({"at": 0.2}, "give what changes"),
    (
        {"at": 0.1, "secondary": S},
        "time_s must be 0.15 s at least, got 0.1 s: by then the last change of secondary has ended",
    ),
    ({"at": 0.04, "primary": S}, "time_s must not be before the last change, at 0.05 s, got 0.04 s: chain"),
    ({"at": 0.2, "secondary": [[S], [S]]}, r"secondary must keep its channels .* \(1, 1\), got taps \(2, 1, 3\)"),
    ({"at": 0.2, "secondary": [[S, S]]}, r"secondary must keep its channels .* \(1, 1\), got taps \(1, 2, 3\)"),
    ({"at": 0.2, "feedback": [1.0, 1.0]}, "feedback must have a delay"),
    ({"at": 0.2, "amplifier": "loud"}, "amplifier must be a function of a sample"),
    ({"at": 0.2, "primary": [1.0]}, "primary cannot appear during a run"),
    ({"at": 0.2, "secondary": S, "crossfade_s": -1.0}, "crossfade_s must not be negative"),
]


@pytest.mark.parametrize(("change", "match"), REFUSED, ids=range(len(REFUSED)))
def test_changes_that_make_no_sense_are_refused(change: dict[str, Any], match: str) -> None:
    plant = Plant(S, fs=FS).changed_at(0.05, secondary=-S, crossfade_s=0.1)
    with pytest.raises((ValueError, TypeError), match=match):
        plant.changed_at(change.pop("at"), **change)


def test_a_change_after_the_end_of_a_run_is_refused_and_nothing_has_changed() -> None:
    controller = Integrator()
    with pytest.raises(ValueError, match=r"the plant changes 0.3 s after the start, but the run has only 0.3 s"):
        simulate(controller, X, Plant(S, fs=FS).changed_at(0.3, secondary=-S), disturbance=D)
    assert controller.gain == 0.0
