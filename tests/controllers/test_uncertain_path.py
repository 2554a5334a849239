"""Controllers whose secondary path is not as they know it: against the closed form of the settled error."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from kfopc_filterpy import (
    KFOPC,
    KalmanController,
    OutputPowerConstraint,
    Plant,
    fx_lms,
    kf_anc,
    kf_opc,
    kf_pb,
    leaky_fx_lms,
    noise_reduction_db,
    simulate,
)
from kfopc_filterpy.paths import PathTolerance, guard_filter
from kfopc_filterpy.signals import tone

FS = 8000.0
TRUE = np.array([0.0, 0.0, 0.0, 1.0, -0.6])
PRIMARY = np.array([0.0] * 8 + [0.8, 0.4])
TOLERANCE = PathTolerance(delay_samples=1.0)
DIRECT: dict[str, Any] = {"state_noise": 1e-9, "measurement_noise": 1e-3}


@pytest.mark.parametrize("name", ["KF-ANC", "KF-OPC", "leaky FxLMS"])
def test_a_tone_at_which_the_path_is_reversed_is_left_alone(name: str) -> None:
    """Three samples late at fs/6 is half a period: without the guard it diverges, with it nothing is done."""
    estimate = np.array([1.0, -0.6])
    x = tone(FS / 6, 4.0, fs=FS) + 1e-3 * np.random.default_rng(0).standard_normal(int(4 * FS))
    make: dict[str, Any] = {
        "KF-ANC": lambda: kf_anc(16, estimate, **DIRECT),
        "KF-OPC": lambda: kf_opc(16, estimate, constraint=OutputPowerConstraint(0.5, fs=FS), **DIRECT),
        "leaky FxLMS": lambda: leaky_fx_lms(16, estimate, step_size=1e-4, leak=1e-3),
    }
    changes = []
    for tolerance in (None, PathTolerance(delay_samples=3.0)):
        controller = make[name]()
        controller.secondary_path_uncertainty = tolerance
        result = simulate(controller, x, Plant(TRUE, PRIMARY, fs=FS))
        diverged = result.diverged_at_s is not None
        changes.append(np.inf if diverged else -noise_reduction_db(result.error, result.disturbance))
    assert changes[0] > 3.0
    assert changes[1] < 0.3


def test_an_uncertainty_that_comes_later_guards_what_was_heard_before() -> None:
    """After any number of samples; with the longest guard, for a filter as long, so that every stored sample counts."""
    guard = guard_filter(TOLERANCE, TRUE)
    assert guard is not None
    assert guard.size == 48
    assert abs(guard[-2]) > 1e-6  # the last one is 0
    x, d = np.random.default_rng(1).standard_normal((2, 400))
    for n in range(200, 350):  # more than a delay line is long
        one, other = (fx_lms(48, TRUE, step_size=1e-3) for _ in range(2))
        other.secondary_path_uncertainty = TOLERANCE
        for controller in (one, other):
            controller.listen(x[:n], d[:n])
        one.secondary_path_uncertainty = TOLERANCE
        emitted, expected = (controller.process(x[n : n + 20], d[n : n + 20]) for controller in (one, other))
        assert np.abs(expected).max() > 0.01
        np.testing.assert_allclose(emitted, expected, rtol=0, atol=1e-12)  # rounding of two orders of the same sums


def test_what_takes_no_uncertainty_says_what_does() -> None:
    settings: dict[str, Any] = {"state_noise": 0.0, "measurement_noise": 0.1}
    for controller in (
        kf_pb(4, TRUE, rated_power=1.0, fs=FS, secondary_path_uncertainty=TOLERANCE),
        KalmanController(KFOPC(dim_x=4, dim_z=1), TRUE),
    ):
        before = controller.secondary_path_uncertainty
        with pytest.raises(ValueError, match="no secondary_path_uncertainty can be assigned to"):
            controller.secondary_path_uncertainty = 0.1
        assert controller.secondary_path_uncertainty == before == (TOLERANCE if "KF-PB" in controller.name else None)
    with pytest.raises(ValueError, match="must not be negative"):
        kf_anc(4, TRUE, **settings).secondary_path_uncertainty = -1.0
