"""A secondary path that changes during the run, and the tracker that follows it."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
from helpers.changing_plant import FS, N_PATH, noises, reduction_db, resonant_path, run
from scipy.special import stdtr

from kfopc_filterpy import FxLMS, FxNLMS, HardClipAmplifier, OutputLimiter, kf_anc, kf_pb, simulate
from kfopc_filterpy.controllers import PathTracker
from kfopc_filterpy.controllers.path_tracker import Evidence, JointFit, block_sums
from kfopc_filterpy.paths import identify_secondary_path

L = 64
BEFORE, AFTER = resonant_path(5, 600.0, 0.8, 1.0), resonant_path(8, 900.0, 0.85, 0.7)
KALMAN: dict[str, Any] = {"state_noise": 1e-9, "measurement_noise": 0.01, "initial_variance": 0.1}
MAKERS: dict[str, Any] = {
    "FxLMS": lambda s: FxLMS(L, s, step_size=0.0005),
    "FxNLMS": lambda s: FxNLMS(L, s, step_size=0.02),
    "KF-ANC": lambda s: kf_anc(L, s, **KALMAN),
    "KF-PB": lambda s: kf_pb(L, s, rated_power=4.0, fs=FS, **KALMAN),
}


def tracked(name: str, path: np.ndarray = BEFORE, **settings: Any) -> PathTracker:
    return PathTracker(MAKERS[name](path), **{"rng": 3, "fs": FS} | settings)


def misalignment_db(estimate: np.ndarray, path: np.ndarray) -> float:
    return float(10 * np.log10(np.sum((estimate - path) ** 2) / np.sum(path**2)))


@pytest.mark.parametrize("name", MAKERS)
def test_after_a_jump_it_is_as_good_as_one_that_was_identified_anew(name: str) -> None:
    x, d = noises(12.0)

    def path_at(t: float) -> np.ndarray:
        return BEFORE if t < 2.0 else AFTER

    tracker = tracked(name)
    error, emitted = run(tracker, x, d, path_at)
    anew = identify_secondary_path(AFTER, n_taps=N_PATH, duration_s=1.0, rng=5, fs=FS, sensor_noise_std=0.05)
    plant: dict[str, Any] = {"secondary_path": AFTER, "fs": FS}
    fresh = simulate(MAKERS[name](anew.taps), x[round(2 * FS) :], disturbance=d[round(2 * FS) :], **plant)
    stale = simulate(MAKERS[name](BEFORE), x, disturbance=d, **plant)
    assert stale.diverged_at_s is not None or reduction_db(stale.error, d, 9.0, 12.0) < 0.0
    assert 2.0 < tracker.changes[0].time_s < 6.0
    assert reduction_db(error, d, 11.0, 12.0) > reduction_db(fresh.error, d[round(2 * FS) :], 9.0, 10.0) - 1.0
    assert misalignment_db(tracker.secondary_path, AFTER) < -8.0
    # Held at 6 dB; a first estimate that is still rough may let the error grow further before a better one follows.
    tenths = np.mean(error.reshape(-1, 800) ** 2, axis=1) / np.mean(d**2)
    assert 10 * np.log10(tenths.max()) < 18.0
    assert np.abs(emitted).max() < 30.0


def test_a_drift_over_ten_seconds_is_followed() -> None:
    x, d = noises(22.0)
    paths = [resonant_path(5 + 3 * a, 600 + 300 * a, 0.8 + 0.05 * a, 1 - 0.3 * a) for a in np.linspace(0, 1, 201)]

    def path_at(t: float) -> np.ndarray:
        return paths[round(200 * np.clip((t - 2.0) / 10.0, 0.0, 1.0))]

    tracker = tracked("KF-ANC")
    error, _ = run(tracker, x, d, path_at)
    alone, _ = run(MAKERS["KF-ANC"](BEFORE), x[: round(16 * FS)], d[: round(16 * FS)], path_at)
    assert not reduction_db(alone, d, 14.0, 16.0) > 0.0  # it diverges
    fresh = simulate(
        MAKERS["KF-ANC"](paths[-1]), x[round(12 * FS) :], disturbance=d[round(12 * FS) :], secondary_path=AFTER, fs=FS
    )
    assert len(tracker.changes) >= 2
    assert reduction_db(error, d, 2.0, 12.0) > 10.0
    assert reduction_db(error, d, 21.0, 22.0) > reduction_db(fresh.error, d[round(12 * FS) :], 9.0, 10.0) - 1.0


@pytest.mark.parametrize("name", ["FxLMS", "KF-ANC"])
def test_a_path_that_stays_is_kept_and_costs_little(name: str) -> None:
    x, d = noises(16.0)
    tracker = tracked(name)
    plant: dict[str, Any] = {"disturbance": d, "secondary_path": BEFORE, "fs": FS}
    followed, alone = simulate(tracker, x, **plant), simulate(MAKERS[name](BEFORE), x, **plant)
    assert tracker.changes == []
    loss = reduction_db(alone.error, d, 4.0, 16.0) - reduction_db(followed.error, d, 4.0, 16.0)
    assert 0.0 < loss < 0.1


@pytest.mark.parametrize("change", ["primary path", "level"])
def test_no_other_change_is_taken_for_one_of_the_path(change: str) -> None:
    """If the primary path changes and the filter follows, the control signal alone would suggest a wrong path."""
    x, d = noises(14.0)
    later = np.arange(x.size) > 4 * FS
    if change == "level":
        x, d = x * np.where(later, 10.0, 1.0), d * np.where(later, 10.0, 1.0)
    else:
        drift = np.clip((np.arange(x.size) / FS - 4.0) / 8.0, 0.0, 1.0)
        d = d + drift * (np.roll(d, 3) - d)
    tracker = tracked("KF-ANC")
    error, _ = run(tracker, x, d, lambda t: BEFORE)
    assert tracker.changes == []
    assert reduction_db(error, d, 10.0, 14.0) > 20.0


def test_the_updates_are_held_while_the_error_is_louder_than_without_control() -> None:
    x, d = noises(3.4)

    def path_at(t: float) -> np.ndarray:
        return BEFORE if t < 3.0 else -BEFORE

    loudest = []
    for hold_db in (6.0, 200.0):
        tracker = tracked("FxNLMS", hold_db=hold_db, p_value=1e-300)  # nothing is taken over
        error, _ = run(tracker, x, d, path_at)
        loudest.append(np.mean(error[-800:] ** 2) / np.mean(d**2))
    assert 10 * np.log10(loudest[0]) < 10.0  # 6 dB, and what it overshoots in the first frame
    assert loudest[1] > 2.0 * loudest[0]


def test_the_controller_does_not_hear_the_probe() -> None:
    x, d = noises(5.0)
    alone, tracker = MAKERS["FxLMS"](BEFORE), tracked("FxLMS", hold_db=200.0)
    clean, _ = run(alone, x, d, lambda t: BEFORE)
    error, _ = run(tracker, x, d, lambda t: BEFORE)
    np.testing.assert_allclose(tracker.weights, alone.weights, rtol=1e-9, atol=1e-12)
    # and the level of the probe is -20 dB of the residual noise
    heard = np.mean((error - clean)[-16000:] ** 2) / np.mean(error[-16000:] ** 2)
    assert 10 * np.log10(heard) == pytest.approx(-20.0, abs=0.5)


def test_the_probe_has_the_colour_of_its_filter() -> None:
    x, d = noises(2.0)
    tracker = tracked("FxLMS", probe_filter=[1.0, 1.0])
    _, emitted = run(tracker, x, d, lambda t: BEFORE)
    _, alone = run(MAKERS["FxLMS"](BEFORE), x, d, lambda t: BEFORE)
    probe = (emitted - alone)[8000:]
    # The correlation of neighbouring samples of a sum of two white neighbours is a half of its power.
    assert np.mean(probe[1:] * probe[:-1]) / np.mean(probe**2) == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("source", ["probe", "control signal"])
def test_the_fit_is_least_squares(source: str) -> None:
    """Against numpy's least squares on the rows written out, with the two penalties as further rows."""
    rng = np.random.default_rng(0)
    P, S, n = 9, 4, 200
    known = np.array([0.0, 1.0, 0.3, 0.0])
    fit = JointFit(P, S, 0.6)
    blocks = []
    for _ in range(3):
        x, y, v = rng.standard_normal((3, n + P - 1))
        e = rng.standard_normal(n)
        fit.add(block_sums(x, y, v, e, P, S))

        def rows(signal: np.ndarray, taps: int, start: int = P - 1, count: int = n) -> np.ndarray:
            return np.array([[signal[start + i - k] for k in range(taps)] for i in range(count)])

        blocks.append((rows(x, P), -rows(y, S), -rows(v, S), e))
    weights = [0.6, np.sqrt(0.6), 1.0]  # roots of 0.36, 0.6, 1
    rx, ry, rv = (np.vstack([w * block[i] for w, block in zip(weights, blocks, strict=True)]) for i in range(3))
    e = np.concatenate([w * block[3] for w, block in zip(weights, blocks, strict=True)])
    model = fit.solve(known)
    assert model is not None
    ridge = (e @ e) / (n * 1.96) * S / (known @ known)  # the first solution knows no residual: the error's own power
    penalty = np.sqrt(ridge) * np.eye(S)
    A = np.vstack((np.hstack((rx, ry + rv)), np.hstack((np.zeros((S, P)), penalty))))
    theta, *_ = np.linalg.lstsq(A, np.concatenate((e, penalty @ known)), rcond=None)
    if source == "control signal":
        np.testing.assert_allclose(model.primary, theta[:P], rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(model.secondary[source], theta[P:], rtol=1e-6, atol=1e-7)
    else:
        left = e - rx @ theta[:P] - ry @ theta[P:]
        probed, *_ = np.linalg.lstsq(np.vstack((rv, penalty)), np.concatenate((left, penalty @ known)), rcond=None)
        np.testing.assert_allclose(model.secondary[source], probed, rtol=1e-6, atol=1e-7)
    unexplained = np.sum((e - A[: e.size] @ theta) ** 2) / (n * 1.96)
    assert fit.noise == pytest.approx(unexplained, rel=1e-6)


def test_silence_has_no_solution() -> None:
    fit = JointFit(5, 2, 0.5)
    silent = np.zeros(54)
    fit.add(block_sums(silent, silent, silent, np.zeros(50), 5, 2))
    assert fit.solve(np.array([1.0, 0.0])) is None


def test_evidence_is_students_t_test_since_the_second_prediction_leads() -> None:
    rng = np.random.default_rng(0)
    evidence = Evidence()
    evidence.add(np.ones(5), 0.9 * np.ones(5))
    assert evidence.p_value == 1.0  # too few frames
    evidence.add(np.ones(20), 2.0 * np.ones(20))
    assert evidence.count == 0  # the first leads: begin anew
    first, second = 1.0 + 0.1 * rng.random((2, 30))
    first += 0.02
    evidence.add(first[:20], second[:20])
    evidence.add(first[20:], second[20:])
    shares = (first - second) / (first + second)
    t = shares.mean() / (shares.std(ddof=1) / np.sqrt(30))
    assert evidence.p_value == pytest.approx(stdtr(29, -t), rel=1e-6)
    assert evidence.mean == pytest.approx(shares.mean(), rel=1e-12)
    assert evidence.gain_db == pytest.approx(10 * np.log10(first.mean() / second.mean()), abs=0.01)


def test_a_wrong_estimate_is_replaced_before_the_control_begins() -> None:
    """Also what it hears while the loudspeaker is silent helps: it knows the primary path."""
    x, d = noises(8.0)
    tracker = tracked("FxNLMS", AFTER)
    result = simulate(tracker, x, disturbance=d, secondary_path=BEFORE, fs=FS, switch_on_s=1.0)
    assert tracker.changes
    assert all(change.source in ("probe", "control signal") for change in tracker.changes)
    assert all(change.memory_s in (1.0, 8.0) and change.prediction_gain_db > 0.0 for change in tracker.changes)
    assert tracker.changes[0].change_db == pytest.approx(
        misalignment_db(BEFORE, AFTER), abs=3.0
    )  # about the whole difference
    assert reduction_db(result.error, d[round(FS) :], 6.0, 7.0) > 20.0


def test_only_the_probe_may_be_asked() -> None:
    x, d = noises(6.0)
    tracker = tracked("FxLMS", -BEFORE, use_control_signal=False)
    run(tracker, x, d, lambda t: BEFORE)
    assert {change.source for change in tracker.changes} == {"probe"}


def test_a_known_amplifier_is_not_taken_for_a_change() -> None:
    """The fits know what the amplifier delivers, and the controller what the probe adds to it."""
    x, d = noises(6.0)
    clip = HardClipAmplifier(1.0)
    controller = kf_anc(L, BEFORE, amplifier=clip, **KALMAN)
    tracker = PathTracker(controller, rng=3, fs=FS, amplifier=clip)
    result = simulate(tracker, x, disturbance=d, secondary_path=BEFORE, fs=FS, amplifier=clip)
    assert np.abs(result.control_signal).max() > 1.2  # it does clip
    assert tracker.changes == []


def test_a_copy_goes_on_alike() -> None:
    x, d = noises(1.0)
    tracker = tracked("FxLMS")
    run(tracker, x, d, lambda t: BEFORE)
    other = copy.deepcopy(tracker)
    one, two = (run(each, x, d, lambda t: AFTER)[1] for each in (tracker, other))
    np.testing.assert_array_equal(one, two)
    assert repr(tracker).startswith(f"<FxLMS with path tracking: {len(tracker.changes)} change(s), <FxLMS: 64 taps")


def test_a_divergence_is_passed_on() -> None:
    tracker = tracked("FxLMS")
    tracker.controller._state.weights[:] = np.inf
    assert not np.isfinite(tracker.control_signal(1.0))


def test_what_is_refused() -> None:
    with pytest.raises(TypeError, match="built-in controller of one channel"):
        PathTracker(FxLMS(4, [[[1.0]]], step_size=0.1), rng=0)
    with pytest.raises(TypeError, match="built-in controller of one channel"):
        PathTracker(tracked("FxLMS"), rng=0)
    with pytest.raises(TypeError, match="amplifier must be a function"):
        tracked("FxLMS", amplifier=3.0)
    with pytest.raises(ValueError, match="probe_filter must not be all zeros"):
        tracked("FxLMS", probe_filter=[0.0])
    with pytest.raises(ValueError, match="memory_s must be at least 8 times check_s"):
        tracked("FxLMS", memory_s=1.0)
    with pytest.raises(ValueError, match="path tracker is for 8000 Hz"):
        simulate(tracked("FxLMS"), np.ones(10), primary_path=[1.0], secondary_path=[1.0], fs=16000.0)
    tracker = tracked("FxLMS")
    tracker.control_signal(1.0)
    with pytest.raises(ValueError, match="error"):
        tracker.update(np.nan)
    tracker.controller.limiter = OutputLimiter(1.0, fs=16000.0)
    with pytest.raises(ValueError, match="limiter is for 16000 Hz"):
        tracker.require_sample_rate(FS)
