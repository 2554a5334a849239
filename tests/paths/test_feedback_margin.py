"""Stability of the feedback loop against closed forms, poles, and a simulation of the loop."""

from __future__ import annotations

import control
import numpy as np
import pytest

from kfopc_filterpy.paths import feedback_margin, fir_path

FS = 8000.0


@pytest.mark.parametrize("gain", [0.5, -0.8, 0.05])
def test_one_tap_in_closed_form(gain: float) -> None:
    """1 / (1 - g z^-1): (1 + L)^-1 - 1/2 = (1 + g z^-1) / (1 - g z^-1) / 2, largest where g z^-1 = |g|."""
    margin = feedback_margin([gain], [0.0, 1.0], fs=FS)
    g = abs(gain)
    disk = 2 * (1 - g) / (1 + g)
    assert margin.stable
    assert margin.disk_margin == pytest.approx(disk, rel=1e-6)
    assert margin.gain_margin_db == pytest.approx(20 * np.log10((1 + disk / 2) / (1 - disk / 2)), rel=1e-6)  # 1/g
    assert margin.gain_margin_db == pytest.approx(-20 * np.log10(g), rel=1e-6)
    assert margin.phase_margin_deg == pytest.approx(np.rad2deg(2 * np.arctan(disk / 2)), rel=1e-6)
    assert margin.frequency_hz == (0.0 if gain > 0 else FS / 2)
    closed = control.feedback(1, margin.loop)  # python-control's own sign convention: 1 / (1 + loop)
    assert np.abs(control.poles(closed)).max() == pytest.approx(g, rel=1e-9)
    assert closed(1.0).real == pytest.approx(1 / (1 - gain), rel=1e-9)


def test_margins_are_the_least_over_all_frequencies() -> None:
    rng = np.random.default_rng(0)
    w, f = 0.2 * rng.standard_normal(12), np.concatenate(([0.0], 0.3 * rng.standard_normal(9)))
    margin = feedback_margin(w, f, fs=FS)
    omega = np.linspace(0.0, np.pi * FS, 16385)
    disk, gain_db, phase_deg = control.disk_margins(margin.loop, omega)
    assert margin.disk_margin == pytest.approx(disk, rel=1e-3)
    assert margin.gain_margin_db == pytest.approx(gain_db, rel=1e-3)
    assert margin.phase_margin_deg == pytest.approx(phase_deg, rel=1e-3)


def test_stability_is_that_of_the_poles() -> None:
    rng = np.random.default_rng(1)
    outcomes = set()
    for _ in range(40):
        w, left = rng.standard_normal(8), np.concatenate(([0.0], rng.standard_normal(5)))
        w *= rng.uniform(0.05, 0.6)
        taps = -np.convolve(w, left)
        taps[0] += 1.0
        stable = bool(np.abs(np.roots(taps)).max() < 1.0)
        assert feedback_margin(w, left, fs=FS).stable == stable
        outcomes.add(stable)
    assert outcomes == {True, False}


def test_an_estimate_widens_the_margin() -> None:
    w, f = [0.5, 0.3], fir_path([0.0, 0.8, 0.4], FS)
    alone = feedback_margin(w, f)
    neutralised = feedback_margin(w, f, [0.0, 0.7, 0.4, 0.01])
    exact = feedback_margin(w, f, f)
    assert 0.0 <= alone.disk_margin < neutralised.disk_margin < exact.disk_margin == pytest.approx(2.0)
    left = np.array([0.0, 0.1, 0.0, -0.01])
    np.testing.assert_allclose(neutralised.loop(1j), -np.polyval(np.convolve(w, left)[::-1], 1 / 1j), atol=1e-12)


def test_the_words() -> None:
    assert repr(feedback_margin([2.0], [0.0, 1.0], fs=FS)) == "<FeedbackMargin: unstable>"
    assert "least at 0 Hz" in repr(feedback_margin([0.5], [0.0, 1.0], fs=FS))


def test_what_is_refused() -> None:
    with pytest.raises(ValueError, match="delay of a sample at least"):
        feedback_margin([1.0], [0.5, 1.0], fs=FS)
    with pytest.raises(ValueError, match="takes one channel"):
        feedback_margin(np.ones((1, 1, 4)), [0.0, 1.0], fs=FS)
    with pytest.raises(ValueError, match="fs"):
        feedback_margin([1.0], [0.0, 1.0])
    with pytest.raises(ValueError, match="feedback_estimate"):
        feedback_margin([1.0], [0.0, 1.0], fir_path([0.0, 1.0], 2 * FS), fs=FS)
