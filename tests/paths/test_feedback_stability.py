"""Stability of the loops against closed forms, poles, python-control, and a run of the loop."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import control
import numpy as np
import pytest

from kfopc_filterpy import Plant, fx_lms, simulate
from kfopc_filterpy.controllers import with_internal_model
from kfopc_filterpy.paths import feedback_margin, fir_path, internal_model_margin

FS = 8000.0
DELAY = np.array([0.0, 1.0])


def heard(path: Any) -> Plant:
    """Return a plant with an acoustic feedback path; its secondary path does not matter."""
    return Plant(path[:1] if np.ndim(path) == 3 else path, feedback=path, fs=FS)


def loop_of(margin: Any) -> control.TransferFunction:
    """Return the loop of one channel in python-control's sign convention: ``1 / (1 + loop)`` is the sensitivity."""
    w, path, estimate = (control.TransferFunction(t[0, 0], np.eye(1, t.shape[2])[0], 1 / FS) for t in margin.paths)
    return w * path / (1 - w * estimate)


def played(path: Any) -> Plant:
    return Plant(path, fs=FS)


@pytest.mark.parametrize("gain", [0.5, -0.8, 0.05])
def test_one_tap_in_closed_form(gain: float) -> None:
    """1 / (1 - g z^-1): (1 + L)^-1 - 1/2 = (1 + g z^-1) / (1 - g z^-1) / 2, largest where g z^-1 = |g|."""
    margin = feedback_margin([gain], heard(DELAY))
    g = abs(gain)
    disk = 2 * (1 - g) / (1 + g)
    assert margin.stable
    assert margin.disk_margin == pytest.approx(disk, rel=1e-6)
    assert margin.gain_margin_db == pytest.approx(20 * np.log10((1 + disk / 2) / (1 - disk / 2)), rel=1e-6)  # 1/g
    assert margin.gain_margin_db == pytest.approx(-20 * np.log10(g), rel=1e-6)
    assert margin.phase_margin_deg == pytest.approx(np.rad2deg(2 * np.arctan(disk / 2)), rel=1e-6)
    assert margin.frequency_hz == (0.0 if gain > 0 else FS / 2)
    closed = control.feedback(1, loop_of(margin))  # python-control's own sign convention: 1 / (1 + loop)
    assert np.abs(control.poles(closed)).max() == pytest.approx(g, rel=1e-9)
    assert closed(1.0).real == pytest.approx(1 / (1 - gain), rel=1e-9)


def test_margins_are_the_least_over_all_frequencies() -> None:
    rng = np.random.default_rng(0)
    w, f = 0.2 * rng.standard_normal(12), np.concatenate(([0.0], 0.3 * rng.standard_normal(9)))
    margin = feedback_margin(w, heard(f))
    omega = np.linspace(0.0, np.pi * FS, 16385)
    disk, gain_db, phase_deg = control.disk_margins(loop_of(margin), omega)
    assert margin.disk_margin == pytest.approx(disk, rel=1e-3)
    assert margin.gain_margin_db == pytest.approx(gain_db, rel=1e-3)
    assert margin.phase_margin_deg == pytest.approx(phase_deg, rel=1e-3)


def test_an_estimate_widens_the_margin() -> None:
    w, plant = [0.5, 0.3], heard([0.0, 0.8, 0.4])
    alone = feedback_margin(w, plant)
    neutralised = feedback_margin(w, plant, [0.0, 0.7, 0.4, 0.01])
    exact = feedback_margin(w, plant, plant.feedback)
    assert 0.0 <= alone.disk_margin < neutralised.disk_margin < exact.disk_margin == pytest.approx(2.0)
    left = np.array([0.0, 0.1, 0.0, -0.01])
    np.testing.assert_allclose(loop_of(neutralised)(1j), -np.polyval(np.convolve(w, left)[::-1], 1 / 1j), atol=1e-12)


# The loop of an internal model.


@pytest.mark.parametrize("gain", [0.5, -0.8])
def test_one_tap_behind_an_internal_model_in_closed_form(gain: float) -> None:
    """T = g z^-2 with s^ = z^-1: a path (1 + delta) z^-1 gives 1 + g delta z^-2 = 0, on the circle at |delta| = 1/|g|."""
    margin = internal_model_margin([gain], played(DELAY))
    assert margin.path_error == pytest.approx(1 / abs(gain), rel=1e-12)
    np.testing.assert_allclose(margin.path_error_at([0.0, 1000.0, FS / 2]), 1 / abs(gain), rtol=1e-12)
    # 1/|1/2 - T| is the disk margin: the least where T = -|g|
    assert margin.disk_margin == pytest.approx(1 / (0.5 + abs(gain)), rel=1e-6)
    for error in (0.99, 1.01):
        wrong = played((1 + error / abs(gain)) * DELAY)
        assert internal_model_margin([gain], wrong, DELAY).stable == (error < 1)
    silent = internal_model_margin([0.0], played(DELAY))
    assert (silent.path_error, silent.disk_margin) == (np.inf, pytest.approx(2.0))


def test_the_margins_are_those_of_python_control_and_the_poles() -> None:
    rng = np.random.default_rng(2)
    outcomes = set()
    for _ in range(20):
        w, s = rng.standard_normal(6), np.concatenate(([0.0], rng.standard_normal(4)))
        w *= rng.uniform(0.1, 1.0)
        estimate = s + 0.5 * rng.standard_normal(5)
        margin = internal_model_margin(w, played(s), estimate)
        closed = np.convolve(np.append(0.0, w), s - estimate)  # 1 + z^-1 W (S - S^)
        closed[0] += 1.0
        stable = bool(np.abs(np.roots(closed)).max() < 1.0)
        assert margin.stable == stable
        outcomes.add(stable)
        if stable:
            omega = np.linspace(0.0, np.pi * FS, 500)
            every = control.disk_margins(loop_of(margin), omega, skew=-1.0, returnall=True)[0]
            np.testing.assert_allclose(margin.path_error_at(omega / (2 * np.pi)), every, rtol=1e-6)
            balanced = control.disk_margins(loop_of(margin), omega)[0]
            for least, coarse in ((margin.path_error, every.min()), (margin.disk_margin, balanced)):
                assert least <= coarse * (1 + 1e-6)
                assert least == pytest.approx(coarse, rel=0.02)  # of a coarser grid
    assert outcomes == {True, False}


@pytest.mark.parametrize("gains", [0.9, [[0.9, 0.4], [0.3, -0.8]]])
def test_a_settled_controller_is_unstable_where_its_margin_ends(gains: Any) -> None:
    """The gain of the path grows until the margin says unstable; just below, a run of the frozen controller dies away."""
    gains = np.array(gains)
    s = np.stack((np.zeros_like(gains), gains), axis=-1)
    controller = with_internal_model(fx_lms(8, s, step_size=0.01, n_references=len(np.atleast_1d(gains))))
    d = np.sin(0.3 * np.arange(4000)) + 0.3 * np.random.default_rng(0).standard_normal((*gains.shape[:1], 4000))
    simulate(controller, None, played(s), disturbance=d)

    def stable(gain: float) -> bool:
        return internal_model_margin(controller.control_filter, played(gain * s), s).stable

    inside, outside = 1.0, 20.0
    assert stable(inside)
    assert not stable(outside)
    while outside - inside > 0.01:
        middle = (inside + outside) / 2
        inside, outside = (middle, outside) if stable(middle) else (inside, middle)
    assert outside - 1.0 >= internal_model_margin(controller.control_filter, played(s)).path_error
    for gain, dies in ((0.97 * inside, True), (1.03 * outside, False)):
        frozen, loudest, y = deepcopy(controller), [], np.zeros(gains.shape[:1])
        for n in range(2000):
            e = float(n == 0) - gain * np.dot(gains, y)  # y of the sample before
            y = frozen.process(None, e[..., np.newaxis], adapt=False)[..., 0]
            loudest.append(np.abs(e).max())
        assert (max(loudest[-100:]) < max(loudest[100:200])) == dies


# Several channels.


def random_loop(rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Return a control filter, a path with a delay and an estimate of it, of one channel."""
    s = np.append(0.0, rng.standard_normal(4))
    return 0.3 * rng.standard_normal(6), s, s + 0.3 * rng.standard_normal(5)


def side_by_side(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.array([[one, np.zeros_like(one)], [np.zeros_like(other), other]])


@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_loops_side_by_side_have_the_lesser_margin_and_turned_microphones_do_not_change_it(angle: float) -> None:
    """Microphones that hear sums of the signals, by an orthogonal matrix, and filters that undo this."""
    rng, outcomes = np.random.default_rng(0), set()
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    for _ in range(6):
        loops = random_loop(rng), random_loop(rng)
        alone = [internal_model_margin(w, played(s), estimate) for w, s, estimate in loops]
        w, *paths = (side_by_side(*both) for both in zip(*loops, strict=True))
        s, estimate = (np.einsum("kc,cjt->kjt", turn, path) for path in paths)
        margin = internal_model_margin(np.einsum("jct,kc->jkt", w, turn), played(s), estimate)
        outcomes.add(margin.stable)
        assert margin.stable == all(one.stable for one in alone)
        for name in ("disk_margin", "path_error", "gain_margin_db", "phase_margin_deg"):
            least = min(getattr(one, name) for one in alone) if margin.stable else 0.0
            assert getattr(margin, name) == pytest.approx(least, rel=1e-9)
        if margin.stable:
            least_at = np.min([one.path_error_at([100.0, 3000.0]) for one in alone], axis=0)
            np.testing.assert_allclose(margin.path_error_at([100.0, 3000.0]), least_at, rtol=1e-9)
    assert outcomes == {True, False}


def test_stability_of_several_channels_is_that_of_the_poles() -> None:
    """The determinant of I - F W in polynomials, and its zeros."""
    rng, outcomes = np.random.default_rng(3), set()
    for _ in range(12):
        w, f = rng.standard_normal((2, 2, 5)), np.pad(rng.standard_normal((2, 2, 3)), ((0, 0), (0, 0), (1, 0)))
        w *= rng.uniform(0.02, 0.3)
        left = [[-sum(np.convolve(f[i, j], w[j, k]) for j in range(2)) for k in range(2)] for i in range(2)]
        for i in range(2):
            left[i][i][0] += 1.0
        determinant = np.convolve(left[0][0], left[1][1]) - np.convolve(left[0][1], left[1][0])
        stable = bool(np.abs(np.roots(determinant)).max() < 1.0)
        assert feedback_margin(w, heard(f)).stable == stable
        outcomes.add(stable)
    assert outcomes == {True, False}


@pytest.mark.parametrize(("n_microphones", "n_loudspeakers"), [(2, 2), (1, 3), (3, 1), (2, 3)])
@pytest.mark.parametrize("side", ["microphones", "loudspeakers"])
def test_the_tolerated_error_is_the_least_that_makes_the_loop_unstable(
    n_microphones: int, n_loudspeakers: int, side: str
) -> None:
    """One tap each, so T = z^-3 times a constant matrix: its largest singular value is reached by an error of rank one."""
    rng = np.random.default_rng(4)
    w, s = np.zeros((n_loudspeakers, n_microphones, 4)), np.zeros((n_microphones, n_loudspeakers, 4))
    w[..., 1], s[..., 1] = rng.standard_normal(w.shape[:2]), rng.standard_normal(s.shape[:2])
    constant = s[..., 1] @ w[..., 1] if side == "microphones" else w[..., 1] @ s[..., 1]
    left, values, right = np.linalg.svd(constant)
    margin = internal_model_margin(w, played(s))
    other = w[..., 1] @ s[..., 1] if side == "microphones" else s[..., 1] @ w[..., 1]
    assert margin.path_error == pytest.approx(1 / max(values[0], np.linalg.norm(other, 2)), rel=1e-9)
    for share in (0.99, 1.01):
        factor = np.eye(len(constant)) + share / values[0] * np.outer(right[0], left[:, 0])
        wrong = np.einsum("kc,cjt->kjt", factor, s) if side == "microphones" else np.einsum("kct,cj->kjt", s, factor)
        assert internal_model_margin(w, played(wrong), s).stable == (share < 1)


def test_of_a_hybrid_filter_the_rows_of_the_disturbances_count() -> None:
    w, s, estimate = random_loop(np.random.default_rng(5))
    rows = np.stack((np.ones_like(w), w))[np.newaxis]
    assert internal_model_margin(rows, played(s), estimate) == internal_model_margin(w, played(s), estimate)


OTHER_RATE = fir_path(DELAY, 2 * FS)
REFUSED: list[tuple[Any, str]] = [
    (lambda: feedback_margin([1.0], Plant([1.0], fs=FS)), "plant must have a feedback path"),
    (lambda: feedback_margin([1.0], heard(DELAY), [0.5, 1.0]), "estimate must have a delay of at least one sample"),
    (lambda: feedback_margin([1.0], heard(DELAY), OTHER_RATE), "estimate is sampled at 16000 Hz but fs is 8000 Hz"),
    (lambda: feedback_margin(np.ones((1, 2, 4)), heard(DELAY)), r"control_filter must be \(1 loudspeakers, 1 microph"),
    (
        lambda: feedback_margin([1.0], heard(DELAY).changed_at(1.0, feedback=-DELAY)),
        "needs a plant that does not change",
    ),
    (
        lambda: internal_model_margin(np.ones(4), played(np.ones((1, 2, 4)))),
        r"control_filter must be \(2 loudspeakers, 1 microphones",
    ),
    (lambda: internal_model_margin([1.0], played(DELAY), np.ones((2, 1, 4))), "estimate must have the channels of the"),
    (lambda: internal_model_margin([1.0], played(DELAY), OTHER_RATE), "estimate is sampled at 16000 Hz"),
]


@pytest.mark.parametrize(("call", "message"), REFUSED, ids=range(len(REFUSED)))
def test_what_is_refused(call: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()
