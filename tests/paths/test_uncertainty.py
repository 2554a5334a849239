"""The uncertainty of a secondary path and the guard filter: against a search over all errors within the tolerances."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kfopc_filterpy.paths import PathTolerance, fir_path, guard_filter, path_uncertainty
from kfopc_filterpy.paths.uncertainty import N_FREQUENCIES, allowed_share

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


@pytest.mark.parametrize("size", [300, 513, 5000])
def test_no_peak_of_a_finer_array_is_lost(size: int) -> None:
    fine = np.zeros(size)
    for place in (0, 1, size // 3, size // 2 + 1, size - 2):
        fine[place] = 3.0
        assert path_uncertainty(fine, PATH).max() == 3.0
        assert guard_filter(fine, PATH) is not None
        assert np.argmax(path_uncertainty(fine, PATH)) == pytest.approx(place / (size - 1) * 256, abs=0.51)
        fine[place] = 0.0


def test_what_needs_no_guard_has_none() -> None:
    """A tolerance whose relative error stays well below 1 allows the whole control filter."""
    for exact in (None, 0.0, PathTolerance(), PathTolerance(gain_db=3.0), PathTolerance(phase_deg=45.0)):
        assert guard_filter(exact, PATH) is None
        np.testing.assert_array_equal(allowed_share(exact, PATH), 1.0)


def test_a_tolerance_allows_control_at_larger_errors_than_their_size_alone() -> None:
    """Up to 135 degrees, with several loudspeakers up to 90; not with more microphones than loudspeakers."""
    tolerance = PathTolerance(delay_samples=1.0)
    delta = path_uncertainty(tolerance, PATH)
    in_any_direction = np.clip(1.0 - delta**6, 0.0, 1.0)
    np.testing.assert_array_equal(allowed_share(tolerance, PATH), tolerance.share(OMEGA))
    np.testing.assert_allclose(allowed_share(delta, PATH), in_any_direction, atol=1e-12)
    for more_microphones in (np.ones((2, 1, 4)), np.ones((3, 2, 4))):
        np.testing.assert_allclose(allowed_share(tolerance, more_microphones), in_any_direction, atol=1e-12)
    for several in (np.ones((1, 2, 4)), np.ones((2, 2, 4)), np.ones((2, 3, 4))):
        wanted = np.where(np.pi / 2 >= OMEGA, tolerance.share(OMEGA), 0.0)
        np.testing.assert_array_equal(allowed_share(tolerance, several), wanted)
        np.testing.assert_allclose(allowed_share(delta, several), in_any_direction, atol=1e-12)
    np.testing.assert_array_equal(guard_filter(tolerance, PATH[np.newaxis, np.newaxis]), guard_filter(tolerance, PATH))
    np.testing.assert_allclose(guard_filter([0.0, 1.0], PATH), guard_filter(OMEGA / np.pi, PATH), atol=1e-12)


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
    guard = guard_filter(np.array([[1.0, 0.1, 1.0]]), notch)
    assert guard is not None
    assert np.isfinite(guard).all()
    assert response(guard)[128] < 0.1


def response(guard: np.ndarray | None) -> np.ndarray:
    """The share g = 1/(1 + |W|^2) of a guard filter."""
    assert guard is not None
    return 1.0 / (1.0 + np.abs(np.fft.rfft(guard, 512)) ** 2)


def louder_db(share: np.ndarray | float, phase: np.ndarray | float, gain_db: float) -> float:
    """The most that any g up to a share makes the noise louder, over all phases and gains within the tolerances.

    Searched with u = g/(1 - g), because E/D = 1/(1 + u (1 + Delta)).
    """
    steps = np.linspace(0.0, 1.0, 81)
    largest = np.asarray(share) / (1.0 - np.minimum(share, 1.0 - 1e-12))
    u = steps[:, None, None] ** 2 * largest
    ratios = np.exp(1j * np.linspace(0.8, 1.0, 5)[:, None] * phase)
    gains = 10 ** (gain_db * np.linspace(-1.0, 1.0, 9) / 20)
    return float(max(np.max(-20 * np.log10(np.abs(1.0 + u * gain * ratios))) for gain in gains))


@given(phase=st.floats(0.0, 180.0), gain=st.floats(0.0, 20.0))
def test_no_share_of_a_tolerance_makes_a_frequency_louder_by_more_than_3_db(phase: float, gain: float) -> None:
    """And below 90 degrees by nothing. The adaptation settles: g delta < 1 for the largest error that a search finds."""
    share = PathTolerance(phase_deg=phase, gain_db=gain).share(np.array([0.0]))[0]
    louder = louder_db(share, np.deg2rad(phase), gain)
    assert louder <= (1e-9 if phase <= 90.0 else 20 * np.log10(np.sqrt(2.0)) + 1e-9)
    ratios = np.exp(1j * np.deg2rad(phase)) * 10 ** (gain * np.linspace(-1.0, 1.0, 21) / 20)
    assert share * np.max(np.abs(ratios - 1.0)) <= 0.94 + 1e-9
    if phase > 135.001:
        assert share == 0.0
    else:  # and no more is held back than that takes
        assert share == 1.0 or share * np.max(np.abs(ratios - 1.0)) == pytest.approx(0.94)


@pytest.mark.parametrize(
    "tolerance",
    [
        *map(PathTolerance, (0.5, 1.0, 2.0, 8.0)),
        PathTolerance(1.0, 20.0, 2.0),
        PathTolerance(1.0, gain_db=12.0),
        PathTolerance(phase_deg=130.0, gain_db=20.0),
        PathTolerance(phase_deg=180.0, gain_db=20.0),
    ],
)
def test_the_guard_of_a_tolerance_keeps_what_its_share_promises(tolerance: PathTolerance) -> None:
    """Although 48 taps need a twelfth of the band for a steep fall: settles, and louder by 3.3 dB at most, with any g."""
    share, wanted = response(guard_filter(tolerance, PATH)), tolerance.share(OMEGA)
    assert np.max(share * tolerance.relative_error(OMEGA)) < 0.97
    phase = np.minimum(np.deg2rad(tolerance.phase_deg) + tolerance.delay_samples * OMEGA, np.pi)
    assert louder_db(share, phase, tolerance.gain_db) < 3.3
    if tolerance.delay_samples < 8.0:  # whose share changes too fast everywhere
        jumps = np.pad(wanted == 0.0, 21, mode="edge")
        gentle = np.convolve(jumps, np.ones(43), mode="valid") % 43 == 0
        np.testing.assert_allclose(share[gentle], np.maximum(wanted, 0.03)[gentle], atol=0.05)


def test_the_guard_of_a_relative_error_has_the_response_wanted() -> None:
    """Where it falls steeply, 48 taps make it fall too early; hardly any control where the error can exceed 100 %."""
    for tolerance in (PathTolerance(0.5), PathTolerance(1.0), PathTolerance(gain_db=3.0)):
        delta = tolerance.relative_error(OMEGA)
        share = response(guard_filter(delta, PATH))
        difference = share - np.clip(1.0 - delta**6, 0.0, 1.0)
        assert difference.min() > -0.25
        assert difference.max() < 0.05
        np.testing.assert_allclose(difference[delta < 0.7], 0.0, atol=0.04)
        assert share[delta >= 1.1].max(initial=0.0) < 0.1
        assert np.max(share * delta) < 0.7  # stable with a margin


@pytest.mark.parametrize("n_frequencies", [1, 5, 40, N_FREQUENCIES])
@pytest.mark.parametrize("height", [3.0, 100.0])
def test_a_peak_of_a_relative_error_is_guarded_against(n_frequencies: int, height: float) -> None:
    """A resonance that has moved, for example, in a few of 257 frequencies, wherever it is; control elsewhere goes on."""
    for first in (0, 100, N_FREQUENCIES - n_frequencies):
        delta = np.full(N_FREQUENCIES, 0.1)
        delta[first : first + n_frequencies] = height
        share = response(guard_filter(delta, PATH))
        assert np.max(share * delta) < 0.64
        if n_frequencies < 40:
            assert share[200 if first < 200 else 50] > 0.95
        if n_frequencies == N_FREQUENCIES and first == 0:  # no edge; an error of -delta: louder by 3.1 dB at most
            assert np.max((1.0 - share) / (1.0 - share * delta)) < 1 / 0.7


def test_a_guard_is_minimum_phase_and_does_not_overshoot() -> None:
    """A constant penalty is kept; where it rises, it stays between the smallest and the largest."""
    delta = np.full(N_FREQUENCIES, 0.8)
    penalty = 0.8**6 / (1.0 - 0.8**6)
    np.testing.assert_allclose(1.0 / response(guard_filter(delta, PATH)) - 1.0, penalty, rtol=1e-6)
    guard = guard_filter(PathTolerance(1.0), PATH)
    assert guard is not None
    power = np.abs(np.fft.rfft(guard, 512)) ** 2
    assert power.max() < 1.001 * (1.0 - 0.03) / 0.03
    assert 1e-4 < power.min() < 3e-4
    assert np.all(np.diff(power[110:]) > -1e-3 * power.max())  # rises, and never overshoots
    assert np.abs(np.roots(guard)).max() < 1.0


@pytest.mark.parametrize(
    ("uncertainty", "path", "message"),
    [
        (-0.1, PATH, "secondary_path_uncertainty must"),
        ([0.1, -0.2], PATH, r"zero or above at two or more frequencies .*; a measured path is \(1, n_taps\)"),
        ([0.1, np.inf], PATH, "secondary_path_uncertainty"),
        (np.ones((2, 4)), np.ones((2, 2, 4)), r"must be \(M, 2, 2, n_taps\)"),
        ("much", PATH, "real numbers, got str; give a PathTolerance, a relative error"),
        ([PathTolerance()], PATH, "real numbers, got list; give a PathTolerance, a relative error"),
    ],
)
def test_what_is_refused(uncertainty: Any, path: np.ndarray, message: str) -> None:
    with pytest.raises((TypeError, ValueError), match=message):
        path_uncertainty(uncertainty, path)
    with pytest.raises((TypeError, ValueError), match=message):
        guard_filter(uncertainty, path)


def test_what_a_tolerance_refuses() -> None:
    with pytest.raises(ValueError, match="delay_samples must not be negative"):
        PathTolerance(delay_samples=-1.0)
    with pytest.raises(ValueError, match="gain_db must be at most 20, got 21: a path that is known no better"):
        PathTolerance(gain_db=21.0)
    assert type(PathTolerance(delay_samples=np.array([0.5])).delay_samples) is float  # type: ignore[arg-type]
