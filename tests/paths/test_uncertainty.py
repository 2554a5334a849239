"""The uncertainty of a secondary path and the guard filter: against a search over all errors within the tolerances."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kfopc_filterpy.paths import PathTolerance, fir_path, guard_filter, path_uncertainty
from kfopc_filterpy.paths.uncertainty import LARGEST_GAIN, N_FREQUENCIES, guard_against, is_controllable

OMEGA = np.linspace(0.0, np.pi, N_FREQUENCIES)
PATH = np.array([0.0, 0.9, -0.4, 0.2])


@given(
    delay=st.floats(0.0, 2.0),
    phase=st.floats(0.0, 170.0),
    gain=st.floats(0.0, 12.0),
    omega=st.floats(0.0, float(np.pi)),
)
def test_no_error_within_the_tolerances_is_larger(delay: float, phase: float, gain: float, omega: float) -> None:
    bound = PathTolerance(delay_samples=delay, phase_deg=phase, gain_db=gain).relative_error(np.array([omega]))[0]
    steps = np.linspace(-1.0, 1.0, 21)
    factors = 10 ** (gain * steps / 20)
    angles = (delay * omega * steps[:, None] + np.deg2rad(phase) * steps).ravel()
    errors = np.abs(factors[:, None] * np.exp(1j * angles) - 1.0)
    assert errors.max() <= bound * (1 + 1e-12) + 1e-8
    if delay * omega + np.deg2rad(phase) <= np.pi:  # the corner itself is among the errors
        assert errors.max() == pytest.approx(bound, rel=1e-9, abs=1e-8)


def test_what_can_be_given() -> None:
    np.testing.assert_array_equal(path_uncertainty(None, PATH), 0.0)
    np.testing.assert_array_equal(path_uncertainty(0.3, fir_path(PATH, 8000.0)), 0.3)
    np.testing.assert_allclose(path_uncertainty([0.0, 1.0], PATH), OMEGA / np.pi)
    assert guard_against(None, PATH) is None
    assert guard_against(0.0, PATH) is None
    tolerance = PathTolerance(delay_samples=1.0)
    np.testing.assert_array_equal(guard_against(tolerance, PATH), guard_filter(tolerance))
    np.testing.assert_array_equal(guard_against(0.3, PATH), guard_filter(path_uncertainty(0.3, PATH)))
    np.testing.assert_array_equal(is_controllable(tolerance, PATH), tolerance.share(OMEGA) > 0.0)
    np.testing.assert_array_equal(is_controllable([0.0, 2.0], PATH), np.pi / 2 > OMEGA)
    assert np.all(is_controllable(None, PATH))


def test_measured_paths_give_their_largest_distance() -> None:
    measured = np.array([PATH, 1.1 * PATH, 0.7 * PATH])
    np.testing.assert_allclose(path_uncertainty(measured, PATH), 0.3, rtol=1e-9)
    late = np.concatenate([[0.0], PATH])[np.newaxis]
    np.testing.assert_allclose(path_uncertainty(late, PATH), 2 * np.sin(OMEGA / 2), atol=1e-9)


def test_matrices_are_measured_by_their_norm() -> None:
    """S = (I + Delta) S^ with a Delta of known norm, which is the same at all frequencies."""
    rng = np.random.default_rng(0)
    estimate = rng.standard_normal((3, 3, 5))
    delta = rng.standard_normal((3, 3))
    true = estimate + np.einsum("kl,ljt->kjt", delta, estimate)
    np.testing.assert_allclose(path_uncertainty(true[None], estimate), np.linalg.norm(delta, 2), rtol=1e-6)


def test_a_path_that_is_zero_at_a_frequency_is_unknown_there() -> None:
    notch = np.array([1.0, 0.0, 1.0])  # zero at a quarter of the sample rate
    uncertainty = path_uncertainty(np.array([[1.0, 0.1, 1.0]]), notch)
    assert uncertainty[128] > 1e6
    assert guard_filter(uncertainty) is not None
    assert np.isfinite(guard_filter(uncertainty)).all()


def response(guard: np.ndarray) -> np.ndarray:
    """The share g = 1/(1 + |W|^2) of a guard filter."""
    return 1.0 / (1.0 + np.abs(np.fft.rfft(guard, 512)) ** 2)


@given(phase=st.floats(0.0, 180.0), gain=st.floats(0.0, 12.0))
def test_a_tolerance_allows_control_only_where_a_search_finds_a_share_that_is_safe(phase: float, gain: float) -> None:
    """A safe g is stable and not louder for all errors. A search over g in steps of 1/2000 misses the edge by one step."""
    share = PathTolerance(phase_deg=phase, gain_db=gain).share(np.array([0.0]))[0]
    error = PathTolerance(phase_deg=phase, gain_db=gain).relative_error(np.array([0.0]))[0]
    assert share in (0.0, 1.0) or share * error == pytest.approx(LARGEST_GAIN)
    assert share * error <= LARGEST_GAIN * (1 + 1e-12)
    ratios = np.exp(1j * np.deg2rad(np.linspace(0.0, phase, 61))) * 10 ** (
        gain * np.linspace(-1.0, 1.0, 21)[:, None] / 20
    )
    g = np.linspace(0.0, 1.0, 2001)[1:, None]
    changed = 1.0 - g + g * ratios.ravel()  # 1 + g Delta
    stable = changed.real > 0.0
    not_louder = np.abs(changed) >= (1.0 - g) * (1 - 1e-12)
    safe = bool(np.any(np.all(stable & not_louder, axis=1)))
    edge = 2.0 * max(-np.cos(np.deg2rad(phase)), 0.0)
    margin = 1.0 / (1.0 + 10 ** (gain / 20) * edge / 2) - edge / (10 ** (-gain / 20) + edge)  # stable above not louder
    if abs(margin) > 1e-3:
        assert (share > 0.0) == safe


def test_an_exact_gain_allows_control_up_to_135_degrees() -> None:
    share = PathTolerance(delay_samples=1.0).share(np.pi * np.array([0.0, 0.749, 0.751, 1.0]))
    np.testing.assert_array_equal(share > 0.0, [True, True, False, False])
    assert share[0] == 1.0


@pytest.mark.parametrize(
    "tolerance", [PathTolerance(0.5), PathTolerance(1.0), PathTolerance(2.0), PathTolerance(1.0, 20.0, 2.0)]
)
def test_the_guard_of_a_tolerance_has_the_response_wanted(tolerance: PathTolerance) -> None:
    """But where g falls steeply, which 48 taps need a twelfth of the band for. A fast adaptation stays stable."""
    share, wanted = response(guard_filter(tolerance)), tolerance.share(OMEGA)
    gentle = np.convolve(wanted == 0.0, np.ones(43), mode="same") % 43 == 0
    np.testing.assert_allclose(share[gentle], np.maximum(wanted, 0.03)[gentle], atol=0.1)
    assert np.max(share * tolerance.relative_error(OMEGA)) < 1.05


def test_the_guard_of_a_relative_error_has_the_response_wanted() -> None:
    """The share g to 0.15, which 48 taps reach; hardly any control where the error can exceed 100 %."""
    for tolerance in (PathTolerance(0.5), PathTolerance(1.0), PathTolerance(gain_db=3.0)):
        delta = tolerance.relative_error(OMEGA)
        share = response(guard_filter(delta))
        np.testing.assert_allclose(share, np.clip(1.0 - delta**6, 0.0, 1.0), atol=0.15)
        assert share[delta >= 1.1].max(initial=0.0) < 0.1
        assert np.max(share * delta) < 0.7  # stable with a margin


def test_a_guard_is_minimum_phase_and_does_not_overshoot() -> None:
    """A constant penalty is kept; where it rises, it stays between the smallest and the largest."""
    delta = np.full(N_FREQUENCIES, 0.8)
    penalty = 0.8**6 / (1.0 - 0.8**6)
    np.testing.assert_allclose(np.abs(np.fft.rfft(guard_filter(delta), 512)) ** 2, penalty, rtol=1e-6)
    guard = guard_filter(PathTolerance(1.0))
    power = np.abs(np.fft.rfft(guard, 512)) ** 2
    assert power.max() < 1.001 * (1.0 - 0.03) / 0.03
    assert power.min() > 0.9e-4
    assert np.all(np.diff(power[110:]) > -1e-3 * power.max())  # rises, and never overshoots
    assert np.abs(np.roots(guard)).max() < 1.0


@pytest.mark.parametrize(
    ("uncertainty", "path", "message"),
    [
        (-0.1, PATH, "secondary_path_uncertainty must"),
        (np.nan, PATH, "secondary_path_uncertainty must"),
        ([0.1, -0.2], PATH, "zero or above at two or more frequencies"),
        ([0.1], PATH, "zero or above at two or more frequencies"),
        ([0.1, np.inf], PATH, "secondary_path_uncertainty"),
        (np.ones((2, 3, 4, 5)), PATH, r"must be \(M, n_taps\)"),
        (np.ones((2, 4)), np.ones((2, 2, 4)), r"must be \(M, 2, 2, n_taps\)"),
        ("much", PATH, "secondary_path_uncertainty"),
    ],
)
def test_what_is_refused(uncertainty: Any, path: np.ndarray, message: str) -> None:
    with pytest.raises((TypeError, ValueError), match=message):
        path_uncertainty(uncertainty, path)
    with pytest.raises((TypeError, ValueError), match="delay_samples must not"):
        PathTolerance(delay_samples=-1.0)
