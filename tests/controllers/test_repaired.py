"""KF-OPC with its gain repaired: against each repair written out in plain numpy on filterpy's own filter."""

from __future__ import annotations

import copy
import itertools
import math
import pickle
from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from helpers.comparing import SIGNALS, assert_same_run
from helpers.loop import AMPLIFIERS, FEEDBACK, FS, MEMORY_S, P0, S_HAT, Q, R, S, noises, run, sensor_noise
from helpers.naming import plain
from oracles import modified_anc as oracle

from kfopc_filterpy import (
    OutputPowerConstraint,
    kf_opc,
    kf_opc_repaired,
    noise_reduction_db,
    output_power,
    simulate,
)
from kfopc_filterpy.controllers.repaired import RepairedKFOPC
from kfopc_filterpy.paths import duct_paths, path_taps
from kfopc_filterpy.signals import band_limited_noise

N_TAPS, TRIM_S, RATED_POWER = 10, 0.02, 0.3
REPAIRS = [
    {"gain_of": gain_of, "trim_s": trim_s, "factor_at": factor_at}
    for gain_of, trim_s, factor_at in itertools.product(
        ("reference", "control"), (None, TRIM_S), ("measurement", "output")
    )
]
PUBLISHED = REPAIRS[0]


def made(
    n_taps: int = N_TAPS, *, rated_power: float = RATED_POWER, window: str = "exponential", **options: Any
) -> RepairedKFOPC:
    constraint = OutputPowerConstraint(rated_power, fs=FS, memory_s=MEMORY_S, window=window)
    settings = {"state_noise": R, "measurement_noise": Q, "initial_variance": P0}
    return kf_opc_repaired(n_taps, S_HAT, constraint=constraint, **settings | options)


class WrittenOut:
    """Eq. 2-13 with the repairs, an algorithm for `oracles.modified_anc`.

    The factor of a sample is that of eq. 13 times exp(trim), at most 1; then trim += (1 - y^2/rho_o) / (trim_s fs), unless
    the factor is 1 and it would rise. At the output the factor of one sample scales y of the next.
    """

    def __init__(
        self,
        gain_of: str,
        trim_s: float | None,
        factor_at: str,
        window: str = "exponential",
        rated_power: float = RATED_POWER,
    ) -> None:
        self.filter = KalmanFilter(dim_x=N_TAPS, dim_z=1)
        self.filter.Q, self.filter.R, self.filter.P = R * np.eye(N_TAPS), np.array([[Q]]), P0 * np.eye(N_TAPS)
        self.gain_of, self.trim_s, self.factor_at = gain_of, trim_s, factor_at
        self.factor = oracle.Factor(rated_power, None, MEMORY_S, FS, window)
        self.trim, self.output = 0.0, 1.0

    @property
    def weights(self) -> np.ndarray:
        """What makes y of the reference."""
        return self.output * self.filter.x[:, 0]

    def adapt(self, e: float, d: float, y: float, xf: np.ndarray, x: np.ndarray) -> None:
        gain_seen = (d - e, y) if self.gain_of == "control" else (xf[0], x[0])
        alpha = min(self.factor.take(d, *gain_seen) * math.exp(self.trim), 1.0)
        self.filter.predict()
        z = alpha * d if self.factor_at == "measurement" else d
        self.filter.update(np.array([[z]]), H=xf.reshape(1, -1))
        if self.trim_s is not None:
            change = (1.0 - y * y / self.factor.rated_power) / (self.trim_s * FS)
            if change < 0.0 or alpha < 1.0:
                self.trim = min(max(self.trim + change, -math.log(10.0)), math.log(10.0))
        if self.factor_at == "output":
            self.output = alpha
        self.factor.alpha = alpha


def assert_agrees(result: Any, expected: dict) -> None:
    """500 steps of a loop that contracts, in another order of summation; see `loop/test_loop.py`."""
    for name in SIGNALS:
        if name != "weights":  # of the oracle with the factor at the output
            want = expected[name]
            np.testing.assert_allclose(
                getattr(result, name), want, rtol=0, atol=1e-10 * np.nanmax(np.abs(want)), err_msg=name
            )


# ---- Each repair


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("repairs", REPAIRS, ids=plain)
def test_every_repair_is_its_definition(repairs: dict, compiled: bool) -> None:
    x, d, _ = noises()
    algorithm = WrittenOut(**repairs)
    expected = oracle.modified_anc(algorithm, x, d, S, S_HAT, noise=sensor_noise())
    ours = made(**repairs)
    result = run(ours, compiled=compiled)
    assert_agrees(result, expected)
    np.testing.assert_allclose(ours.weights, algorithm.filter.x[:, 0], rtol=0, atol=1e-10)
    assert result.algorithm == "KF-OPC repaired"
    assert np.min(result.constraint_factor) < 0.9  # it did act
    if repairs != PUBLISHED:
        published = run(made(**PUBLISHED))
        assert np.max(np.abs(result.control_signal - published.control_signal)) > 0.01


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("gain_of", ["reference", "control"])
@pytest.mark.parametrize("amplifier", ["hard", "soft"])
def test_amplifiers_feedback_a_sliding_window_and_a_late_start(amplifier: str, gain_of: str, compiled: bool) -> None:
    """While it listens, y = 0 tells of no gain: the reference's is followed, whatever the gain is of later."""
    x, d, _ = noises()
    ours, theirs = AMPLIFIERS[amplifier]
    repairs = {"gain_of": gain_of, "trim_s": TRIM_S, "factor_at": "output"}
    expected = oracle.modified_anc(
        WrittenOut(**repairs, window="sliding"),
        x,
        d,
        S,
        S_HAT,
        noise=sensor_noise(),
        amplifier=theirs,
        feedback=FEEDBACK,
        on=123,
    )
    options = {"amplifier": ours, "feedback": FEEDBACK, "on": 123, "compiled": compiled}
    assert_agrees(run(made(**repairs, window="sliding"), **options), expected)


@pytest.mark.parametrize("compiled", [True, False])
def test_the_trimmed_factor_stops_at_1(compiled: bool) -> None:
    """At a rated power that is nearly enough, the trim asks for more than all at times."""
    x, d, _ = noises()
    repairs = {"gain_of": "reference", "trim_s": TRIM_S, "factor_at": "output"}
    expected = oracle.modified_anc(WrittenOut(**repairs, rated_power=2.0), x, d, S, S_HAT, noise=sensor_noise())
    result = run(made(**repairs, rated_power=2.0), compiled=compiled)
    assert_agrees(result, expected)
    untrimmed = run(made(**repairs | {"trim_s": None}, rated_power=2.0)).constraint_factor
    assert np.sum((result.constraint_factor == 1.0) & (untrimmed < 0.98)) > 20


@pytest.mark.parametrize("compiled", [True, False])
def test_without_a_repair_it_is_kf_opc_bit_for_bit(compiled: bool) -> None:
    """The same equations in the same order; a trim of 0 multiplies by exp(0) = 1."""
    settings = {"state_noise": R, "measurement_noise": Q, "initial_variance": P0}
    constraint = OutputPowerConstraint(RATED_POWER, fs=FS, memory_s=MEMORY_S)
    published = kf_opc(N_TAPS, S_HAT, constraint=constraint, **settings)
    ours = made(**PUBLISHED)
    one, two = (run(c, compiled=compiled, feedback=FEEDBACK, on=50) for c in (ours, published))
    for name in SIGNALS:
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name), err_msg=name)
    np.testing.assert_array_equal(ours.covariance, published.covariance)
    assert ours.constraint_factor == published.constraint_factor < 1.0
    assert published.rated_power == ours.rated_power == RATED_POWER


def test_the_trim_does_not_wind_up_where_the_power_is_not_needed() -> None:
    """A factor of 1 all along; then much less is allowed, and the trim starts from 0."""
    x, d, _ = noises()
    factors = []
    for trim_s in (TRIM_S, None):
        ours = made(trim_s=trim_s, rated_power=1e6)
        np.testing.assert_array_equal(run(ours).constraint_factor, 1.0)
        ours.constraint.rated_power = RATED_POWER
        factors.append(simulate(ours, x[:2], disturbance=d[:2], secondary_path=S, fs=FS).constraint_factor)
    assert factors[0][0] == factors[1][0] < 1.0
    assert factors[0][1] != factors[1][1]


def test_the_trim_has_bounds() -> None:
    """A tenth and ten times: 20 dB either way, however long the power is wrong."""
    x, d, _ = noises()
    factors = []
    for trim_s in (1e-4, None):
        ours = made(trim_s=trim_s, gain_of="reference", factor_at="measurement", rated_power=0.3)
        # nothing is ever played, so that the trim rises as far as it may
        ours.measurement_noise = 1e12
        factors.append(simulate(ours, x, disturbance=50 * d, secondary_path=S, fs=FS).constraint_factor[-1])
    assert factors[0] == pytest.approx(10 * factors[1], rel=1e-12)
    assert factors[0] < 1.0


# ---- What it is for


def duct(seconds: float, band: tuple[float, float] = (100.0, 1500.0)) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reference, disturbance, secondary path of the built-in duct."""
    paths = duct_paths()
    x = band_limited_noise(band, seconds, fs=16000.0, rng=1)
    return x, np.convolve(x, path_taps(paths.primary))[: x.size], path_taps(paths.secondary)


def test_the_trim_keeps_the_rated_power_where_eq_13_misses_it() -> None:
    """In a duct of resonances the gain that the control signal sees is not the reference's."""
    x, d, s = duct(6.0)
    settings = {"state_noise": 1e-9, "measurement_noise": 0.2 * np.mean(d**2)}
    free = kf_opc(64, s, rated_power=1e6, **settings)
    rated_power = output_power(simulate(free, x, disturbance=d, secondary_path=s).control_signal) / 4.0

    def power_with(**repairs: Any) -> float:
        ours = kf_opc_repaired(64, s, rated_power=rated_power, **settings, **repairs)
        result = simulate(ours, x, disturbance=d, secondary_path=s)
        assert noise_reduction_db(result.error, d) > 1.5
        return output_power(result.control_signal) / rated_power

    assert power_with(**PUBLISHED) < 0.85
    assert power_with(trim_s=None) < 0.85  # the control signal's gain alone: the rest is what cannot be cancelled
    # the trim averages over 1 s; a second of a band of 1400 Hz scatters by 3 %, four by half
    for repairs in (PUBLISHED | {"trim_s": 1.0}, {"gain_of": "reference"}, {"factor_at": "measurement"}, {}):
        assert power_with(**repairs) == pytest.approx(1.0, rel=0.02)


# ---- Compiled, and step by step


@pytest.mark.parametrize("n_taps", [1, 2, 5, 16, 33])
@pytest.mark.parametrize("repairs", REPAIRS, ids=plain)
def test_compiled_run_is_the_steps_bit_for_bit(repairs: dict, n_taps: int) -> None:
    fast, slow = made(n_taps, **repairs), made(n_taps, **repairs)
    options = {"amplifier": AMPLIFIERS["soft"][0], "feedback": FEEDBACK, "on": 17, "n": 300}
    assert_same_run(run(fast, **options), run(slow, compiled=False, **options))
    np.testing.assert_array_equal(fast.weights, slow.weights)
    np.testing.assert_array_equal(fast.covariance, slow.covariance)
    assert_same_run(run(fast, n=50), run(slow, n=50, compiled=False))  # and they go on alike
    assert_same_run(run(fast, n=50, compiled=False), run(slow, n=50))


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda made: pickle.loads(pickle.dumps(made))])
def test_a_copy_goes_on_alone(clone: Any) -> None:
    ours = made(trim_s=TRIM_S)
    run(ours)
    twin = clone(ours)
    ahead = run(ours)
    assert_same_run(ahead, run(twin))


# ---- Refusals

ESTIMATOR: dict[str, Any] = {"state_noise": 1e-6, "measurement_noise": 0.1}


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"gain_of": "both"}, ValueError, "gain_of must be one of 'reference', 'control'"),
        ({"factor_at": "input"}, ValueError, "factor_at must be one of 'measurement', 'output'"),
        ({"trim_s": 0.0}, ValueError, "trim_s must be greater than 0 s"),
        ({"trim_s": math.nan}, ValueError, "trim_s must be finite"),
        ({"rated_power": 0.0}, ValueError, "rated_power must be greater than 0"),
        ({"rated_power": None}, ValueError, "give either rated_power= or constraint="),
        ({"constraint": OutputPowerConstraint(1.0)}, ValueError, "give either rated_power= or constraint="),
        ({"constraint": 1.0, "rated_power": None}, TypeError, "constraint must be an OutputPowerConstraint"),
        ({"secondary_path": np.ones((2, 2, 4))}, ValueError, "RepairedKFOPC takes one channel"),
        ({"n_taps": 0}, ValueError, "n_taps must be at least 1"),
        ({"state_noise": -1.0}, ValueError, "state_noise must not be negative"),
        ({"amplifier": abs}, TypeError, "one of kfopc_filterpy's amplifier models"),
        ({"secondary_path_gain": 1.0}, TypeError, "unexpected keyword"),
    ],
    ids=plain,
)
def test_settings_out_of_range(options: dict, error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        kf_opc_repaired(**{"n_taps": 4, "secondary_path": S_HAT, "rated_power": 1.0} | ESTIMATOR | options)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e200])
def test_a_bad_error_changes_nothing(bad: float) -> None:
    ours, untouched = made(), made()
    for controller in (ours, untouched):
        run(controller, n=100)
        controller.control_signal(1.0)
    before = pickle.dumps(ours)
    with pytest.raises(ValueError, match=r"finite|too loud"):
        ours.update(bad)
    assert pickle.dumps(ours) == before
    for controller in (ours, untouched):
        controller.update(0.5)
    assert ours.control_signal(1.0) == untouched.control_signal(1.0)
    with pytest.raises(ValueError, match="reference must be finite"):
        ours.control_signal(math.nan)


def test_another_sample_rate_is_refused() -> None:
    options = {"disturbance": np.ones(10), "secondary_path": S_HAT}
    with pytest.raises(ValueError, match="fs is 16000 Hz but the controller's power memory is for 8000 Hz"):
        simulate(made(), np.ones(10), **options)
