"""Stability of the loops against closed forms, poles, python-control, and a run of the loop."""

from __future__ import annotations

from copy import deepcopy

import control
import numpy as np
import pytest

from kfopc_filterpy import FxLMS, simulate
from kfopc_filterpy.controllers import with_internal_model
from kfopc_filterpy.paths import feedback_margin, fir_path, internal_model_margin

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


# The loop of an internal model.


@pytest.mark.parametrize("gain", [0.5, -0.8])
def test_one_tap_behind_an_internal_model_in_closed_form(gain: float) -> None:
    """T = g z^-2 with s^ = z^-1: a path (1 + delta) z^-1 gives 1 + g delta z^-2 = 0, on the circle at |delta| = 1/|g|."""
    margin = internal_model_margin([gain], [0.0, 1.0], fs=FS)
    assert margin.path_error == pytest.approx(1 / abs(gain), rel=1e-12)
    np.testing.assert_allclose(margin.path_error_at([0.0, 1000.0, FS / 2]), 1 / abs(gain), rtol=1e-12)
    # 1/|1/2 - T| is the disk margin: the least where T = -|g|
    assert margin.disk_margin == pytest.approx(1 / (0.5 + abs(gain)), rel=1e-6)
    for error in (0.99, 1.01):
        wrong = [0.0, 1 + error / abs(gain)]
        assert internal_model_margin([gain], wrong, [0.0, 1.0], fs=FS).stable == (error < 1)
    silent = internal_model_margin([0.0], [0.0, 1.0], fs=FS)
    assert (silent.path_error, silent.disk_margin) == (np.inf, pytest.approx(2.0))


def test_the_margins_are_those_of_python_control_and_the_poles() -> None:
    rng = np.random.default_rng(2)
    outcomes = set()
    for _ in range(20):
        w, s = rng.standard_normal(6), np.concatenate(([0.0], rng.standard_normal(4)))
        w *= rng.uniform(0.1, 1.0)
        estimate = s + 0.5 * rng.standard_normal(5)
        margin = internal_model_margin(w, s, estimate, fs=FS)
        closed = np.convolve(np.append(0.0, w), s - estimate)  # 1 + z^-1 W (S - S^)
        closed[0] += 1.0
        stable = bool(np.abs(np.roots(closed)).max() < 1.0)
        assert margin.stable == stable
        outcomes.add(stable)
        if stable:
            omega = np.linspace(0.0, np.pi * FS, 500)
            every = control.disk_margins(margin.loop, omega, skew=-1.0, returnall=True)[0]
            np.testing.assert_allclose(margin.path_error_at(omega / (2 * np.pi)), every, rtol=1e-6)
            balanced = control.disk_margins(margin.loop, omega)[0]
            for least, coarse in ((margin.path_error, every.min()), (margin.disk_margin, balanced)):
                assert least <= coarse * (1 + 1e-6)
                assert least == pytest.approx(coarse, rel=0.02)  # of a coarser grid
    assert outcomes == {True, False}


def test_a_settled_controller_is_unstable_where_its_margin_ends() -> None:
    """The gain of the path grows until the margin says unstable; just below, a run of the frozen controller dies away."""
    s = np.array([0.0, 0.9])
    controller = with_internal_model(FxLMS(8, s, step_size=0.01))
    d = np.sin(0.3 * np.arange(4000)) + 0.3 * np.random.default_rng(0).standard_normal(4000)
    simulate(controller, None, disturbance=d, secondary_path=s)
    gains = np.arange(1.0, 10.0, 0.02)
    stable = [internal_model_margin(controller.control_filter, g * s, s, fs=FS).stable for g in gains]
    end = gains[stable.index(False)]
    assert end - 1.0 >= internal_model_margin(controller.control_filter, s, fs=FS).path_error - 0.02
    for gain, dies in ((0.97 * end, True), (1.03 * end, False)):
        frozen, loudest, y = deepcopy(controller), [], 0.0
        for n in range(2000):
            e = float(n == 0) - gain * 0.9 * y  # y of the sample before
            y = frozen.process(None, [e], adapt=False)[0]
            loudest.append(abs(e))
        assert (max(loudest[-100:]) < max(loudest[100:200])) == dies


def test_the_words() -> None:
    assert repr(feedback_margin([2.0], [0.0, 1.0], fs=FS)) == "<FeedbackMargin: unstable>"
    assert "least at 0 Hz" in repr(feedback_margin([0.5], [0.0, 1.0], fs=FS))


def test_what_is_refused() -> None:
    with pytest.raises(ValueError, match="delay of at least one sample"):
        feedback_margin([1.0], [0.5, 1.0], fs=FS)
    with pytest.raises(ValueError, match="internal_model_margin takes one channel"):
        internal_model_margin([1.0], np.ones((1, 1, 4)), fs=FS)
    with pytest.raises(ValueError, match="secondary_estimate"):
        internal_model_margin([1.0], [0.0, 1.0], fir_path([0.0, 1.0], 2 * FS), fs=FS)
    with pytest.raises(ValueError, match="feedback_margin takes one channel"):
        feedback_margin(np.ones((1, 1, 4)), [0.0, 1.0], fs=FS)
    with pytest.raises(ValueError, match="fs"):
        feedback_margin([1.0], [0.0, 1.0])
    with pytest.raises(ValueError, match="feedback_estimate"):
        feedback_margin([1.0], [0.0, 1.0], fir_path([0.0, 1.0], 2 * FS), fs=FS)
