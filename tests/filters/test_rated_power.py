"""What a rated power of `KFOPC` needs, and what it is not for. Its steps are those of `test_against_filterpy.py`."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest

from kfopc_filterpy import KFOPC, OutputPowerConstraint

TAPS, FS = 5, 16000
both_kinds = pytest.mark.parametrize("kind", ["general", "random walk"])


def make(kind: str, **settings: Any) -> KFOPC:
    if kind == "general":
        return KFOPC(TAPS, **settings)
    return KFOPC.random_walk(TAPS, state_noise=1e-4, measurement_noise=0.3, **settings)


def constraint() -> OutputPowerConstraint:
    return OutputPowerConstraint(1.0, fs=FS, secondary_path_gain=1.0)


@both_kinds
def test_a_rated_power_comes_with_a_rate_or_a_constraint(kind: str) -> None:
    for both in ({"rated_power": 1.0}, {"fs": FS}):
        with pytest.raises(ValueError, match="give either rated_power= and fs=, or constraint=, which has both"):
            make(kind, **both, constraint=constraint())
    with pytest.raises(TypeError, match=r"constraint must be an OutputPowerConstraint or None, got 1\.0"):
        make(kind, constraint=1.0)
    with pytest.raises(ValueError, match=r"needs the sample rate.*give fs=.*kf\.constraint = OutputPowerConstraint"):
        make(kind, rated_power=1.0)
    with pytest.raises(ValueError, match="fs must be greater than 0"):
        make(kind, fs=0.0)
    kf = make(kind)
    with pytest.raises(ValueError, match="needs the sample rate"):
        kf.rated_power = 1.0
    assert kf.rated_power is kf.constraint is None
    kf = make(kind, fs=4000)
    assert kf.constraint is None
    kf.rated_power = 2.0
    assert (kf.constraint.fs, kf.constraint.memory_s, kf.rated_power) == (4000.0, 0.5, 2.0)
    assert make(kind, rated_power=2.0, fs=4000).constraint.fs == 4000.0


def test_the_filter_has_a_constraint_of_its_own_whose_settings_stay() -> None:
    given = OutputPowerConstraint(1.0, fs=FS, memory_s=0.1, secondary_path_gain=1.0)
    kf = KFOPC(TAPS, constraint=given)
    given.rated_power = 99.0
    assert kf.rated_power == 1.0
    kf.rated_power = None
    kf.rated_power = 2.0
    assert (kf.constraint.memory_s, kf.secondary_path_gain) == (0.1, 1.0)
    kf.update(3.0, H=np.ones(TAPS))
    kf.rated_power = 3.0
    assert kf.disturbance_power == 9.0  # the powers stay


def test_a_rated_power_is_for_one_measurement() -> None:
    with pytest.raises(ValueError, match="needs one measurement, got 2; kf_opc takes several"):
        KFOPC(4, constraint=constraint()).update([1.0, 2.0], H=np.ones((2, 4)), R=np.eye(2))
    for make_one in (lambda: KFOPC(4, 2, constraint=constraint()), lambda: KFOPC(4, 2, rated_power=1.0, fs=FS)):
        with pytest.raises(ValueError, match=r"needs one measurement, dim_z = 1, got dim_z = 2; kf_opc takes several"):
            make_one()


def test_the_constraint_factor_is_that_of_the_equation_and_needs_no_reference_if_the_gain_is_known() -> None:
    """sqrt(rho G / d^2)."""
    kf = KFOPC(2, constraint=constraint())
    kf.update(4.0, H=[1.0, 0.5])
    assert kf.constraint_factor == 0.25


@both_kinds
def test_a_factor_that_is_fixed_scales_the_measurement(kind: str) -> None:
    kf = make(kind, rated_power=1.0, fs=FS)
    for factor, y in ((0.5, 1.0), (0.0, 0.0), (1.0, 2.0)):
        kf.constraint_factor, kf.x = factor, np.zeros((TAPS, 1))
        kf.update(2.0, H=np.linspace(1.0 - factor, 1.0, TAPS).reshape(1, TAPS))
        assert (kf.y.item(), np.asarray(kf.z).item()) == (y, 2.0)
    kf.rated_power = None
    assert kf.constraint_factor == 1.0
    for name in ("constraint_factor", "disturbance_power", "secondary_path_gain"):
        with pytest.raises(ValueError, match=f"{name} needs a constraint: set rated_power first"):
            setattr(kf, name, 1.0)


# What a rated power is not for.


def test_a_tracker_is_refused_before_anything_changes() -> None:
    """Its measurement would be scaled: the estimate of a target at 19.8 m, moving at 2 m/s, would be 1.7 m."""
    kf = KFOPC(2, 1, rated_power=1.0, fs=10)
    kf.H, kf.M, kf.secondary_path_gain = [[1.0, 0.0]], np.zeros((2, 1)), 1.0
    kf.F[0, 1] = 0.1
    x, P = kf.x, kf.P
    for step in (kf.predict, kf.predict_steadystate, lambda: kf.update(19.8), lambda: kf.update_correlated(19.8)):
        with pytest.raises(
            ValueError, match=r"F must be the identity.*tracks a state.*filters\.constrained.*mask.*input u"
        ):
            step()
    with pytest.raises(ValueError, match="F must be the identity"):
        KFOPC(2, 1, rated_power=1.0, fs=10).predict(F=0.5)
    assert kf.x is x
    assert kf.P is P
    kf.rated_power = None
    kf.predict()
    kf.update(19.8)
    with pytest.raises(ValueError, match="F must be the identity"):
        kf.rated_power = 1.0
    assert kf.rated_power is None
    kf = make("random walk", constraint=constraint())
    with pytest.raises(ValueError, match="F must be the identity"):
        kf.predict(F=0.9 * np.eye(TAPS))


@both_kinds
def test_another_F_is_refused_when_it_is_assigned_and_the_filter_goes_on(kind: str) -> None:
    kf = make(kind, constraint=constraint())
    for other in (2.0 * np.eye(TAPS), (0.9 * np.eye(TAPS)).tolist()):
        with pytest.raises(ValueError, match="F must be the identity"):
            kf.F = other
    kf.predict()
    kf.F = np.eye(TAPS)
    kf.rated_power = None
    kf.F = 0.9 * np.eye(TAPS)


@both_kinds
@pytest.mark.parametrize("passed", [True, False])
def test_an_H_that_never_changes_is_refused_after_ten_steps(kind: str, passed: bool) -> None:
    kf = make(kind, constraint=constraint())
    kf.H = np.eye(1, TAPS)
    arguments = {"H": np.eye(1, TAPS)} if passed else {}
    for _ in range(10):
        kf.predict()
        kf.update(5.0, **arguments)
    twin = copy.deepcopy(kf)
    with pytest.raises(ValueError, match=r"H must change, but was the same in 10 steps.*filters\.constrained"):
        kf.update(5.0, **arguments)
    for f in (kf, twin):
        f.update(5.0, H=np.ones((1, TAPS)))
        for _ in range(20):  # from then on, it may be a constant
            f.update(5.0, **arguments)
    np.testing.assert_array_equal(kf.x, twin.x)
    assert kf.disturbance_power == twin.disturbance_power


@both_kinds
def test_a_silent_reference_at_the_start_is_none(kind: str) -> None:
    kf = make(kind, constraint=constraint())
    for _ in range(30):
        kf.predict()
        kf.update(0.1, H=np.zeros((1, TAPS)))
    assert kf.constraint_factor == 1.0
    assert not np.any(kf.x)
