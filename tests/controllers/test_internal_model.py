"""Feedback and hybrid control: against plain numpy, feedforward control of the same noise, and closed forms."""

from __future__ import annotations

import pickle
from typing import Any
from unittest import mock

import numpy as np
import pytest
from helpers.controllers import KALMAN, MANY, PATHS, SEVERAL, VARIANTS, K, constraint, made
from helpers.loop import AMPLIFIERS, FS, MU, N_TAPS, S_HAT, N, S, noises
from scipy.signal import lfilter

from kfopc_filterpy import KFOPC, KalmanController, Plant, fx_lms, kf_anc, kf_opc, kf_pb, simulate
from kfopc_filterpy.bounds import power_constrained_solution, predictor_reference, wiener_solution
from kfopc_filterpy.checkpoint import content_of
from kfopc_filterpy.controllers import FeedbackNeutralizer, RefusedUpdate, VirtualMicrophones, with_internal_model
from kfopc_filterpy.realtime import Supervisor

D = noises()[1]
POLE, DELAY, GAIN = 0.95, 3, 0.8
PURE_DELAY = GAIN * np.eye(DELAY + 1)[DELAY]


def ar1(n: int = 60_000) -> np.ndarray:
    """An AR(1) disturbance of power 1 that has begun long ago."""
    noise = np.random.default_rng(0).standard_normal(n + 500)
    return np.sqrt(1 - POLE**2) * lfilter([1.0], [1.0, -POLE], noise)[500:]


def past(signal: np.ndarray, n: int, taps: int) -> np.ndarray:
    """Return the newest samples up to n of a signal, newest first, and zeros before its first one."""
    return np.pad(signal[max(n - taps + 1, 0) : n + 1][::-1], (0, max(taps - n - 1, 0)))


def own_filter(**_: Any) -> KalmanController:
    """A controller around an estimator of filterpy, whose steps are in Python."""
    return KalmanController(KFOPC.random_walk(N_TAPS, constraint=constraint(), **KALMAN), S_HAT)


def test_the_loop_is_that_of_ten_lines_of_numpy() -> None:
    """With a path that is not exact and an amplifier that saturates; 1e-12 is the order of the additions."""
    amplifier, saturated = AMPLIFIERS["soft"]
    result = simulate(
        with_internal_model(fx_lms(N_TAPS, S_HAT, step_size=MU)),
        None,
        Plant(S, amplifier=amplifier, fs=FS),
        disturbance=D,
    )
    x, filtered, y, amplified, e, w = *np.zeros((5, N)), np.zeros(N_TAPS)
    for n in range(N):
        if n:
            x[n] = e[n - 1] + S_HAT @ past(y, n - 1, S_HAT.size)
        filtered[n] = S_HAT @ past(x, n, S_HAT.size)
        y[n] = w @ past(x, n, N_TAPS)
        amplified[n] = saturated(y[n])
        e[n] = D[n] - S @ past(amplified, n, S.size)
        w = w + MU * e[n] * past(filtered, n, N_TAPS)
    np.testing.assert_allclose(result.error, e, rtol=0, atol=1e-12 * np.abs(D).max())
    assert np.mean(y**2) > 0.1


@pytest.mark.parametrize(("name", "variant"), [*VARIANTS, ("filterpy's", "plain")])
def test_with_an_exact_path_it_is_feedforward_control_of_the_noise_a_sample_late(name: str, variant: str) -> None:
    """Every algorithm, behind a limiter and with a known amplifier; d^ = (d - s*y) + s^*y is d to rounding."""
    one, other = (own_filter() if name == "filterpy's" else made(name, variant) for _ in range(2))
    amplifier = AMPLIFIERS["soft"][0] if variant == "known amplifier" else None
    plant = Plant(S_HAT, amplifier=amplifier, fs=FS)
    options: dict[str, Any] = {"disturbance": D, "switch_on_s": 20 / FS}
    feedback = simulate(with_internal_model(one), None, plant, **options)
    forward = simulate(other, predictor_reference(D), plant, **options)
    atol = 1e-9 * np.abs(D).max()
    np.testing.assert_allclose(feedback.error, forward.error, rtol=0, atol=atol)
    assert np.abs(feedback.control_signal).max() > 0.01
    assert feedback.reference.shape == (0, N - 20)


@pytest.mark.parametrize("name", SEVERAL)
def test_so_it_is_with_several_channels_and_reference_microphones(name: str) -> None:
    """Two references of microphones, then the disturbances of K error microphones.

    KF-PB's steps of conjugate gradients multiply what is rounded by the condition of the data, 1e3 or more.
    """
    rng = np.random.default_rng(1)
    x, d = 0.5 * rng.standard_normal((2, 300)), np.cumsum(rng.standard_normal((K, 300)), axis=1) / 20
    with mock.patch.dict(MANY, n_references=2 + K):
        one, other = SEVERAL[name](), SEVERAL[name]()
    plant = Plant(PATHS, fs=FS)
    hybrid = simulate(with_internal_model(one), x, plant, disturbance=d)
    forward = simulate(other, np.concatenate((x, predictor_reference(d))), plant, disturbance=d)
    assert forward.diverged_at_s is None
    rounded = 1e-6 if name == "kf_pb" else 1e-9
    np.testing.assert_allclose(hybrid.error, forward.error, rtol=0, atol=rounded * np.abs(d).max())
    assert np.any(hybrid.control_signal)


# Closed forms: an AR(1) disturbance of power 1 with the pole a, and a path g z^-D. The predictor over D + 1 samples is
# a^(D + 1) d(n - 1), and leaves 1 - a^(2 D + 2) of the power.

KEPT = POLE ** (DELAY + 1)


def left_by(weight: float) -> float:
    """The power that is left by y = w d^(n - 1)."""
    return 1 - 2 * weight * GAIN * KEPT + (weight * GAIN) ** 2


@pytest.fixture(scope="module")
def disturbance() -> np.ndarray:
    return ar1()


def settled(controller: Any, d: np.ndarray) -> tuple[float, float]:
    """Return the powers of error and control signal over the second half of a run, those of d being 1."""
    result = simulate(with_internal_model(controller), None, Plant(PURE_DELAY, fs=FS), disturbance=d)
    half = slice(d.size // 2, None)
    power = np.mean(d[half] ** 2)
    return float(np.mean(result.error[half] ** 2) / power), float(np.mean(result.control_signal[half] ** 2) / power)


# 30,000 samples of a noise that is correlated over 40 samples: its power, and the sums above, scatter by 4 %.
SCATTER = 0.04


def test_the_bound_and_the_settled_controller_are_the_best_predictor(disturbance: np.ndarray) -> None:
    bound = wiener_solution(
        predictor_reference(disturbance), Plant(PURE_DELAY, fs=FS), n_taps=8, disturbance=disturbance
    )
    assert bound.error_power / bound.disturbance_power == pytest.approx(left_by(KEPT / GAIN), abs=SCATTER)
    np.testing.assert_allclose(bound.weights, np.eye(8)[0] * KEPT / GAIN, rtol=0, atol=0.05)
    kalman = kf_anc(8, PURE_DELAY, state_noise=1e-12, measurement_noise=0.3)
    error, power = settled(kalman, disturbance)
    assert error == pytest.approx(left_by(KEPT / GAIN), abs=SCATTER)
    assert power == pytest.approx((KEPT / GAIN) ** 2, rel=SCATTER)
    assert error >= bound.error_power / bound.disturbance_power - 0.01  # the bound is over both halves


@pytest.mark.parametrize("rated", [0.05, 0.3])
def test_within_a_rated_power_kf_pb_reaches_the_bound_and_kf_opc_its_scaled_filter(
    disturbance: np.ndarray, rated: float
) -> None:
    """The bound takes w = sqrt(rho) d^(n - 1). KF-OPC scales the predictor by alpha, made for full cancellation."""
    bound = power_constrained_solution(
        predictor_reference(disturbance), Plant(PURE_DELAY, fs=FS), n_taps=8, rated_power=rated, disturbance=disturbance
    )
    assert bound.control_power == pytest.approx(rated, rel=1e-3)
    assert bound.error_power / bound.disturbance_power == pytest.approx(left_by(np.sqrt(rated)), abs=SCATTER)
    error, power = settled(kf_pb(8, PURE_DELAY, rated_power=rated, fs=FS, averaging_s=1.0), disturbance)
    assert power <= 1.02 * rated
    assert error == pytest.approx(left_by(np.sqrt(rated)), abs=SCATTER)
    alpha = np.sqrt(rated) * GAIN  # sqrt(rho G_s / E[d^2])
    opc = kf_opc(8, PURE_DELAY, rated_power=rated, state_noise=1e-12, measurement_noise=0.3, fs=FS)
    error, power = settled(opc, disturbance)
    assert power == pytest.approx(rated * KEPT**2, rel=0.1)  # alpha follows the power of the noise, in 0.5 s
    assert error == pytest.approx(left_by(alpha * KEPT / GAIN), abs=SCATTER)


# Samples that do not arrive.


def test_a_refused_error_leaves_the_state_and_one_that_never_comes_counts_as_silence() -> None:
    controller = with_internal_model(kf_opc(N_TAPS, S_HAT, rated_power=0.3, fs=FS, **KALMAN))
    run_before = simulate(controller, None, Plant(S_HAT, fs=FS), disturbance=D)
    played = np.append(run_before.control_signal, controller.control_signal(None))
    before = content_of(controller)
    for bad in (np.nan, np.inf, 1e30, 1e160, "a"):
        for step in (controller.update, controller.take_error):
            with pytest.raises((ValueError, TypeError)):
                step(bad)
    assert content_of(controller) == before
    twin = pickle.loads(pickle.dumps(controller))
    estimate = 0.3 + S_HAT @ past(played, played.size - 1, S_HAT.size)
    twin.take_error(0.3)  # now its reference is d^, and the other's is 0
    difference = twin.control_signal(None) - controller.control_signal(None)
    assert difference == pytest.approx(estimate * controller.weights[0], rel=1e-9)
    with pytest.raises(RefusedUpdate, match="1e20 with an internal model") as refused:
        controller.process(None, [0.1, 1e30, 0.1], adapt=False)
    assert refused.value.sample == 1


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda f: f.control_signal(1.0), "reference must be None"),
        (lambda f: f.process([1.0], [1.0]), "reference must be None"),
        (lambda f: f.listen([1.0], [1.0]), "reference must be None"),
        (lambda f: simulate(f, D, Plant(S, fs=FS), disturbance=D), "reference must be None"),
        (lambda f: simulate(f, None, Plant(S, [1.0], fs=FS)), "without a reference give disturbance="),
        (with_internal_model, "has an internal model"),
        (lambda f: with_internal_model(fx_lms(4, PATHS, step_size=MU, n_references=K - 1)), "for each of the 3 error"),
        (lambda f: FeedbackNeutralizer(f, [0.0, 1.0]), "n_references of 0"),
        (lambda f: Supervisor(f, fs=FS, amplitude_limit=1.0).process([1.0], [1.0]), "references must be None"),
        (
            lambda f: Supervisor(
                VirtualMicrophones(f, np.ones((2, 1, 4)), [[[1.0]]], physical=[0]), fs=FS, amplitude_limit=1.0
            ),
            "must not have virtual microphones",
        ),
        (lambda f: fx_lms(4, S, step_size=MU).control_signal(None), "with_internal_model"),
        (lambda f: fx_lms(4, S, step_size=MU).process(None, [1.0]), "with_internal_model"),
        (lambda f: simulate(fx_lms(4, S, step_size=MU), None, Plant(S, fs=FS), disturbance=D), "with_internal_model"),
        (lambda f: with_internal_model(FeedbackNeutralizer(fx_lms(4, S, step_size=MU), [0.0, 1.0])), "wrap the result"),
    ],
)
def test_what_is_refused(call: Any, message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        call(with_internal_model(fx_lms(4, S_HAT, step_size=MU)))
