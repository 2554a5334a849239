"""PowerBudgetKalmanFilter and KF-PB: against filterpy's own filter of two observations, and the constrained optimum."""

from __future__ import annotations

import copy
import math
import pickle
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from filterpy.common import Saver
from filterpy.kalman import KalmanFilter
from helpers.comparing import assert_same_run, numbers_of
from helpers.loop import AMPLIFIERS, FEEDBACK, FS, MEMORY_S, S_HAT, run
from helpers.naming import plain
from helpers.power_budget import N_TAPS, SETTINGS, made, signals, step

from kfopc_filterpy import (
    KFOPC,
    HardClipAmplifier,
    bandpass_path,
    clipped_fraction,
    kf_anc,
    kf_pb,
    noise_reduction_db,
    output_power,
    simulate,
    simulate_scenarios,
)
from kfopc_filterpy.controllers import PowerBudgetController
from kfopc_filterpy.filters import PowerBudgetKalmanFilter
from kfopc_filterpy.paths import duct_paths, path_taps
from kfopc_filterpy.signals import band_limited_noise, tone

# ---- A filterpy filter, whose estimate is the unconstrained one


def test_state_and_covariance_are_those_of_the_unconstrained_filter_bit_for_bit() -> None:
    ours, free = made(), KFOPC.random_walk(N_TAPS, **SETTINGS)
    assert isinstance(ours, KalmanFilter)
    assert isinstance(ours, KFOPC)
    x, _, filtered, d = signals(400)
    for n in range(x.size):
        z = None if n % 50 == 30 else d[n]
        step(ours, z, filtered[n], reference=x[n])
        step(free, z, filtered[n])
        for name in ("x", "P", "K", "S", "y", "P_prior", "x_prior"):
            np.testing.assert_array_equal(getattr(ours, name), getattr(free, name), err_msg=name)
    assert ours.power_weight > 0.0
    assert ours.constraint_factor == 1.0
    assert np.linalg.norm(ours.control_filter - ours.x[:, 0]) > 0.1


def two_observations(weight: float, filtered: np.ndarray, rows: np.ndarray, d: np.ndarray, **start: float) -> Any:
    """filterpy's own filter that observes, beside d = x'w, that x'w of the reference is 0 with variance q/lambda."""
    kf, q = KalmanFilter(N_TAPS, 2), start["q"]
    kf.P, kf.Q, kf.R = start["P0"] * np.eye(N_TAPS), start["r"] * np.eye(N_TAPS), np.diag([q, q / weight])
    for h, x, z in zip(filtered, rows, d, strict=True):
        step(kf, np.array([[z], [0.0]]), np.array([h, x]))
    return kf.x[:, 0]


def test_the_control_filter_is_the_state_of_filterpys_filter_that_observes_the_control_signal_too() -> None:
    """With a window over all, no state noise, and signals that fell silent a solution ago: the same equations.

    But for the ridge of 1e-7 and the q/P0 of the start, 5e-5 beside 5000, at a condition of about 10.
    """
    x, rows, filtered, d = signals(5000, silent=200)
    kf = made(state_noise=0.0, initial_variance=1e3, memory_s=10.0)
    for n in range(x.size):
        step(kf, d[n], filtered[n], reference=x[n])
    weight = kf.power_weight
    assert 0.5 < weight < 2.0
    state = two_observations(weight, filtered, rows, d, P0=1e3, q=0.05, r=0.0)
    np.testing.assert_allclose(kf.control_filter, state, rtol=0, atol=2e-6)
    # which is the power-constrained Wiener solution over the record
    wiener = np.linalg.solve(filtered.T @ filtered + weight * rows.T @ rows, filtered.T @ d)
    np.testing.assert_allclose(kf.control_filter, wiener, rtol=0, atol=2e-6)


def test_over_a_long_steady_noise_the_state_of_that_filter_is_where_the_control_filter_stays() -> None:
    """The window's correlations scatter by 1/sqrt(samples); over 8 taps that is 0.02 of v where it has 17600."""
    x, rows, filtered, d = signals(24_000)
    kf = made(state_noise=1e-9, fs=16000.0, memory_s=1.0)
    for n in range(x.size):
        step(kf, d[n], filtered[n], reference=x[n])
    state = two_observations(kf.power_weight, filtered, rows, d, P0=1.0, q=0.05, r=1e-9)
    assert np.linalg.norm(kf.control_filter - state) < math.sqrt(8 / 17_600) * np.linalg.norm(state)
    assert np.linalg.norm(kf.x[:, 0] - state) > 0.3 * np.linalg.norm(state)


def test_a_missed_sample_advances_nothing() -> None:
    x, _, filtered, d = signals(100)
    kf = made()
    for n in range(100):
        step(kf, d[n], filtered[n], reference=x[n])
    budget, state = pickle.dumps(kf.budget), kf.x.copy()
    for reference in (None, 5.0):
        kf.update(None, H=filtered[0], reference=reference)
    assert pickle.dumps(kf.budget) == budget
    np.testing.assert_array_equal(kf.x, state)


@pytest.mark.parametrize("given", [None, 0.25])
def test_what_was_emitted_is_booked(given: float | None) -> None:
    """The control signal given, or what the control filter makes of the reference before it is solved for anew."""
    x, rows, filtered, d = signals(300)
    kf, account = made(), 0.0
    for n in range(300):
        y = kf.control_filter @ rows[n] if given is None else given
        step(kf, d[n], filtered[n], reference=x[n], control_signal=given)
        account += (y * y / 0.3 - 1.0) / 1000.0
        assert kf.budget.account_s == pytest.approx(account, abs=1e-12)
    assert kf.power_weight > 0.0


def test_a_saver_keeps_the_control_filters() -> None:
    x, _, filtered, d = signals(100)
    kf, kept = made(), []
    saver = Saver(kf)
    for n in range(100):
        step(kf, d[n], filtered[n], reference=x[n])
        saver.save()
        kept.append(kf.control_filter)
    saver.to_array()
    np.testing.assert_array_equal(saver.control_filter, kept)
    assert np.ptp(saver.control_filter[:, 3]) > 0.1
    assert saver.power_weight[-1] == kf.power_weight > 0.0
    np.testing.assert_array_equal(saver.rated_power, 0.3)


@pytest.mark.parametrize("clone", [copy.copy, copy.deepcopy, lambda kf: pickle.loads(pickle.dumps(kf))])
def test_a_copy_goes_on_by_itself(clone: Any) -> None:
    x, _, filtered, d = signals(600)
    kf = made()
    for n in range(300):
        step(kf, d[n], filtered[n], reference=x[n])
    other = clone(kf)
    assert other.budget is not kf.budget
    runs = []
    for one in (kf, other):
        runs.append([])
        for n in range(300, 600):
            step(one, d[n], filtered[n], reference=x[n])
            runs[-1].append((one.control_filter, one.x[:, 0].copy()))
    np.testing.assert_array_equal(*runs)


def test_a_rated_power_assigned_is_kept_from_there_on() -> None:
    x, rows, filtered, d = signals(4000)
    kf, spent = made(state_noise=0.0), []
    for n in range(4000):
        if n == 2000:
            kf.rated_power = 0.1
        spent.append((kf.control_filter @ rows[n]) ** 2)
        step(kf, d[n], filtered[n], reference=x[n])
    assert kf.rated_power == kf.budget.rated_power == 0.1
    assert np.mean(spent[1000:2000]) == pytest.approx(0.3, rel=0.05)  # a window of 720 samples: 0.05
    assert np.mean(spent[3000:]) == pytest.approx(0.1, rel=0.05)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"reference": None}, "reference is missing"),
        ({"reference": math.nan}, "reference must be finite"),
        ({"reference": 1e200}, "reference must have a finite square"),
        ({"control_signal": math.inf}, "control_signal must be finite"),
        ({"control_signal": 1e200}, "control_signal must have a finite square"),
        ({"H": [1e200, 0.0, 0.0]}, "filtered_reference must have a finite square"),
        ({"H": [0.0, math.nan, 0.0]}, "H must be finite"),
        ({"H": [1.0, 0.0]}, r"H must have shape \(3,\)"),
        ({"z": math.nan}, "z must be finite"),
        ({"R": -1.0}, "R must not be negative"),
        ({"R": 0.0, "H": [0.0, 0.0, 0.0]}, "a silent reference"),
    ],
    ids=plain,
)
def test_a_bad_step_is_refused_before_anything_changes(bad: dict, message: str) -> None:
    kf, untouched = made(3), made(3)
    good = {"z": 2.0, "H": [1.0, 0.5, 0.2], "reference": 1.0}
    for one in (kf, untouched):
        one.predict()
        one.update(**good)
    before = pickle.dumps(kf)
    with pytest.raises((ValueError, TypeError), match=message):
        kf.update(**good | bad)
    assert pickle.dumps(kf) == before
    for one in (kf, untouched):
        one.update(**good)
    np.testing.assert_array_equal(kf.control_filter, untouched.control_filter)


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, None])
def test_a_rated_power_out_of_range_is_refused(bad: Any) -> None:
    with pytest.raises((ValueError, TypeError), match="rated_power"):
        made(rated_power=bad)
    kf = made()
    with pytest.raises((ValueError, TypeError), match="rated_power"):
        kf.rated_power = bad
    assert kf.rated_power == 0.3
    assert "rated_power = 0.3" in repr(kf)


# ---- KF-PB in the loop: compiled, and step by step


SETTINGS_IN_LOOP = {
    "rated_power": 0.2, "state_noise": 1e-5, "measurement_noise": 1e-2, "fs": FS, "memory_s": MEMORY_S,
}  # fmt: skip


def controller(n_taps: int = 10, **options: Any) -> PowerBudgetController:
    """As those of `loop/test_loop.py`; a usual window of 80 samples, or ten times the taps."""
    return kf_pb(n_taps, S_HAT, **SETTINGS_IN_LOOP | {"secondary_path_uncertainty": None} | options)


@pytest.mark.parametrize("feedback", [None, FEEDBACK], ids=["", "feedback"])
@pytest.mark.parametrize("amplifier", AMPLIFIERS)
def test_compiled_run_is_the_steps_bit_for_bit(amplifier: str, feedback: Any) -> None:
    fast, slow = controller(), controller()
    options = {"amplifier": AMPLIFIERS[amplifier][0], "feedback": feedback, "on": 117}
    result = run(fast, **options)
    assert_same_run(result, run(slow, compiled=False, **options))
    assert result.algorithm == "KF-PB"
    assert np.max(result.power_weight) > 0.1
    assert_same_controller(fast, slow)
    assert_same_run(run(fast, n=50), run(slow, n=50, compiled=False))  # and they go on alike, either way
    assert_same_run(run(fast, n=50, compiled=False), run(slow, n=50))


@pytest.mark.parametrize("n_taps", [1, 2, 3, 5, 8, 16, 31, 64])
@pytest.mark.parametrize("known", [None, "soft"])
def test_compiled_run_is_the_steps_whatever_the_taps(n_taps: int, known: str | None) -> None:
    amplifier = AMPLIFIERS[known][0] if known else None
    fast, slow = (controller(n_taps, amplifier=amplifier) for _ in range(2))
    options = {"amplifier": amplifier, "record_weights_every": 7}
    assert_same_run(run(fast, **options), run(slow, compiled=False, **options))
    assert_same_controller(fast, slow)


def assert_same_controller(one: PowerBudgetController, other: PowerBudgetController) -> None:
    for name in ("weights", "control_filter", "power_weight", "disturbance_power"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    for name in ("x", "P", "K", "S", "y"):
        np.testing.assert_array_equal(getattr(one.estimator, name), getattr(other.estimator, name), err_msg=name)
    mine, theirs = (numbers_of(controller.estimator.budget.state) for controller in (one, other))
    for ours, others in zip(mine, theirs, strict=True):
        np.testing.assert_array_equal(ours, others)


def test_pieces_of_the_compiled_loop_do_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = run(controller())
    for size in (1, 7, 128, 499):
        monkeypatch.setattr("kfopc_filterpy.loop.simulation.STRETCH", size)
        assert_same_run(whole, run(controller()))


def test_it_goes_on_from_where_it_was() -> None:
    x, _, _, d = signals(700)
    one, two = (kf_pb(8, [0.9], rated_power=0.2, **SETTINGS) for _ in range(2))
    options: dict[str, Any] = {"secondary_path": [0.9], "record_powers": True, "record_weights_every": 1}
    whole = simulate(one, x, disturbance=d, **options)
    parts = [simulate(two, x[part], disturbance=d[part], **options) for part in (slice(130), slice(130, None))]
    for name in ("error", "control_signal", "power_weight", "weights"):
        joined = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_array_equal(joined, getattr(whole, name), err_msg=name)


def test_while_it_listens_the_budget_hears() -> None:
    """Reference and filtered reference into the correlations; the account waits, and so does the control filter."""
    made_one, budget = controller(), controller().estimator.budget
    x = np.random.default_rng(3).standard_normal(150)
    made_one.listen(x, x)
    for samples in zip(x, np.convolve(x, S_HAT)[:150], strict=True):
        budget.listen(*samples)
    mine = made_one.estimator.budget.state
    for ours, theirs in zip(numbers_of(mine), numbers_of(budget.state), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(made_one.control_filter, 0.0)


def test_what_is_recorded_is_the_control_filter_and_its_lambda() -> None:
    made_one = controller()
    result = run(made_one, on=40)
    played = scipy.linalg.toeplitz(result.reference, np.zeros(10))
    y = np.sum(result.weights[9:-1] * played[10:], axis=1)
    np.testing.assert_allclose(result.control_signal[10:], y, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(result.weights[-1], made_one.control_filter)
    np.testing.assert_array_equal(result.constraint_factor, 1.0)
    assert result.power_weight[-1] == made_one.power_weight
    assert run(kf_anc(3, [1.0], **SETTINGS)).power_weight is None  # without a power budget there is none


def test_a_controller_around_the_filter_is_kf_pb() -> None:
    own = PowerBudgetController(PowerBudgetKalmanFilter(10, **SETTINGS_IN_LOOP), S_HAT)
    assert (own.name, own.rated_power) == ("KF-PB", 0.2)
    assert_same_run(run(own), run(controller()))


# ---- What it settles to


def optimum(x: np.ndarray, d: np.ndarray, s: np.ndarray, n_taps: int, share: float) -> tuple[float, float, float]:
    """Noise reduction in dB within a share of the free filter's power, that power, and the error power of the free one.

    Dense least squares over the second half of the record, lambda by bisection.
    """
    half = x.size // 2
    rows, filtered = (scipy.linalg.toeplitz(u, np.zeros(n_taps))[half:] for u in (x, np.convolve(x, s)[: x.size]))
    R_x, R_xf, r = rows.T @ rows, filtered.T @ filtered, filtered.T @ d[half:]
    R_x, R_xf = (R + 1e-9 * np.trace(R) * np.eye(n_taps) for R in (R_x, R_xf))

    def weights(weight: float) -> np.ndarray:
        return scipy.linalg.solve(R_xf + weight * R_x, r, assume_a="pos")

    def power(weight: float) -> float:
        return float(np.mean((rows @ weights(weight)) ** 2))

    def left(weight: float) -> float:
        return float(np.mean((d[half:] - filtered @ weights(weight)) ** 2))

    rated_power = share * power(0.0)
    weight = scipy.optimize.brentq(lambda u: power(u) - rated_power, 0.0, 1e3)
    return 10 * math.log10(np.mean(d[half:] ** 2) / left(weight)), rated_power, left(0.0)


def plant(name: str) -> tuple[np.ndarray, np.ndarray]:
    if name == "band-pass":
        return path_taps(bandpass_path(128)), path_taps(bandpass_path(32))
    duct = duct_paths()
    return path_taps(duct.primary), path_taps(duct.secondary)


def noise(name: str, band: tuple[float, float], seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Reference, and a disturbance 1/20 of which it does not tell of."""
    x = band_limited_noise(band, seconds, fs=16000.0, rng=1)
    d = np.convolve(x, plant(name)[0])[: x.size]
    return x, d + 0.05 * np.std(d) * np.random.default_rng(2).standard_normal(d.size)


@pytest.mark.parametrize("share", [1 / 2, 1 / 8])
@pytest.mark.parametrize(
    ("name", "band"), [("band-pass", (100.0, 4500.0)), ("duct", (100.0, 1500.0)), ("duct", (50.0, 5000.0))]
)
def test_steady_noise_is_reduced_by_what_the_rated_power_allows(name: str, band: Any, share: float) -> None:
    """q is what the best free filter leaves, as the filter's model has it; the adaptation costs a tenth of a dB at most."""
    x, d = noise(name, band, 8.0)
    _, s = plant(name)
    best_db, rated_power, unexplained = optimum(x, d, s, 64, share)
    exact = {"secondary_path_uncertainty": None}
    made_one = kf_pb(64, s, rated_power=rated_power, state_noise=1e-9, measurement_noise=unexplained, **exact)
    result = simulate(made_one, x, disturbance=d, secondary_path=s)
    assert 0.97 < output_power(result.control_signal) / rated_power < 1.02
    assert best_db - 0.1 < noise_reduction_db(result.error, d) < best_db + 0.1  # 4 s of the same noise tell the power
    assert best_db > 2.0


@pytest.mark.parametrize("gain_db", [20.0, -20.0])
def test_two_seconds_after_a_level_jump_it_is_as_without_one(gain_db: float) -> None:
    """The estimate adapts all the while: what it learnt at the other level holds, since lambda was never in it.

    With an averaging time of a second: in the first the level is remembered, in the next what was spent because of it.
    """
    x, d = noise("duct", (50.0, 5000.0), 7.0)
    _, s = plant("duct")
    _, rated_power, unexplained = optimum(x, d, s, 64, 0.25)
    settings = {"rated_power": rated_power, "state_noise": 1e-9, "measurement_noise": unexplained, "averaging_s": 1.0}
    reductions, powers, weights = [], [], []
    for level in (1.0, np.where(np.arange(x.size) < 48_000, 10 ** (-gain_db / 20), 1.0)):
        options = {"disturbance": level * d, "secondary_path": s, "record_powers": True}
        result = simulate(kf_pb(64, s, **settings), level * x, **options)
        reductions.append(noise_reduction_db(result.error, d, steady=2 / 7))
        powers.append(output_power(result.control_signal, steady=2 / 7))
        weights.append(result.power_weight[80_000:])
    assert reductions[0] == pytest.approx(reductions[1], abs=0.3)
    assert powers[0] == pytest.approx(powers[1], rel=0.06)
    assert abs(np.mean(10 * np.log10(weights[0] / weights[1]))) < 0.5


@pytest.mark.parametrize("gain", [0.5, 2.0])
def test_a_secondary_path_estimated_wrong_in_gain_costs_no_power(gain: float) -> None:
    """The account is kept of the control signal itself; the constrained filter of a scaled path is the same."""
    x, d = noise("band-pass", (200.0, 3000.0), 4.0)
    _, s = plant("band-pass")
    best_db, rated_power, unexplained = optimum(x, d, s, 48, 0.25)
    made_one = kf_pb(48, gain * s, rated_power=rated_power, state_noise=1e-9, measurement_noise=unexplained)
    result = simulate(made_one, x, disturbance=d, secondary_path=s)
    assert output_power(result.control_signal) == pytest.approx(rated_power, rel=0.03)
    assert noise_reduction_db(result.error, d) == pytest.approx(best_db, abs=0.5)


@pytest.mark.parametrize("kind", ["tone", "noise"])
def test_an_amplifier_that_clips_drives_kf_anc_apart_and_not_kf_pb(kind: str) -> None:
    """At the peak of a sine of the rated power: clipped noise keeps 84 % of its amplitude, the tone all of it."""
    x, d = noise("band-pass", (200.0, 3000.0), 3.0)
    if kind == "tone":
        x = tone(400.0, 3.0, fs=16000.0)
        d = np.convolve(x, plant("band-pass")[0])[: x.size]
    _, s = plant("band-pass")
    rated_power = np.mean(d**2) / 4.0
    options = {"disturbance": d, "secondary_path": s, "amplifier": HardClipAmplifier(math.sqrt(2 * rated_power))}
    settings = {"state_noise": 1e-7, "measurement_noise": 1e-3}
    anc = simulate(kf_anc(48, s, **settings), x, rated_power=rated_power, **options)
    ours = kf_pb(48, s, rated_power=rated_power, **settings)
    pb = simulate(ours, x, **options)
    clipped = [clipped_fraction(r.control_signal, limit=1.01 * math.sqrt(2 * rated_power)) for r in (anc, pb)]
    assert output_power(anc.control_signal) > 1e3 * rated_power
    assert clipped[0] > 0.9
    assert pb.diverged_at_s is None
    assert output_power(pb.control_signal) == pytest.approx(rated_power, rel=0.02)
    assert clipped[1] < (0.001 if kind == "tone" else 0.17)  # of a Gaussian 2 Q(1.43) = 0.153
    # the estimate asks for 4 times the rated power, and for little more because of the clipping
    assert np.mean(np.convolve(x, ours.weights) ** 2) == pytest.approx(4 * rated_power, rel=0.25)
    assert noise_reduction_db(pb.error, d) > 4.0  # 6.0 without the clipping


def test_scenarios_and_another_sample_rate_are_refused() -> None:
    options = {"disturbance": np.ones(10), "secondary_path": S_HAT}
    with pytest.raises(TypeError, match=r"controllers\[0\] must be a controller of the core"):
        simulate_scenarios([controller()], np.ones(10), fs=FS, **options)
    with pytest.raises(ValueError, match=r"fs is 16000 Hz but the controller's .* is for 8000 Hz"):
        simulate(controller(), np.ones(10), fs=16000.0, **options)
