"""The LMS family with several channels: against one channel, on odd systems, and where it settles."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import control
import numpy as np
import pytest
from helpers.comparing import assert_same_run

from kfopc_filterpy import (
    FxLMS,
    FxNLMS,
    HardClipAmplifier,
    LeakyFxLMS,
    MOVFxLMS,
    TwoGradientFxLMS,
    output_power,
    simulate,
)

K, J, I, L = 3, 2, 2, 5  # microphones, loudspeakers, references, taps  # noqa: E741
FS = 16000.0
MU = 0.01
_rng = np.random.default_rng(5)
PATHS = np.zeros((K, J, 6))  # true secondary paths
PATHS[:, :, 1:5] = _rng.standard_normal((K, J, 4)) * [0.8, 0.5, 0.3, 0.2]
ESTIMATE = 0.9 * PATHS[:, :, :4]  # what the controllers know of them
PRIMARY = _rng.standard_normal((K, I, 7)) * 0.5


def noise(n: int = 400, n_references: int = I) -> np.ndarray:
    return np.random.default_rng(3).standard_normal((n_references, n))


def fxlms(path: Any = ESTIMATE) -> FxLMS:
    return FxLMS(L, path, step_size=MU, n_references=I)


def run(controller: Any, x: np.ndarray) -> Any:
    return simulate(controller, x, primary_path=PRIMARY, secondary_path=PATHS, fs=FS)


# ---- One channel


ONE_PATH = np.array([0.0, 0.7, -0.25, 0.1])
ONE: dict[str, Callable[..., Any]] = {
    "FxLMS": lambda path, **o: FxLMS(L, path, step_size=MU, **o),
    "FxNLMS": lambda path, **o: FxNLMS(L, path, step_size=10 * MU, **o),
    "leaky FxLMS": lambda path, **o: LeakyFxLMS(L, path, step_size=MU, leak=0.4, **o),
    "MOV-FxLMS": lambda path, **o: MOVFxLMS(L, path, step_size=MU, rated_power=0.4, **o),
    "two-gradient FxLMS": lambda path, **o: TwoGradientFxLMS(L, path, step_size=MU, amplitude_limit=0.3, **o),
}


@pytest.mark.parametrize(("name", "loudspeakers"), [*((name, 2) for name in ONE), ("FxLMS", 1)])
def test_one_loudspeaker_is_the_single_channel_bit_for_bit(name: str, loudspeakers: int) -> None:
    """A second one, which is not heard, changes nothing."""
    x, other = noise(300)
    d = np.convolve(x, [0.0, 0.0, 1.2, 0.5])[:300] + 0.1 * other
    paths = np.stack([ONE_PATH, 0.0 * ONE_PATH])[np.newaxis, :loudspeakers]
    single, many = ONE[name](ONE_PATH), ONE[name](paths)
    options: dict[str, Any] = {
        "fs": FS,
        "amplifier": HardClipAmplifier(0.5),
        "switch_on_s": 30 / FS,
        "record_weights_every": 5,
    }
    want = simulate(single, x, disturbance=d, secondary_path=ONE_PATH, **options)
    got = simulate(many, x[np.newaxis], disturbance=d[np.newaxis], secondary_path=paths, **options)
    for signal in ("error", "control_signal", "amplifier_output", "anti_noise", "constraint_factor"):
        np.testing.assert_array_equal(getattr(got, signal)[0], getattr(want, signal), err_msg=signal)
    np.testing.assert_array_equal(got.control_signal[1:], 0.0)
    np.testing.assert_array_equal(got.weights[:, 0, 0], want.weights)
    for attribute in ("weights", "disturbance_power", "secondary_path_gain", "constraint_factor"):
        one = np.asarray(getattr(many, attribute))[0]
        np.testing.assert_array_equal(one.reshape(np.shape(getattr(single, attribute))), getattr(single, attribute))
    assert got.algorithm == want.algorithm


# ---- Where it settles


def test_a_normalised_step_does_not_depend_on_the_level_and_is_stable_up_to_2() -> None:
    """On paths without delay, where the error power cannot grow within a step that is below 2, and does above."""
    flat = np.random.default_rng(8).standard_normal((K, J, 1)) * np.eye(1, 3)
    x, level = noise(3000), np.repeat([1.0, 30.0], 1500)
    d = np.einsum("kj,ji,in->kn", flat[:, :, 0], [[0.5, 0.2], [-0.3, 0.4]], x)
    errors = []
    for mu in (0.5, 1.9, 2.5):
        controller = FxNLMS(1, flat, step_size=mu, n_references=I)
        errors.append(simulate(controller, level * x, disturbance=level * d, secondary_path=flat, fs=FS).error)
    for error in errors[:2]:
        assert np.mean(error[:, -200:] ** 2) < 1e-6 * np.mean(d[:, -200:] ** 2)  # loud or soft
    assert np.nanmax(np.abs(errors[2])) > 10.0 * np.abs(level * d).max()


def test_every_loudspeaker_keeps_its_rated_power() -> None:
    """MOV-FxLMS counts on each loudspeaker alone: what they need together is less."""
    x = noise(40_000)
    free = run(FxLMS(L, PATHS, step_size=2e-3, n_references=I), x)
    wanted = output_power(free.control_signal[:, 20_000:])
    rated = 0.25 * wanted
    assert np.all(wanted > 2.0 * rated)
    result = run(MOVFxLMS(L, PATHS, step_size=2e-3, rated_power=rated, n_references=I), x)
    powers = output_power(result.control_signal[:, 20_000:])
    assert np.all(powers < rated)
    assert np.all(powers > 0.05 * rated)
    assert result.rated_power.tolist() == rated.tolist()
    factor = result.constraint_factor
    assert factor.shape == (J, 40_000)
    assert np.all(factor[:, 20_000:] < 1.0)
    assert factor[0, -1] != factor[1, -1]


# ---- Odd systems


def test_a_matrix_of_systems_is_a_secondary_path() -> None:
    systems = [[control.TransferFunction(row, [1.0, 0.0, 0.0, 0.0], 1 / FS) for row in rows] for rows in ESTIMATE]
    controller = fxlms(systems)
    got, want = run(controller, noise(100)), run(fxlms(), noise(100))
    np.testing.assert_allclose(got.error, want.error, rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match="fs is 500 Hz but the controller's secondary path is for 16000 Hz"):
        simulate(controller, noise(100), primary_path=PRIMARY, secondary_path=PATHS, fs=500.0)


def test_several_references_need_no_channel_axes() -> None:
    one = FxLMS(L, ONE_PATH, step_size=MU, n_references=2)
    assert one.weights.shape == (1, 2, L)
    assert repr(one) == "<FxLMS: 1 microphone, 1 loudspeaker, 2 references, 5 taps, constraint factor 1>"
    assert one.control_signal([1.0, 2.0]).shape == (1,)


# ---- Refusals


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda c: c.update([0.1, 0.2]), "error must have a value for each of the 3 microphones, got 2"),
        (lambda c: c.control_signal(1.0), "reference must have a value for each of the 2 references, got 1"),
        (
            lambda c: c.listen(np.ones((1, 9)), np.ones((3, 9))),
            r"references must be \(2, n_samples\) for this controller",
        ),
        (lambda c: c.listen(np.ones((2, 9)), np.ones((3, 8))), "the same number of samples, got 9 and 8"),
        (lambda c: run(c, noise(9, 1)), r"I = 1 of reference"),
        (
            lambda c: simulate(c, noise(9), disturbance=np.ones((2, 9)), secondary_path=PATHS[:2], fs=FS),
            "made for 3 microphones, but reference and paths of the run have 2",
        ),
    ],
    ids=range(6),
)
def test_signals_that_do_not_fit_are_refused_with_nothing_changed(call: Callable[[Any], Any], message: str) -> None:
    refusing, twin = fxlms(), fxlms()
    for one in (refusing, twin):
        run(one, noise(20))
    with pytest.raises(ValueError, match=message):
        call(refusing)
    assert_same_run(run(refusing, noise(20)), run(twin, noise(20)))


def test_one_channel_refuses_arrays_and_several_channels_need_paths_with_axes() -> None:
    with pytest.raises(TypeError, match="error must be a single number"):
        FxLMS(L, ONE_PATH, step_size=MU).update([1.0, 2.0])
    with pytest.raises(ValueError, match="controller has one channel: give it secondary paths"):
        run(FxLMS(L, ONE_PATH, step_size=MU), noise(9))
