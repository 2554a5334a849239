"""KF-OPC with its gain repaired: what the repairs are for, their bounds and their refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.comparing import SIGNALS
from helpers.loop import FEEDBACK, FS, MEMORY_S, P0, S_HAT, Q, R, S, noises, run

from kfopc_filterpy import OutputPowerConstraint, kf_opc, kf_opc_repaired, noise_reduction_db, output_power, simulate
from kfopc_filterpy.controllers.repaired import RepairedKFOPC
from kfopc_filterpy.paths import duct_paths, path_taps
from kfopc_filterpy.signals import band_limited_noise

N_TAPS, TRIM_S, RATED_POWER = 10, 0.02, 0.3


PUBLISHED: dict[str, Any] = {"gain_of": "reference", "trim_s": None, "factor_at": "measurement"}


def made(
    n_taps: int = N_TAPS, *, rated_power: float = RATED_POWER, window: str = "exponential", **options: Any
) -> RepairedKFOPC:
    constraint = OutputPowerConstraint(rated_power, fs=FS, memory_s=MEMORY_S, window=window)
    settings = {"state_noise": R, "measurement_noise": Q, "initial_variance": P0}
    return kf_opc_repaired(n_taps, S_HAT, constraint=constraint, **settings | options)


# ---- Each repair


def test_without_a_repair_it_is_kf_opc_bit_for_bit() -> None:
    """The same equations in the same order; a trim of 0 multiplies by exp(0) = 1."""
    settings = {"state_noise": R, "measurement_noise": Q, "initial_variance": P0}
    constraint = OutputPowerConstraint(RATED_POWER, fs=FS, memory_s=MEMORY_S)
    published = kf_opc(N_TAPS, S_HAT, constraint=constraint, **settings)
    ours = made(**PUBLISHED)
    one, two = (run(c, feedback=FEEDBACK, on=50) for c in (ours, published))
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
