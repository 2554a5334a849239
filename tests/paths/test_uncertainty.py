"""The uncertainty of a secondary path and the guard filter: against a search over all errors within the tolerances."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kfopc_filterpy.paths import PathTolerance, fir_path, guard_filter, path_uncertainty
from kfopc_filterpy.paths.uncertainty import N_FREQUENCIES, guard_against

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
    np.testing.assert_array_equal(guard_against(tolerance, PATH), guard_filter(path_uncertainty(tolerance, PATH)))


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


@pytest.mark.parametrize(
    "tolerance", [PathTolerance(delay_samples=0.5), PathTolerance(1.0), PathTolerance(gain_db=3.0)]
)
def test_the_guard_has_the_response_wanted(tolerance: PathTolerance) -> None:
    """The share g to 0.15, which 48 taps reach; hardly any control where the error can exceed 100 %."""
    delta = tolerance.relative_error(OMEGA)
    guard = guard_filter(delta)
    share = 1.0 / (1.0 + np.abs(np.fft.rfft(guard, 512)) ** 2)
    np.testing.assert_allclose(share, np.clip(1.0 - delta**6, 0.0, 1.0), atol=0.15)
    assert share[delta >= 1.0].max(initial=0.0) < 0.1
    assert np.max(share * delta) < 0.7  # stable with a margin
    assert np.sum(guard[:12] ** 2) > 0.9 * np.sum(guard**2)  # minimum phase: the energy comes early


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
