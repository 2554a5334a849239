"""The control filter within a power: against scipy, 50 digits, dense solves, SLSQP, and the conditions of optimality."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from helpers.compiled import from_python
from helpers.power_budget import correlation, within
from hypothesis import given
from hypothesis import strategies as st

from kfopc_filterpy.kernels import toeplitz as parts
from kfopc_filterpy.kernels.toeplitz import solve_toeplitz
from kfopc_filterpy.power.allocation import POWER_TOLERANCE, RIDGE

toeplitz_power, toeplitz_times = from_python(parts.toeplitz_power), from_python(parts.toeplitz_times)

EPS = np.finfo(np.float64).eps
toeplitz = scipy.linalg.toeplitz
seeds = st.integers(0, 10_000)


def coloured(n: int, seed: int, samples: int = 2000) -> tuple[np.ndarray, np.ndarray]:
    """Correlations of a random noise and of what a random secondary path makes of it."""
    rng = np.random.default_rng(seed)
    x = np.convolve(rng.standard_normal(samples), [1.0, rng.uniform(-0.8, 0.8)])
    return correlation(x, n), correlation(np.convolve(x, [1.0, *rng.uniform(-0.4, 0.4, 2)]), n)


def solution(t: np.ndarray, b: np.ndarray) -> tuple[bool, np.ndarray]:
    v = np.full(t.size, np.nan)
    return bool(solve_toeplitz(t, b, v)), v


def dense(of_x: np.ndarray, of_xf: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R_x, and R_x' with the ridge, in full."""
    return toeplitz(of_x), toeplitz(of_xf) + RIDGE * of_xf[0] * np.eye(of_xf.size)


# ---- Toeplitz matrices


@given(n=st.integers(1, 50), seed=seeds)
def test_products_are_those_of_the_full_matrix(n: int, seed: int) -> None:
    """To n roundings of the largest sum of moduli: two orders of the same sums."""
    t, w = np.random.default_rng(seed).standard_normal((2, n))
    out = np.full(n, np.nan)
    toeplitz_times(t, w, out)
    largest = np.abs(toeplitz(t)) @ np.abs(w)
    np.testing.assert_allclose(out, toeplitz(t) @ w, rtol=0, atol=2 * n * EPS * largest.max())
    assert toeplitz_power(t, w) == pytest.approx(w @ toeplitz(t) @ w, abs=4 * n * EPS * np.abs(w) @ largest)


@given(n=st.integers(1, 64), seed=seeds)
def test_the_solution_is_scipys(n: int, seed: int) -> None:
    """Both are Levinson's recursion, and the full matrix solved by LU: apart by the condition times n roundings."""
    t, _ = coloured(n, seed)
    b = np.random.default_rng(seed + 1).standard_normal(n)
    solved, v = solution(t, b)
    assert solved
    tolerance = n * EPS * np.linalg.cond(toeplitz(t))
    for expected in (scipy.linalg.solve_toeplitz(t, b), np.linalg.solve(toeplitz(t), b)):
        assert np.linalg.norm(v - expected) <= tolerance * np.linalg.norm(expected)


@pytest.mark.parametrize("band", [(200.0, 2000.0), (20.0, 300.0), (400.0, 420.0)])
@pytest.mark.parametrize("ridge", [RIDGE, 1e-10])
def test_of_an_ill_conditioned_matrix_no_more_digits_are_lost_than_its_condition_costs(
    band: tuple[float, float], ridge: float
) -> None:
    """Against 50 digits: noise of a band leaves most directions of 24 taps to the ridge."""
    n = 24
    low, high = (2.0 * edge / 16000.0 for edge in band)
    t = high * np.sinc(high * np.arange(n)) - low * np.sinc(low * np.arange(n))
    t[0] *= 1.0 + ridge
    b = np.random.default_rng(2).standard_normal(n)
    with mpmath.workdps(50):
        matrix = mpmath.matrix([[mpmath.mpf(float(t[abs(i - j)])) for j in range(n)] for i in range(n)])
        exact = np.array([float(value) for value in mpmath.lu_solve(matrix, mpmath.matrix(b.tolist()))])
    condition = np.linalg.cond(toeplitz(t))
    assert condition > 0.1 / ridge
    solved, v = solution(t, b)
    assert solved
    assert np.linalg.norm(v - exact) <= 4 * EPS * condition * np.linalg.norm(exact)


@given(n=st.integers(1, 12), seed=seeds, diagonal=st.floats(-1.0, 3.0))
def test_it_is_solved_where_the_matrix_is_definite_and_only_there(n: int, seed: int, diagonal: float) -> None:
    t = 0.5 * np.random.default_rng(seed).standard_normal(n)
    t[0] = diagonal
    least = np.linalg.eigvalsh(toeplitz(t))[0]
    if abs(least) > 1e-9:  # nearer to singular than that, rounding may decide
        assert solution(t, np.ones(n))[0] == (least > 0)


@pytest.mark.parametrize("t", [[0.0], [-1.0, 0.0], [math.nan, 0.0], [1.0, math.nan], [1.0, 1.0], [1.0, 0.0, 1.5]])
def test_what_is_singular_indefinite_or_no_number_is_not_solved(t: list[float]) -> None:
    assert not solution(np.array(t), np.ones(len(t)))[0]


# ---- The filter within the power


@given(n=st.integers(1, 24), seed=seeds, share=st.floats(1.0, 1e6))
def test_an_estimate_that_fits_stays_as_it_is(n: int, seed: int, share: float) -> None:
    of_x, of_xf = coloured(n, seed, 200)
    w = np.random.default_rng(seed).standard_normal(n)
    weight, v = within(of_x, of_xf, w, share * toeplitz_power(of_x, w), weight=0.3)
    assert weight == 0.0
    np.testing.assert_array_equal(v, w)


@given(
    n=st.integers(1, 24), seed=seeds, overdrive=st.floats(1.02, 100.0), start=st.sampled_from([0.0, 0.01, 1.0, 30.0])
)
def test_the_conditions_of_optimality_hold(n: int, seed: int, overdrive: float, start: float) -> None:
    """Karush-Kuhn-Tucker, sufficient since the problem is convex; the power is the one asked for to its tolerance.

    The residual of the equations: n roundings of its terms times the condition, at most 100 here.
    """
    of_x, of_xf = coloured(n, seed, 400)
    R_x, R_xf = dense(of_x, of_xf)
    w = np.random.default_rng(seed).standard_normal(n)
    power = w @ R_x @ w / overdrive
    weight, v = within(of_x, of_xf, w, power, start)
    assert 0.0 < weight < math.inf
    scale = np.linalg.norm(R_xf, 2) * np.linalg.norm(w)
    assert np.linalg.norm(R_xf @ (v - w) + weight * R_x @ v) <= 1e3 * n * EPS * scale
    assert v @ R_x @ v == pytest.approx(power, rel=POWER_TOLERANCE * (1 + 1e-6))


@given(n=st.integers(2, 16), seed=seeds, overdrive=st.floats(1.02, 30.0))
def test_no_other_filter_of_its_power_has_less_error(n: int, seed: int, overdrive: float) -> None:
    of_x, of_xf = coloured(n, seed, 400)
    R_x, R_xf = dense(of_x, of_xf)
    rng = np.random.default_rng(seed)
    w = rng.standard_normal(n)
    _, v = within(of_x, of_xf, w, w @ R_x @ w / overdrive)
    reached, least = v @ R_x @ v, (v - w) @ R_xf @ (v - w)
    for size in (1.0, 0.1, 1e-3):
        other = v + size * rng.standard_normal(n) / math.sqrt(n)
        other *= math.sqrt(reached / (other @ R_x @ other))
        assert (other - w) @ R_xf @ (other - w) >= least * (1 - 1e-12)


@pytest.mark.parametrize("overdrive", [1.1, 4.0, 100.0])
@pytest.mark.parametrize("n", [2, 8, 32])
def test_lambda_is_that_of_a_root_search_on_dense_solves(n: int, overdrive: float) -> None:
    of_x, of_xf = coloured(n, seed=n)
    R_x, R_xf = dense(of_x, of_xf)
    w = np.random.default_rng(n).standard_normal(n)
    power = w @ R_x @ w / overdrive

    def filter_of(weight: float) -> np.ndarray:
        return scipy.linalg.solve(R_xf + weight * R_x, R_xf @ w, assume_a="pos")

    def root(goal: float) -> float:
        return scipy.optimize.brentq(lambda u: filter_of(u) @ R_x @ filter_of(u) - goal, 0.0, 1e4, xtol=1e-14)

    weight, v = within(of_x, of_xf, w, power)
    # between the roots for the ends of the tolerance
    assert (
        root(power * (1 + POWER_TOLERANCE)) * (1 - 1e-9) <= weight <= root(power * (1 - POWER_TOLERANCE)) * (1 + 1e-9)
    )
    # and the filter that belongs to it, to rounding at a condition of at most 100
    np.testing.assert_allclose(v, filter_of(weight), rtol=0, atol=1e-12 * np.abs(v).max())


@pytest.mark.parametrize("seed", range(4))
def test_the_error_is_that_of_a_general_optimiser(seed: int) -> None:
    """SLSQP, which knows nothing of lambda, within the power that was reached: the same least error to 1e-6."""
    n = 6
    of_x, of_xf = coloured(n, seed)
    R_x, R_xf = dense(of_x, of_xf)
    w = np.random.default_rng(seed).standard_normal(n)
    _, v = within(of_x, of_xf, w, w @ R_x @ w / 5.0)
    reached = v @ R_x @ v
    found = scipy.optimize.minimize(
        lambda u: (u - w) @ R_xf @ (u - w),
        0.4 * w,
        jac=lambda u: 2.0 * R_xf @ (u - w),
        constraints={"type": "ineq", "fun": lambda u: reached - u @ R_x @ u, "jac": lambda u: -2.0 * R_x @ u},
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 500},
    )
    assert (v - w) @ R_xf @ (v - w) == pytest.approx(found.fun, rel=1e-6)
    np.testing.assert_allclose(v, found.x, rtol=0, atol=1e-4 * np.abs(v).max())  # an error is flat at its least


@given(exponent=st.integers(-60, 60), gain=st.integers(-20, 20), seed=seeds)
def test_units_do_not_matter(exponent: int, gain: int, seed: int) -> None:
    """x by c and the path by g: lambda by g^2 and the same filter, exactly for powers of two."""
    of_x, of_xf = coloured(8, seed, 200)
    w = np.random.default_rng(seed).standard_normal(8)
    power, c, g = toeplitz_power(of_x, w) / 3.0, 4.0**exponent, 4.0**gain
    weight, v = within(of_x, of_xf, w, power)
    scaled, same = within(c * of_x, c * g * of_xf, w, c * power)
    assert scaled == g * weight
    np.testing.assert_array_equal(same, v)


@given(w=st.floats(0.1, 10.0), gain=st.floats(0.01, 100.0), overdrive=st.floats(1.01, 1e4))
def test_one_tap_is_scaled(w: float, gain: float, overdrive: float) -> None:
    """(g + lambda) v = g w: what is left is the scale of v, and lambda = g (w/v - 1)."""
    of_x = np.array([2.0])
    weight, v = within(of_x, gain * of_x, np.array([w]), 2.0 * w * w / overdrive)
    assert v[0] == pytest.approx(w / math.sqrt(overdrive), rel=POWER_TOLERANCE)  # half of that of the power
    assert weight == pytest.approx((1 + RIDGE) * gain * (w / v[0] - 1.0), rel=1e-10)  # w/v - 1 above 0.005


@pytest.mark.parametrize("overdrive", [1.5, 4.0, 1e3])
@pytest.mark.parametrize("n", [2, 3, 16])
def test_a_tone_keeps_its_power_and_what_it_does_not_excite_stays_as_estimated(n: int, overdrive: float) -> None:
    """The correlations of a tone are of rank 2: of n taps it fixes two numbers, for the rest stands the ridge."""
    of_x = 0.5 * np.cos(0.3 * np.arange(n))
    of_xf = 2.5 * of_x
    w = np.random.default_rng(n).standard_normal(n)
    excited = np.exp(0.3j * np.arange(n))
    power = 0.5 * abs(w @ excited) ** 2 / overdrive
    weight, v = within(of_x, of_xf, w, power)
    # a flat path: the tone is scaled, (g + lambda) v = g w
    assert v @ excited == pytest.approx(w @ excited / math.sqrt(overdrive), rel=POWER_TOLERANCE)
    assert weight == pytest.approx(2.5 * (math.sqrt(overdrive) - 1.0), rel=0.01 * math.sqrt(overdrive))
    basis = np.linalg.qr(np.column_stack((excited.real, excited.imag)))[0]
    for vector in (v, w):
        vector -= basis @ (basis.T @ vector)
    # the rounding of T, 1e-16 n (1 + lambda), against the ridge of 1e-7
    np.testing.assert_allclose(v, w, rtol=0, atol=1e-8 * n * (1 + weight) * max(np.abs(w).max(), 1e-3))


def test_a_flat_path_is_a_matter_of_scale_and_one_solve() -> None:
    """R_x' = g R_x: v = g/(g + lambda) w, and 1/sqrt(power) is a straight line in lambda."""
    of_x, _ = coloured(12, seed=5)
    w = np.random.default_rng(5).standard_normal(12)
    free = toeplitz_power(of_x, w)
    weight, v = within(of_x, 3.0 * of_x, w, free / 16.0)
    assert weight == pytest.approx(3.0 * 3.0, rel=1e-5)  # the ridge is 1e-7 times a condition of at most 100
    np.testing.assert_allclose(v, w / 4.0, rtol=0, atol=1e-5)


def test_power_goes_where_the_path_lets_most_through() -> None:
    """Two tones of equal need, one heard at a tenth of the power: most of the budget goes to the other."""
    n, k = 64, np.arange(64)
    frequencies = 2 * np.pi * np.array([4, 22]) / n  # orthogonal over the taps
    low, high = np.cos(np.outer(frequencies, k))
    of_x, of_xf = 0.5 * (low + high), 0.5 * (low + 0.1 * high)
    w = (low + high) / n
    weight, v = within(of_x, of_xf, w, toeplitz_power(of_x, w) / 2.0)
    gains = np.exp(1j * np.outer(frequencies, k)) @ v / (0.5 + 0j)
    root = scipy.optimize.brentq(lambda u: 1 / (1 + u) ** 2 + 1 / (1 + 10 * u) ** 2 - 1.0, 0.0, 1.0)
    assert weight == pytest.approx(root, rel=0.05)
    np.testing.assert_allclose(gains, [1 / (1 + weight), 1 / (1 + 10 * weight)], rtol=1e-5)


@pytest.mark.parametrize(
    ("of_x", "of_xf"),
    [
        ([1.0, 0.5, 0.1], [0.0, 0.0, 0.0]),  # nothing comes through the path
        ([1.0, 0.5, 0.1], [1.0, 3.0, 0.0]),  # no correlation: indefinite
        ([1.0, 0.5, 0.1], [math.nan] * 3),
        ([1.0, 0.5, 0.1], [1e300, 0.0, 0.0]),
        ([1e-300, 0.0, 0.0], [1e300, 0.0, 0.0]),  # a gain that overflows
    ],
)
def test_where_it_cannot_be_solved_the_estimate_is_scaled_to_the_power(of_x: list[float], of_xf: list[float]) -> None:
    w = np.array([2.0, -1.0, 0.5])
    power = 0.1 * toeplitz_power(np.array(of_x), w)
    weight, v = within(np.array(of_x), np.array(of_xf), w, power)
    reached = toeplitz_power(np.array(of_x), v)
    assert reached <= power * (1 + 1e-9 if math.isinf(weight) else 1 + POWER_TOLERANCE)
    if math.isinf(weight):
        np.testing.assert_allclose(v, w * math.sqrt(0.1), rtol=1e-12)
    assert math.isinf(weight) == (of_xf[0] != 1e300 or of_x[0] == 1e-300)
