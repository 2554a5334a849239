"""Paths, amplifiers and a level that change within a run, against filters in plain numpy that vary in time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.comparing import assert_same_run
from helpers.simulation import MAKERS, D, Integrator, S, X, constraint

from kfopc_filterpy import HardClipAmplifier, LinearAmplifier, simulate, simulate_scenarios
from kfopc_filterpy.realtime import SimulatedInterface

FS, N = 1000.0, X.size  # so a time of 0.1 is the sample 100
RNG = np.random.default_rng(3)
SECONDARY = [(0.0, S), (0.05, -0.5 * RNG.standard_normal(7)), (0.2, S[:2])]
PRIMARY = [(0.0, RNG.standard_normal(4)), (0.1, RNG.standard_normal(9))]
FEEDBACK = [(0.0, None), (0.12, np.array([0.0, 0.3])), (0.25, np.array([0.0, 0.0, 0.0, -0.3]))]
SILENT_FIRST = [(0.0, np.zeros(1)), *FEEDBACK[1:]]  # the same
AMPLIFIER = [(0.0, None), (0.15, HardClipAmplifier(0.2)), (0.25, LinearAmplifier())]
CHANGES: dict[str, Any] = {"secondary_path": SECONDARY, "primary_path": PRIMARY, "fs": FS}
ALL = CHANGES | {"feedback_path": FEEDBACK, "amplifier": AMPLIFIER}


def value_at(pairs: list[tuple[float, Any]], fade: int) -> np.ndarray:
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


def single(pairs: list[tuple[float, Any]], fade: int, signal: np.ndarray) -> np.ndarray:
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
    run = simulate(Gain(), X, crossfade_s=fade / FS, switch_on_s=on / FS, **ALL)
    y, played = (np.concatenate((np.zeros(on), part)) for part in (run.control_signal, run.amplifier_output))
    # sums of ten products of order 1
    np.testing.assert_allclose(run.disturbance, single(PRIMARY, fade, X)[on:], rtol=0, atol=1e-13)
    np.testing.assert_allclose(run.anti_noise, single(SECONDARY, fade, played)[on:], rtol=0, atol=1e-13)
    np.testing.assert_array_equal(run.error, run.disturbance - run.anti_noise)
    heard = X + single(SILENT_FIRST, fade, played)
    np.testing.assert_allclose(run.control_signal, 0.5 * heard[on:], rtol=0, atol=1e-13)
    n = np.arange(N)
    np.testing.assert_array_equal(played, np.where((n < 150) | (n >= 250), y, np.clip(y, -0.2, 0.2)))


@pytest.mark.parametrize("fade_s", [0.0, 0.02])
@pytest.mark.parametrize("name", MAKERS)
def test_the_compiled_loop_gives_the_same_bits(name: str, fade_s: float) -> None:
    options = ALL | {"crossfade_s": fade_s, "sensor_noise_std": 0.1, "rng": 1, "noise_level_db": [(0, 0.0), (0.1, 6.0)]}
    own = {"constraint": constraint(fs=FS)} if name in ("KF-OPC", "MOV-FxLMS") else {}
    one, other = (simulate(MAKERS[name](**own), X, compiled=compiled, **options) for compiled in (True, False))
    assert_same_run(one, other)


def test_several_channels_change_too() -> None:
    rng = np.random.default_rng(4)
    references = rng.standard_normal((2, N))
    primary = [(0.0, rng.standard_normal((3, 2, 6))), (0.1, rng.standard_normal((3, 2, 9)))]
    secondary = [(0.0, rng.standard_normal((3, 2, 5))), (0.05, rng.standard_normal((3, 2, 3)))]
    feedback = [(0.0, np.zeros((2, 2, 4))), (0.2, 0.2 * rng.standard_normal((2, 2, 3)))]
    feedback[1][1][:, :, 0] = 0.0
    paths: dict[str, Any] = {"secondary_path": secondary, "primary_path": primary, "feedback_path": feedback}
    amplifiers: Any = [(0.0, [np.tanh, None]), (0.1, [None, np.tanh])]
    run = simulate(Gain(), references, fs=FS, crossfade_s=0.05, amplifier=amplifiers, **paths)
    y = run.control_signal
    np.testing.assert_allclose(run.disturbance, through(value_at(primary, 50), references), rtol=0, atol=1e-12)
    np.testing.assert_allclose(run.anti_noise, through(value_at(secondary, 50), run.amplifier_output), atol=1e-12)
    heard = references + through(value_at(feedback, 50), run.amplifier_output)
    np.testing.assert_allclose(y, 0.5 * heard, rtol=0, atol=1e-12)
    saturated = np.array([np.arange(N) < 100, np.arange(N) >= 100])
    np.testing.assert_allclose(run.amplifier_output, np.where(saturated, np.tanh(y), y), rtol=1e-15)


def test_what_has_one_entry_stays() -> None:
    plain: dict[str, Any] = {"secondary_path": S, "primary_path": [0.0, 1.0], "feedback_path": [0.0, 0.1]}
    paired = {name: [(0.0, value)] for name, value in plain.items()}
    one = simulate(MAKERS["KF-OPC"](), X, amplifier=[(0, HardClipAmplifier(0.4))], crossfade_s=1.0, **paired)
    assert_same_run(one, simulate(MAKERS["KF-OPC"](), X, amplifier=HardClipAmplifier(0.4), **plain))


@pytest.mark.parametrize("fade", [0, 40])
def test_a_level_is_that_of_reference_and_disturbance(fade: int) -> None:
    levels = [(0.0, -6.0), (0.1, 20.0), (0.2, 0.0)]
    run = simulate(
        Gain(), X, noise_level_db=levels, crossfade_s=fade / FS, primary_path=[0.0, 1.0], secondary_path=S, fs=FS
    )
    gains = [(time, [10 ** (level / 20)]) for time, level in levels]
    np.testing.assert_allclose(run.reference, X * value_at(gains, fade)[:, 0], rtol=1e-14)
    np.testing.assert_allclose(run.disturbance[1:], run.reference[:-1], rtol=1e-14)
    np.testing.assert_array_equal(simulate(Gain(), X, noise_level_db=-20, **CHANGES).reference, X * 10**-1.0)


def test_scenarios_may_have_a_primary_path_that_changes() -> None:
    plant: dict[str, Any] = {"secondary_path": S, "primary_path": PRIMARY, "fs": FS}
    (run,) = simulate_scenarios([MAKERS["KF-ANC"]()], X, **plant)
    np.testing.assert_array_equal(run.error, simulate(MAKERS["KF-ANC"](), X, **plant).error)


@pytest.mark.parametrize("fade", [0, 20])
def test_a_simulated_interface_is_that_plant_and_changes_too(fade: int) -> None:
    """The blocks end between two changes, and in the midst of a cross-fade."""
    paths: dict[str, Any] = {"primary_path": PRIMARY, "feedback_path": SILENT_FIRST, "crossfade_s": fade / FS}
    others: dict[str, Any] = {"amplifier": HardClipAmplifier(0.8), "sensor_noise_std": 0.1, "rng": 3}
    plant = SimulatedInterface(X, SECONDARY, fs=FS, block=12, latency=24, **paths, **others)
    y = np.random.default_rng(5).standard_normal(N)
    blocks = []
    while (block := plant.read()) is not None:
        plant.write(y[np.newaxis, 12 * len(blocks) : 12 * len(blocks) + 12])
        blocks.append(block)
    played = np.concatenate((np.zeros(24), np.clip(y[:-24], -0.8, 0.8)))
    found = [np.concatenate([getattr(block, name)[0] for block in blocks]) for name in ("references", "errors")]
    np.testing.assert_allclose(found[0], X + single(SILENT_FIRST, fade, played), rtol=0, atol=1e-13)
    expected = single(PRIMARY, fade, X) - single(SECONDARY, fade, played)
    expected += 0.1 * np.random.default_rng(3).standard_normal(N)
    np.testing.assert_allclose(found[1], expected, rtol=0, atol=1e-13)


REFUSED = [
    ({"secondary_path": [(0.1, S), (0.2, S)]}, "secondary_path must begin with a value for the time 0 s, got"),
    ({"secondary_path": [(0.0, S), (0.2, S), (0.2, S)]}, "secondary_path must have times that rise"),
    ({"secondary_path": [(0.0, S), (0.3, S)]}, r"within the run of 0.3 s, got \[0.0, 0.3\]"),
    ({"secondary_path": [(S, 0.0), (S, 0.1)]}, "a time of secondary_path must be a single number in s"),
    ({"secondary_path": [(0.0, S), S]}, r"secondary_path must be one value, or a list of pairs \(time in s, value\)"),
    ({"secondary_path": (0.1, S)}, "secondary_path must be one value, .* nor a pair without a list around it"),
    ({"secondary_path": [(0.0, [[S]]), (0.1, [[S], [S]])]}, r"same numbers of channels .* \(1, 1, 3\) and \(2, 1, 3\)"),
    ({"feedback_path": [(0.0, None), (0.1, [1.0, 1.0])]}, "feedback_path must have a delay"),
    ({"amplifier": [(0.0, None), (0.1, "loud")]}, "amplifier must be a function of a sample"),
    ({"crossfade_s": 0.152, "secondary_path": SECONDARY}, "crossfade_s must be at most 0.15 s, the shortest time"),
    ({"crossfade_s": 1e308, "primary_path": PRIMARY}, "crossfade_s must be at most 0.3 s, .* length of the run"),
    ({"noise_level_db": 1e300}, "noise_level_db must be within 400 dB of 0 dB"),
    ({"noise_level_db": 6.0, "primary_path": None, "disturbance": D}, "noise_level_db needs primary_path="),
]


@pytest.mark.parametrize(("changed", "match"), REFUSED, ids=range(len(REFUSED)))
def test_schedules_that_make_no_sense_are_refused(changed: dict[str, Any], match: str) -> None:
    controller = Integrator()
    with pytest.raises((ValueError, TypeError), match=match):
        simulate(controller, X, **{"secondary_path": S, "primary_path": [1.0], "fs": FS} | changed)
    assert controller.gain == 0.0


@pytest.mark.parametrize("changed", [{"secondary_path": SECONDARY}, {"amplifier": AMPLIFIER}])
def test_scenarios_refuse_other_changes(changed: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(changed))} must stay the same for scenarios: use simulate"):
        simulate_scenarios([MAKERS["KF-ANC"]()], X, **{"secondary_path": S, "disturbance": D, "fs": FS} | changed)
