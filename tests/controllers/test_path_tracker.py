"""A secondary path that changes during the run, and the tracker that follows it."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
from helpers.changing_plant import (
    FS,
    N_PATH,
    SLOW_FS,
    crossed_paths,
    noises,
    noises_of_several,
    reduction_db,
    resonant_path,
    run,
    run_several,
)
from kfopc_filterpy.controllers.path_tracker import Evidence, JointFit, block_sums, common_ratio
from scipy.special import stdtr

from kfopc_filterpy import FxLMS, FxNLMS, HardClipAmplifier, OutputLimiter, kf_anc, kf_pb, simulate
from kfopc_filterpy.controllers import PathTracker
from kfopc_filterpy.paths import identify_secondary_path

L = 64
BEFORE, AFTER = resonant_path(5, 600.0, 0.8, 1.0), resonant_path(8, 900.0, 0.85, 0.7)
KALMAN: dict[str, Any] = {"state_noise": 1e-9, "measurement_noise": 0.01, "initial_variance": 0.1}
MAKERS: dict[str, Any] = {
    "FxLMS": lambda s: FxLMS(L, s, step_size=0.0005),
    "FxNLMS": lambda s: FxNLMS(L, s, step_size=0.02),
    "KF-ANC": lambda s: kf_anc(L, s, **KALMAN),
    "KF-PB": lambda s: kf_pb(L, s, rated_power=4.0, fs=FS),
}


def tracked(name: str, path: np.ndarray = BEFORE, **settings: Any) -> PathTracker:
    return PathTracker(MAKERS[name](path), **{"rng": 3, "fs": FS} | settings)


def misalignment_db(estimate: np.ndarray, path: np.ndarray) -> float:
    return float(10 * np.log10(np.sum((estimate - path) ** 2) / np.sum(path**2)))


@pytest.mark.parametrize("name", [name for name in MAKERS if name != "KF-PB"])  # which learns the path by itself
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
    # Held at 6 dB of what is expected, which has grown by then; and what is louder until the guard has turned it down.
    tenths = np.mean(error.reshape(-1, 800) ** 2, axis=1) / np.mean(d**2)
    assert 10 * np.log10(tenths.max()) < 15.0
    assert np.abs(emitted).max() < 60.0


@pytest.mark.slow
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


@pytest.mark.slow
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


def test_an_algorithm_that_runs_away_within_milliseconds_is_turned_down() -> None:
    """A first, rough estimate makes this filter 40 dB louder within a frame; then the weights are held as they are."""
    x, d = noises(6.0, seed=9)
    before, after = resonant_path(8.219, 504.68, 0.784, 0.664), resonant_path(3.528, 1216.42, 0.722, 0.577)

    def path_at(t: float) -> np.ndarray:
        return before if t < 2.0 else after

    tracker = tracked("KF-ANC", before, rng=5009)
    error, _ = run(tracker, x, d, path_at)
    tenths = 10 * np.log10(np.mean(error.reshape(-1, 800) ** 2, axis=1) / np.mean(d**2))
    assert tenths.max() < 16.0
    assert tenths[-1] < -10.0
    assert tracker._guard.gain == 1.0  # full volume again


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
@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 2, 2), (3, 2, 1)], ids=["1x1x1", "2x2x2", "3x2x1"])
def test_the_fit_is_least_squares(shape: tuple[int, int, int], source: str) -> None:
    """Against numpy's least squares on the rows written out, with the penalties as further rows."""
    rng = np.random.default_rng(0)
    K, J, n_references = shape
    P, S, n = 9, 4, 200
    known = np.array([0.0, 1.0, 0.3, 0.0]) * rng.uniform(0.5, 2.0, (K, J, 1))
    fit = JointFit(shape, P, S, 0.6)
    blocks = []
    for _ in range(3):
        x, y, v = (rng.standard_normal((count, n + P - 1)) for count in (n_references, J, J))
        e = rng.standard_normal((K, n)) * np.arange(1, K + 1)[:, np.newaxis]
        fit.add(block_sums(x, y, v, e, P, S))

        def rows(signals: np.ndarray, taps: int, start: int = P - 1, count: int = n) -> np.ndarray:
            return np.array([[s[start + i - k] for s in signals for k in range(taps)] for i in range(count)])

        blocks.append((rows(x, P), -rows(y, S), -rows(v, S), e.T))
    weights = [0.6, np.sqrt(0.6), 1.0]  # roots of 0.36, 0.6, 1
    rx, ry, rv, e = (np.vstack([w * block[i] for w, block in zip(weights, blocks, strict=True)]) for i in range(4))
    model = fit.solve(known)
    assert model is not None
    # The first solution knows no residual, so the errors' own powers count.
    noise = np.sum(e**2, axis=0) / (n * 1.96)
    ridges = [S * K / sum(known[k, j] @ known[k, j] / noise[k] for k in range(K)) for j in range(J)]
    penalty = np.diag(np.sqrt(np.repeat(ridges, S)))
    drawn = penalty @ known.reshape(K, J * S).T
    A = np.vstack((np.hstack((rx, ry + rv)), np.hstack((np.zeros((J * S, rx.shape[1])), penalty))))
    theta, *_ = np.linalg.lstsq(A, np.vstack((e, drawn)), rcond=None)
    if source == "control signal":
        np.testing.assert_allclose(model.primary.reshape(K, -1).T, theta[: rx.shape[1]], rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(model.secondary[source].reshape(K, -1).T, theta[rx.shape[1] :], rtol=1e-6, atol=1e-7)
    else:
        left = e - np.hstack((rx, ry)) @ theta
        probed, *_ = np.linalg.lstsq(np.vstack((rv, penalty)), np.vstack((left, drawn)), rcond=None)
        np.testing.assert_allclose(model.secondary[source].reshape(K, -1).T, probed, rtol=1e-6, atol=1e-7)
    unexplained = np.sum((e - A[: len(e)] @ theta) ** 2, axis=0) / (n * 1.96)
    np.testing.assert_allclose(fit.noise, unexplained, rtol=1e-6)


def test_samples_whose_errors_are_unknown_are_left_out_of_the_sums() -> None:
    """Against the rows of the others, written out."""
    rng = np.random.default_rng(3)
    P, S, n = 6, 3, 40
    x, y, v = (rng.standard_normal((2, n + P - 1)) for _ in range(3))
    unknown = rng.random(n) < 0.3
    e = np.where(unknown, 0.0, rng.standard_normal((2, n)))
    signals = [(one, P) for one in x] + [(-one, S) for one in (*y, *v)]
    known = np.array(
        [np.concatenate([one[P - 1 + i - np.arange(taps)] for one, taps in signals]) for i in np.flatnonzero(~unknown)]
    )
    matrix, right, energies, count = block_sums(x, y, v, e, P, S, unknown)
    np.testing.assert_allclose(matrix, known.T @ known, rtol=0, atol=1e-12)
    np.testing.assert_allclose(right, known.T @ e[:, ~unknown].T, rtol=0, atol=1e-12)
    np.testing.assert_allclose(energies, np.sum(e**2, axis=1), rtol=1e-12)
    assert count == n - np.count_nonzero(unknown)


@pytest.mark.parametrize("heard", [2, 3, 50], ids=["every 2nd", "every 3rd", "every 50th"])
def test_a_jump_is_found_although_most_errors_are_not_known(heard: int) -> None:
    """Every sample is played, but the controller hears few errors; without their places in time, nothing fits."""
    x, d = noises(10.0)
    tracker, path = tracked("FxLMS"), BEFORE
    played = np.zeros(N_PATH)
    for n in range(x.size):
        path = BEFORE if n < 2 * FS else AFTER
        played = np.concatenate(([tracker.control_signal(float(x[n]))], played[:-1]))
        if n % heard == 0:
            tracker.update(float(d[n] - path @ played))
    assert misalignment_db(tracker.secondary_path, AFTER) < -8.0


def test_a_pause_of_the_adaptation_has_a_probe_and_is_forgotten_by_the_guard() -> None:
    """Ten seconds without an error: nothing is expected to be softer than before, and the probe goes on."""
    x, d = noises(14.0)
    tracker, played = tracked("FxLMS"), np.zeros(N_PATH)
    error, probe = np.zeros(x.size), np.zeros(x.size)
    for n in range(x.size):
        y = tracker.control_signal(float(x[n]))
        played = np.concatenate(([y], played[:-1]))
        error[n] = d[n] - BEFORE @ played
        if not 2 * FS <= n < 12 * FS:
            tracker.update(float(error[n]))
        probe[n] = y - tracker.controller._opened().control_signal[0]
    assert tracker.changes == []
    assert reduction_db(error, d, 13.0, 14.0) > reduction_db(error, d, 1.0, 2.0) - 0.5
    pause = probe[round(3 * FS) : round(12 * FS)]
    assert np.std(pause) > 0.9 * np.sqrt(np.mean(pause**2)) > 0.0  # noise, not one sample again and again


@pytest.mark.slow
def test_the_probe_does_not_grow_if_a_loudspeaker_is_unplugged() -> None:
    """Otherwise it would be a thousand million times too loud after half a minute."""
    x, d = noises(16.0)

    def path_at(t: float) -> np.ndarray:
        return BEFORE if not 2.0 <= t < 8.0 else np.zeros(N_PATH)

    tracker, alone = tracked("KF-PB"), MAKERS["KF-PB"](BEFORE)
    error, emitted = run(tracker, x, d, path_at)
    _, without = run(alone, x[: round(8 * FS)], d[: round(8 * FS)], path_at)
    unplugged = slice(round(3 * FS), round(8 * FS))
    assert np.mean(emitted[unplugged] ** 2) < 2.0 * np.mean(without[unplugged] ** 2)
    assert reduction_db(error, d, 15.0, 16.0) > 6.0


@pytest.mark.slow
def test_an_estimate_that_is_far_too_loud_is_corrected() -> None:
    x, d = noises(16.0)
    tracker = tracked("FxLMS", 20.0 * BEFORE)
    error, _ = run(tracker, x, d, lambda t: BEFORE)
    assert misalignment_db(tracker.secondary_path, BEFORE) < -8.0
    assert reduction_db(error, d, 15.0, 16.0) > 6.0


def test_the_probe_of_one_loudspeaker_of_several_that_is_unplugged_has_a_limit() -> None:
    paths = crossed_paths(3, 1.0, 0)
    tracker = PathTracker(FxLMS(16, paths, step_size=1e-3, n_references=2), rng=3, fs=SLOW_FS)
    x, d = noises_of_several(12.0)
    unplugged = paths.copy()
    unplugged[:, 1] = 0.0
    errors, _ = run_several(tracker, x, d, lambda t: paths if t < 2.0 else unplugged)
    residual = np.mean(errors[:, -2000:] ** 2, axis=1)
    limit = 0.01 / 2 * 100 * common_ratio(residual, paths)
    assert np.all(tracker._level**2 <= 1.5 * limit)  # the level follows the residual of another time
    assert np.isfinite(errors).all()


def test_a_limit_that_is_far_too_large_to_count_is_taken() -> None:
    tracker = tracked("FxLMS", hold_db=1e4)
    x, d = noises(1.0)
    assert np.isfinite(run(tracker, x, d, lambda t: BEFORE)[0]).all()


def test_silence_has_no_solution() -> None:
    fit = JointFit((1, 1, 1), 5, 2, 0.5)
    silent = np.zeros((1, 54))
    fit.add(block_sums(silent, silent, silent, np.zeros((1, 50)), 5, 2))
    assert fit.solve(np.array([[[1.0, 0.0]]])) is None


def test_a_loudspeaker_that_nobody_is_known_to_hear_keeps_its_paths() -> None:
    """Its penalty is as large as rounding allows, and not infinite."""
    rng = np.random.default_rng(0)
    x, y, v = rng.standard_normal((3, 2, 54))
    fit = JointFit((2, 2, 2), 5, 2, 0.5)
    fit.add(block_sums(x, y, v, rng.standard_normal((2, 50)), 5, 2))
    known = np.zeros((2, 2, 2))
    known[:, 0, 1] = 1.0
    model = fit.solve(known)
    assert model is not None
    assert np.abs(model.secondary["probe"][:, 1]).max() < 1e-6 < np.abs(model.secondary["probe"][:, 0]).max()


def test_the_common_ratio_does_not_depend_on_the_microphones_sensitivity() -> None:
    paths = np.random.default_rng(0).standard_normal((3, 2, 4))
    powers, gains = np.array([1.0, 4.0, 0.5]), np.array([10.0, 0.1, 3.0])
    expected = common_ratio(powers, paths)
    np.testing.assert_allclose(common_ratio(gains**2 * powers, gains[:, np.newaxis, np.newaxis] * paths), expected)
    probes = np.sum(paths**2, axis=2) * expected  # of each loudspeaker at each microphone
    np.testing.assert_allclose(np.mean(probes / powers[:, np.newaxis], axis=0), 1.0)
    paths[:, 1] = 0.0
    assert common_ratio(powers, paths)[1] == np.inf
    np.testing.assert_array_equal(common_ratio(np.zeros(3), paths), 0.0)
    np.testing.assert_allclose(common_ratio(np.array([0.0, 4.0, 0.5]), paths), common_ratio(powers[1:], paths[1:]))


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
    assert {change.microphone for change in tracker.changes} == {0}
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


@pytest.mark.slow
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
    tracker.controller._weights()[:] = np.inf
    assert not np.isfinite(tracker.control_signal(1.0))


def test_what_is_refused() -> None:
    with pytest.raises(TypeError, match="built-in controller, not one around another one"):
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
    with pytest.raises(ValueError, match="overflows: nothing was changed"):
        tracker.update(1e200)
    tracker.update(0.5)
    assert tracker._guard._energies[0] == 0.25  # of the sample that was not refused
    with pytest.raises(ValueError, match=r"hold_db must be above 3\.01 dB, got 3 dB"):
        tracked("FxLMS", hold_db=3.0)
    tracker.controller.limiter = OutputLimiter(1.0, fs=16000.0)
    with pytest.raises(ValueError, match="limiter is for 16000 Hz"):
        tracker.require_sample_rate(FS)


# ---- Several channels: 2 microphones, 2 loudspeakers, 2 references

THEN, NOW = crossed_paths(2, 1.0, seed=1), crossed_paths(4, 0.7, seed=2)
OF_SEVERAL: dict[str, Any] = {
    "FxLMS": lambda s: FxLMS(24, s, step_size=0.002, n_references=2),
    "KF-ANC": lambda s: kf_anc(24, s, state_noise=1e-8, measurement_noise=0.01, initial_variance=0.1, n_references=2),
}


def tracked_several(name: str, paths: np.ndarray = THEN, **settings: Any) -> PathTracker:
    return PathTracker(OF_SEVERAL[name](paths), **{"rng": 3, "fs": SLOW_FS} | settings)


def several_reduction_db(errors: np.ndarray, d: np.ndarray, begin_s: float, end_s: float) -> float:
    """Return the noise reduction between two times, over the sum of the microphones; NaN after a divergence."""
    part = slice(round(begin_s * SLOW_FS), round(end_s * SLOW_FS))
    return float(-10 * np.log10(np.sum(errors[:, part] ** 2) / np.sum(d[:, part] ** 2)))


@pytest.mark.parametrize(("name", "jump"), [("FxLMS", "all paths"), ("FxLMS", "one path"), ("KF-ANC", "all paths")])
def test_several_paths_that_jump_are_found(name: str, jump: str) -> None:
    x, d = noises_of_several(12.0)
    now = NOW.copy() if jump == "all paths" else THEN.copy()
    now[1, 1] = NOW[1, 1]

    def paths_at(t: float) -> np.ndarray:
        return THEN if t < 2.0 else now

    tracker = tracked_several(name)
    errors, _ = run_several(tracker, x, d, paths_at)
    alone, _ = run_several(OF_SEVERAL[name](THEN), x, d, paths_at)
    since = slice(round(2 * SLOW_FS), None)
    fresh, _ = run_several(OF_SEVERAL[name](now), x[:, since], d[:, since], lambda t: now)
    reached = several_reduction_db(errors, d, 11.0, 12.0)
    assert not several_reduction_db(alone, d, 11.0, 12.0) > reached - 3.0  # it diverges, or is worse
    assert reached > several_reduction_db(fresh, d[:, since], 9.0, 10.0) - 1.0
    assert misalignment_db(tracker.secondary_path, now) < -8.0
    assert tracker.secondary_path.shape == (2, 2, 12)
    assert 2.0 < tracker.changes[0].time_s < 4.0
    assert tracker.changes[0].microphone == 1 or jump == "all paths"
    assert {change.microphone for change in tracker.changes} >= ({0, 1} if jump == "all paths" else {1})
    tenths = np.mean(np.sum(errors**2, axis=0).reshape(-1, 200), axis=1) / np.mean(np.sum(d**2, axis=0))
    assert 10 * np.log10(tenths.max()) < 15.0


def test_a_drift_of_several_paths_is_followed() -> None:
    """Within six seconds all paths become later by a sample, and weaker. FxLMS is slow to unlearn what it did then."""
    x, d = noises_of_several(13.0)
    later = 0.7 * np.concatenate((np.zeros((2, 2, 1)), THEN[..., :-1]), axis=-1)

    def paths_at(t: float) -> np.ndarray:
        share = np.clip((t - 2.0) / 6.0, 0.0, 1.0)
        return (1.0 - share) * THEN + share * later

    tracker = tracked_several("FxLMS")
    errors, _ = run_several(tracker, x, d, paths_at)
    alone, _ = run_several(OF_SEVERAL["FxLMS"](THEN), x[:, :16000], d[:, :16000], paths_at)
    assert not several_reduction_db(alone, d, 7.0, 8.0) > -10.0  # it diverges
    for microphone in (0, 1):
        assert sum(change.microphone == microphone for change in tracker.changes) >= 2
    assert several_reduction_db(errors, d, 12.0, 13.0) > 5.0
    assert misalignment_db(tracker.secondary_path, later) < -12.0


def test_a_change_of_several_primary_paths_is_not_taken_for_one_of_the_secondary_paths() -> None:
    x, d = noises_of_several(9.0)
    drift = np.clip((np.arange(d.shape[1]) / SLOW_FS - 3.0) / 5.0, 0.0, 1.0)
    d = d + drift * (np.roll(d, 3, axis=1) - d)
    tracker = tracked_several("KF-ANC")
    run_several(tracker, x, d, lambda t: THEN)
    assert tracker.changes == []


def test_several_paths_that_stay_are_kept_and_the_controller_does_not_hear_the_probes() -> None:
    x, d = noises_of_several(9.0)
    alone, tracker = OF_SEVERAL["FxLMS"](THEN), tracked_several("FxLMS", hold_db=200.0)
    clean, quiet = run_several(alone, x, d, lambda t: THEN)
    errors, emitted = run_several(tracker, x, d, lambda t: THEN)
    assert tracker.changes == []
    np.testing.assert_allclose(tracker.weights, alone.weights, rtol=1e-9, atol=1e-12)
    assert 0.0 < several_reduction_db(clean, d, 4.0, 9.0) - several_reduction_db(errors, d, 4.0, 9.0) < 0.1
    # each loudspeaker has a probe of its own and an equal share
    late = slice(12000, None)
    residual = np.mean(errors[:, late] ** 2, axis=1)
    heard = np.mean((errors - clean)[:, late] ** 2, axis=1) / residual
    assert 10 * np.log10(heard.mean()) == pytest.approx(-20.0, abs=0.5)
    probes = (emitted - quiet)[:, late]
    assert abs(np.corrcoef(probes)[0, 1]) < 0.05
    shares = np.mean(probes**2, axis=1) * np.mean(np.sum(THEN**2, axis=2) / residual[:, np.newaxis], axis=0)
    np.testing.assert_allclose(shares, 0.005, rtol=0.1)  # half of -20 dB


def test_several_channels_of_one_are_one_channel() -> None:
    x, d = noises(1.2)
    one = PathTracker(FxLMS(L, BEFORE, step_size=0.0005), rng=3, fs=FS)
    many = PathTracker(FxLMS(L, [[BEFORE]], step_size=0.0005), rng=3, fs=FS)
    for n in range(x.size):
        y, ys = one.control_signal(x[n]), many.control_signal(x[n : n + 1])
        assert np.shape(y) == ()
        assert ys.shape == (1,)
        one.update(d[n]), many.update(d[n : n + 1])
        assert ys[0] == pytest.approx(y, rel=1e-9, abs=1e-12)
    assert many.secondary_path.shape == (1, 1, N_PATH)
    np.testing.assert_allclose(many.weights[0, 0], one.weights, rtol=1e-9, atol=1e-12)


def test_several_channels_listen_before_the_control_begins() -> None:
    x, d = noises_of_several(6.0)
    tracker = tracked_several("FxLMS", NOW)
    tracker.listen(x[:, :2000], d[:, :2000])
    np.testing.assert_array_equal(tracker.weights, 0.0)
    errors, _ = run_several(tracker, x[:, 2000:], d[:, 2000:], lambda t: THEN)
    assert {change.microphone for change in tracker.changes} == {0, 1}
    assert several_reduction_db(errors, d[:, 2000:], 4.0, 5.0) > 3.0


def test_each_loudspeaker_may_have_an_amplifier_that_is_known() -> None:
    """Without knowing them, the doubled loudspeaker would be taken for other paths."""
    x, d = noises_of_several(3.0)
    amplifiers = [HardClipAmplifier(0.6), lambda y: 2.0 * y]
    plant: dict[str, Any] = {"disturbance": d, "secondary_path": THEN, "fs": SLOW_FS, "amplifier": amplifiers}
    changes = []
    for known in (amplifiers, None):
        tracker = PathTracker(FxLMS(24, THEN, step_size=0.001, n_references=2), rng=3, fs=SLOW_FS, amplifier=known)
        result = simulate(tracker, x, **plant)
        assert np.abs(result.control_signal[0]).max() > 0.8  # it does clip
        changes.append(len(tracker.changes))
    assert changes[0] == 0 < changes[1]


def test_what_is_refused_of_several_channels_changes_nothing() -> None:
    with pytest.raises(TypeError, match="one for each of the 2 loudspeakers"):
        tracked_several("FxLMS", amplifier=[HardClipAmplifier(1.0)])
    tracker = tracked_several("FxLMS")
    with pytest.raises(ValueError, match="each of the 2 references"):
        tracker.control_signal([1.0])
    tracker.control_signal([1.0, 2.0])
    for bad, message in (([1.0], "each of the 2 microphones"), ([1.0, np.nan], "error must be finite")):
        with pytest.raises(ValueError, match=message):
            tracker.update(bad)
    with pytest.raises(ValueError, match=r"channels \(microphones, loudspeakers\) = \(2, 2\)"):
        tracker.secondary_path = NOW[:1]
    np.testing.assert_array_equal(tracker.secondary_path, THEN)
    np.testing.assert_array_equal(tracker.weights, 0.0)
    tracker.secondary_path = NOW
    np.testing.assert_array_equal(tracker._paths, NOW)
    assert repr(tracker).startswith("<FxLMS with path tracking: 0 change(s), <FxLMS: 2 microphones, 2 loudspeakers")


def test_noise_that_comes_later_than_the_reference_is_controlled() -> None:
    """Nothing is heard in the first frame, so nothing may be expected from it."""
    x = np.random.default_rng(3).standard_normal(8000)
    primary = np.zeros(120)
    primary[100] = 1.0  # 50 ms
    tracker = PathTracker(FxLMS(110, [0.0, 1.0], step_size=0.002), rng=1, fs=2000.0)
    result = simulate(tracker, x, primary_path=primary, secondary_path=[0.0, 1.0], fs=2000.0)
    assert np.mean(result.error[-2000:] ** 2) < 0.1
    assert not np.any(result.error[:100])


def test_noise_that_begins_while_it_listens_is_no_divergence() -> None:
    """The reference is a tachometer's: it does not tell that the machine has become loud."""
    n = np.arange(20000)
    x, loud = np.sin(0.3 * n), np.where(n < 6000, 0.001, 1.0)
    d = loud * np.roll(x, 5) + 1e-4 * np.random.default_rng(1).standard_normal(n.size)
    tracker = PathTracker(FxLMS(8, [0.0, 1.0], step_size=0.002), rng=1, fs=2000.0)
    result = simulate(tracker, x, disturbance=d, secondary_path=[0.0, 1.0], fs=2000.0, switch_on_s=5.0)
    assert np.mean(result.error[-4000:] ** 2) < 1e-3 * np.mean(d[-4000:] ** 2)


def test_a_path_that_is_assigned_inherits_nothing_from_the_one_before() -> None:
    """Neither the evidence against it, nor a pause of the adaptation."""
    x = np.random.default_rng(3).standard_normal(3000)
    tracker = PathTracker(FxLMS(8, [0.0, 1.0, 0.0], step_size=0.02), rng=1, fs=2000.0, p_value=1e-300)
    simulate(tracker, x, disturbance=np.roll(x, 5), secondary_path=[0.0, 0.0, -0.8], fs=2000.0)
    assert tracker._guard.held
    assert any(evidence.count for evidence in tracker._evidence.values())
    tracker.secondary_path = [0.0, 0.0, -0.8]
    assert not tracker._guard.held
    assert not any(evidence.count for evidence in tracker._evidence.values())
