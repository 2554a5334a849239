"""The LMS family against what each must settle to, and the limits of its steps."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from hypothesis import given
from hypothesis import strategies as st

from kfopc_filterpy import (
    Plant,
    fx_lms,
    fx_nlms,
    leaky_fx_lms,
    mov_fx_lms,
    optimal_leaky_fx_lms,
    output_power,
    rescaling_fx_lms,
    simulate,
    two_gradient_fx_lms,
)
from kfopc_filterpy.controllers import penalty_factor
from kfopc_filterpy.paths import PathTolerance

L, FS = 5, 16000.0
PATH = np.array([0.0, 0.8, -0.3, 0.1])  # true secondary path


# ---- What they settle to


def statistics(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A coloured reference of one period, disturbance, and R_x', R_x and r over that period, exact for a periodic signal."""
    rng = np.random.default_rng(seed)
    period = 64
    x = np.convolve(np.tile(rng.standard_normal(period), 3), [1.0, 0.6, 0.2])[period : 2 * period]
    d = sum(c * np.roll(x, k) for k, c in {2: 1.2, 4: 0.5}.items())
    xf = sum(c * np.roll(x, k) for k, c in enumerate(PATH))
    X, XF = (np.array([np.roll(signal, k) for k in range(L)]) for signal in (x, xf))
    return x, d, XF @ XF.T / period, X @ X.T / period, XF @ d / period


@pytest.mark.parametrize(
    ("controller", "price"),
    [
        (lambda mu: leaky_fx_lms(L, PATH, step_size=mu, leak=0.5), lambda R_x: 0.5 * np.eye(L)),
        (lambda mu: mov_fx_lms(L, PATH, step_size=mu, penalty_factor=0.6), lambda R_x: 0.6 * R_x),
        (lambda mu: mov_fx_lms(L, PATH, step_size=mu, penalty_factor=0.6, modified=True), lambda R_x: 0.6 * R_x),
    ],
    ids=["leaky", "MOV", "MOV modified"],
)
def test_it_settles_at_the_regularised_wiener_solution(controller: Any, price: Any) -> None:
    """(R_x' + price) w = r, by a dense solve; the distance is of the order of the step size, so halving it halves that.

    Averaged over a period the recursion is exact gradient descent but for terms of order mu.
    """
    x, d, R_xf, R_x, r = statistics()
    expected = np.linalg.solve(R_xf + price(R_x), r)
    distances = []
    for mu in (4e-3, 2e-3):
        made = controller(mu)
        repeats = round(400 / mu / x.size)
        result = simulate(
            made, np.tile(x, repeats), Plant(PATH, fs=FS), disturbance=np.tile(d, repeats), record_weights_every=1
        )
        assert result.weights is not None
        distances.append(np.max(np.abs(np.mean(result.weights[-x.size :], axis=0) - expected)))
    assert distances[0] < 0.02 * np.max(np.abs(expected))
    assert distances[1] < 0.75 * distances[0] or distances[1] < 1e-6
    plain = np.linalg.solve(R_xf, r)
    assert np.max(np.abs(plain - expected)) > 0.1 * np.max(np.abs(expected))  # the price does matter


@pytest.mark.parametrize("kind", [mov_fx_lms, optimal_leaky_fx_lms])
def test_a_white_reference_through_a_flat_path_is_held_to_the_rated_power(kind: Any) -> None:
    """White noise and one delayed tap: what the penalty is derived for, exact but for the noise of the weights."""
    rng = np.random.default_rng(8)
    x = rng.standard_normal(60000)
    d = np.convolve(x, [0.0, 0.0, 2.0])[: x.size]  # the full control power is (2 / 0.5)^2 = 16
    made = kind(4, [0.0, 0.5], step_size=2e-3, rated_power=4.0, fs=FS)
    result = simulate(made, x, Plant([0.0, 0.5], fs=FS), disturbance=d)
    assert output_power(result.control_signal) == pytest.approx(4.0, rel=0.03)
    assert made.weights[1] == pytest.approx(2.0, rel=0.03)  # half of 4


@given(st.floats(1e-6, 1e6), st.floats(1e-6, 1e6), st.floats(1e-6, 1e6))
def test_the_penalty_leaves_the_constraint_factor(rated: float, power: float, gain: float) -> None:
    """G_s / (G_s + gamma) = min(sqrt(rho_o G_s / delta_d^2), 1), eq. 13."""
    gamma = penalty_factor(rated, disturbance_power=power, secondary_path_gain=gain)
    assert gain / (gain + gamma) == pytest.approx(min(np.sqrt(rated * gain / power), 1.0), rel=1e-9)


# ---- Amplitude limits


def test_re_scaling_holds_a_tone_to_its_rated_power() -> None:
    """A sine of amplitude sqrt(2 rated power), as far as its ripple."""
    n = np.arange(40000)
    x, d = np.sin(0.3 * n), 3.0 * np.sin(0.3 * n + 0.4)
    controller = rescaling_fx_lms(16, [0.0, 1.0], step_size=1e-4, amplitude_limit=np.sqrt(2 * 0.5))
    result = simulate(controller, x, Plant([0.0, 1.0], fs=FS), disturbance=d)
    assert output_power(result.control_signal) == pytest.approx(0.5, rel=0.02)
    assert np.mean(result.error[-2000:] ** 2) == pytest.approx((3.0 - 1.0) ** 2 / 2, rel=0.03)  # the rest of the sine


@pytest.mark.parametrize("ratio", [0.3, 1.0, 10.0])
def test_two_gradients_settle_where_they_balance(ratio: float) -> None:
    """For a tone d = D sin, y = a sin and a path of 1: mu (D - a) I = mu_y a (1/2 - I), I the mean of sin^2 within A.

    Above the limit therefore, and the closer to it the larger mu_y / mu.
    """
    D, limit, mu = 3.0, 1.0, 2e-4

    def balance(a: float) -> float:
        theta = np.arcsin(limit / a)
        within = (theta - np.sin(theta) * np.cos(theta)) / np.pi
        return (D - a) * within - ratio * a * (0.5 - within)

    expected = scipy.optimize.brentq(balance, limit + 1e-9, D)
    n = np.arange(round(60000 * max(ratio / 10, 1)))  # ten time constants of the slower direction
    x, d = np.sin(0.3 * n), D * np.sin(0.3 * n + 0.4)
    controller = two_gradient_fx_lms(
        16, [1.0], step_size=mu / max(ratio, 1), amplitude_limit=limit, output_step_size=mu * min(ratio, 1)
    )
    result = simulate(controller, x, Plant([1.0], fs=FS), disturbance=d)
    amplitude = np.sqrt(2 * np.mean(result.control_signal[-20000:] ** 2))
    assert amplitude == pytest.approx(expected, rel=0.02)


# ---- Steps


@pytest.mark.parametrize("kind", ["white", "tone"])
@pytest.mark.parametrize("factor", [None, 0.2])
def test_a_tenth_of_the_bound_converges_and_twice_the_bound_does_not(kind: str, factor: float | None) -> None:
    """A tone of 200 Hz has only a twentieth of the bound of a white reference."""
    taps, delay, n = 64, 20, 64_000
    x = np.random.default_rng(0).standard_normal(n)
    if kind == "tone":
        x = np.sqrt(2.0) * np.sin(2 * np.pi * 200 * np.arange(n) / FS)
    plant = Plant(np.eye(1, delay + 1, delay)[0], np.eye(1, 60, 59)[0], fs=FS)  # P = E[d^2] = G_s = 1
    bound = 2 / (taps + delay) if kind == "white" else 2 * np.sin(np.pi / (4 * delay + 2)) / taps

    def left(share: float) -> float:
        if factor is None:
            controller = fx_lms(taps, plant, step_size=share * bound)
        else:
            controller = mov_fx_lms(taps, plant, step_size=share * factor * bound, rated_power=factor**2)
        run = simulate(controller, x, plant)
        return np.inf if run.diverged_at_s else np.mean(run.error[-n // 4 :] ** 2) ** 0.5

    assert left(0.1) == pytest.approx(1.0 - (factor or 1.0), abs=0.02)
    assert left(2.0 if factor is None else 2.0 / factor) > 1.0


def test_a_normalised_step_does_not_depend_on_the_level_and_is_stable_up_to_2() -> None:
    """On paths without delay, where the error power cannot grow within a step that is below 2, and does above."""
    flat = np.random.default_rng(8).standard_normal((3, 2, 1)) * np.eye(1, 3)
    x, level = np.random.default_rng(3).standard_normal((2, 3000)), np.repeat([1.0, 30.0], 1500)
    d = np.einsum("kj,ji,in->kn", flat[:, :, 0], [[0.5, 0.2], [-0.3, 0.4]], x)
    errors = []
    for mu in (0.5, 1.9, 2.5):
        controller = fx_nlms(1, flat, step_size=mu, n_references=2)
        errors.append(simulate(controller, level * x, Plant(flat, fs=FS), disturbance=level * d).error)
    for error in errors[:2]:
        assert np.mean(error[:, -200:] ** 2) < 1e-6 * np.mean(d[:, -200:] ** 2)  # loud or soft
    assert np.nanmax(np.abs(errors[2])) > 10.0 * np.abs(level * d).max()


def test_a_large_leak_forgets_everything_and_no_more() -> None:
    """With mu gamma above 1, w = 0 w + mu e x', not a negative share of what was there."""
    made = optimal_leaky_fx_lms(1, [1.0], step_size=0.5, rated_power=1e-6, fs=FS)
    for reference, error in ((1.0, 4.0), (1.0, 5.0), (1.0, -6.0)):
        made.control_signal(reference)
        made.update(error)
        if made.constraint_factor < 0.3:  # gamma = G E[x^2] (1 / alpha - 1) > 2
            np.testing.assert_allclose(made.weights, [0.5 * error], rtol=1e-12)
    assert made.constraint_factor < 0.3


def test_weights_that_were_learned_of_hardly_anything_begin_anew() -> None:
    """FxNLMS: at 100 times the amplitude of what they were learned of, and not at 50 times; nor with a regularization."""
    some: dict[str, Any] = {"regularization": 1e-12}
    for louder, options, forgets in ((101.0, {}, True), (50.0, {}, False), (101.0, some, False)):
        made = fx_nlms(1, [1.0], step_size=0.1, **options)
        for _ in range(10):
            made.control_signal(1e-3)
            made.update(1.0)
        before = made.weights
        assert before[0] > 1.0
        made.control_signal(louder * 1e-3)
        np.testing.assert_array_equal(made.weights, [0.0] if forgets else before)


def test_from_silence_nothing_is_learned() -> None:
    """FxNLMS: weights of 20 samples are kept, 20 times as long as those of a soft reference would be."""
    made = fx_nlms(1, [1.0], step_size=0.1)
    made.process(np.full(20, 2.0), np.ones(20))
    before = made.weights
    made.process(np.zeros(20_000), np.zeros(20_000))
    made.control_signal(1.0)
    np.testing.assert_array_equal(made.weights, before)


# ---- Limits


def test_a_large_step_takes_no_more_than_the_whole_error_or_control_signal() -> None:
    for x in (1e15, 1.2, 0.8):  # the last step is shorter than that
        made = fx_lms(1, [1.0], step_size=1.0)
        made.control_signal(x)
        made.update(1e25)
        np.testing.assert_allclose(made.weights, [min(1.0, 1.0 / x**2) * 1e25 * x], rtol=1e-12)
    for x in (0.5, 2.0):
        made = mov_fx_lms(1, [[[1.0], [1.0]]], step_size=1e-3, penalty_factor=[0.0, 1e30])
        for error in (1.0, 0.0):
            made.control_signal(x)
            made.update([error])
        np.testing.assert_allclose(made.weights.ravel(), [1e-3 * x, 0.0], atol=1e-18)


@pytest.mark.parametrize("loud", [0, 1])
def test_a_step_above_1e50_is_refused(loud: int) -> None:
    made = fx_lms(1, [[[1.0]], [[1.0]]], step_size=1.0)
    made.control_signal(1e10)
    with pytest.raises(ValueError, match="step"):
        made.update(np.eye(2)[loud] * 1e62)  # over 2 x'
    np.testing.assert_array_equal(made.weights.ravel(), [0.0])


def test_a_guard_that_would_take_more_than_1e50_is_refused() -> None:
    made = fx_lms(1, [1.0], step_size=1.0)
    for error in (0.9e50, 0.9e50, 0.0):
        made.control_signal(1.0)
        if error:
            made.update(error)
    made.secondary_path_uncertainty = PathTolerance(gain_db=20.0)  # 0.97 of the weights would go
    with pytest.raises(ValueError, match="step"):
        made.update(0.0)
    np.testing.assert_allclose(made.weights, [1.8e50])


@pytest.mark.parametrize("size", [0.6e50, 0.8e50])
def test_a_penalty_that_would_take_more_than_1e50_is_refused(size: float) -> None:
    """Two weights grow one after the other; then both play, and the penalty takes them away: a step of sqrt(2) size."""
    made, e = mov_fx_lms(3, [1.0], step_size=0.5, penalty_factor=10.0), 2.0 * size
    for x, error in ((1.0, e), (0.0, e), (0.0, 0.0), (0.0, 0.0), (1.0, e)):  # the last e makes up for the penalty
        made.control_signal(x)
        made.update(error)
    np.testing.assert_allclose(made.weights, [size, size, 0.0])
    made.control_signal(1.0)
    refused = np.sqrt(2.0) * size > 1e50
    with pytest.raises(ValueError, match="step") if refused else nullcontext():
        made.update(0.0)
    np.testing.assert_allclose(made.weights, [size * refused, size * refused, 0.0], atol=1e36)


@pytest.mark.parametrize("at", [*np.ndindex(2, 3)])
def test_the_loudest_reference_is_1e25_over_the_largest_gain_of_a_path(at: tuple[int, int]) -> None:
    path = np.zeros((2, 3, 2))
    path[at] = 6.0, -4.0
    made = fx_lms(1, path, step_size=1.0)
    made.control_signal(0.9e24)
    with pytest.raises(ValueError, match="reference"):
        made.control_signal(1.1e24)
