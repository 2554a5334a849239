"""KFOPC with a rated power, one loudspeaker: eq. 9-13 with the general filter and with the random walk.

`test_loudspeakers.py` has several. Against the plain-Python filter the tolerance is 1e-10 relative, the rounding of some
hundred steps in another order of sums.
"""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given
from hypothesis import strategies as st
from oracles.kalman import correct as correct_by_hand
from oracles.powers import Constraint

from kfopc_filterpy import KFOPC, OutputPowerConstraint

TAPS, STATE_NOISE, NOISE, FS = 5, 1e-4, 0.3, 16000
UPDATES = ["update", "update_steadystate", "update_correlated", "update_sequential"]
UPDATES = [name for name in UPDATES if hasattr(KalmanFilter, name)]  # 1.4.5 has no update_sequential
POWERS = ("constraint_factor", "disturbance_power", "secondary_path_gain")
both_kinds = pytest.mark.parametrize("kind", ["general", "random walk"])


def make(kind: str, rated_power: float | None = None, **settings: Any) -> KFOPC:
    """A filter; `settings` are those of its constraint."""
    own: dict[str, Any] = {"rated_power": rated_power, "fs": FS}
    if settings:
        own = {"constraint": OutputPowerConstraint(rated_power or 1.0, **{"fs": FS} | settings)}
    if kind == "random walk":
        kf: KFOPC = KFOPC.random_walk(TAPS, state_noise=STATE_NOISE, measurement_noise=NOISE, **own)
    else:
        kf = KFOPC(TAPS, **own)
        kf.Q, kf.R = STATE_NOISE * np.eye(TAPS), np.array([[NOISE]])
    kf.M = np.zeros((TAPS, 1))  # 1.4.5 makes it (1, 1), which its own update_correlated cannot use
    return kf


def correct(kf: KalmanFilter, method: str, z: Any, **kwargs: Any) -> None:
    """Any method that corrects the state; update_sequential from the first row on."""
    getattr(kf, method)(*([0, z] if method == "update_sequential" else [z]), **kwargs)


def scene(n: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reference, rows of the filtered reference (newest first), disturbance."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=n + TAPS)
    filtered = np.convolve(x, [0.2, 0.7, -0.3])[: x.size]
    rows = np.array([filtered[k + TAPS - 1 :: -1][:TAPS] for k in range(n)])
    return x[TAPS - 1 : TAPS - 1 + n], rows, rows @ [3.0, -2.0, 1.0, 0.5, 0.0] + 0.5 * rng.normal(size=n)


@both_kinds
def test_eq_2_to_13_against_the_oracle(kind: str) -> None:
    x, rows, d = scene(400)
    kf, powers = make(kind, 0.5, fs=1000.0, memory_s=0.1), Constraint(0.5, fs=1000.0, memory_s=0.1)
    w, P, factors = np.zeros(TAPS), np.eye(TAPS), []
    for k, row in enumerate(rows):
        kf.predict()
        kf.update(d[k], H=row, reference=x[k])
        factors.append(powers.take(d[k] ** 2, row[0] ** 2, x[k] ** 2))
        P = P + STATE_NOISE * np.eye(TAPS)
        assert kf.S[0, 0] == pytest.approx(row @ P @ row + NOISE, rel=1e-10)
        w, P = correct_by_hand(w, P, row, factors[-1] * d[k], NOISE)
        assert kf.constraint_factor == pytest.approx(factors[-1], rel=1e-10)
        np.testing.assert_allclose(kf.x[:, 0], w, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(kf.P, P, rtol=1e-10, atol=1e-12)
    assert min(factors) < 0.5, "the constraint never acted"


@pytest.mark.parametrize("method", UPDATES)
@pytest.mark.parametrize("dim_z", [1, 2])
@given(factor=st.floats(0.0, 1.0), z=st.floats(-100, 100), x_ndim=st.integers(1, 2))
def test_every_update_scales_its_measurement(method: str, dim_z: int, factor: float, z: float, x_ndim: int) -> None:
    """filterpy's filter with the scaled measurement is the oracle: x, P, y, S, K, likelihoods; z stays as given."""
    if method == "update_sequential" and x_ndim == 1:
        return  # filterpy's own has no 1-D state
    measured = np.array([z, -z][:dim_z]).reshape((dim_z, 1)[:x_ndim])
    filters = []
    for cls in (KalmanFilter, KFOPC):
        kf = cls(3, dim_z)
        kf.x = np.ones((3, 1)[:x_ndim])
        kf.H, kf.F, kf.M = np.arange(1.0, 1 + 3 * dim_z).reshape(dim_z, 3), 0.9 * np.eye(3), np.full((3, dim_z), 0.01)
        kf.K = np.full((3, dim_z), 0.1)
        kf.predict()
        filters.append(kf)
    kf, ours = filters
    ours.constraint_factor = factor
    assert np.array_equal(ours.residual_of(measured), kf.residual_of(factor * measured))
    assert np.array_equal(ours.get_update(measured)[0], kf.get_update(factor * measured)[0])
    correct(kf, method, factor * measured)
    correct(ours, method, measured)
    for name in ("x", "P", "y", "S", "K", "x_post", "P_post"):
        assert np.array_equal(getattr(kf, name), getattr(ours, name)), name
    if method != "update_steadystate":  # S is 0 there
        assert kf.log_likelihood == ours.log_likelihood
        assert ours.log_likelihood_of(measured) == kf.log_likelihood_of(factor * measured)
    assert np.array_equal(ours.z, measured)
    assert ours.z.shape == kf.z.shape


@both_kinds
def test_a_batch_takes_references_and_its_steps_go_on_without(kind: str) -> None:
    x, rows, d = scene(60)
    batch, steps = make(kind, 0.5), make(kind, 0.5)
    zs: list[float | None] = d.tolist()
    zs[7] = zs[20] = None
    means, covariances, _, _ = batch.batch_filter(zs, Hs=list(rows), references=x)
    for k, z in enumerate(zs):
        steps.predict()
        steps.update(z, H=rows[k], reference=x[k])
        assert np.array_equal(means[k], steps.x)
        assert np.array_equal(covariances[k], steps.P)
    for name in POWERS:
        assert getattr(batch, name) == getattr(steps, name)
    assert steps.constraint_factor < 1.0
    masked = np.ma.array(d, mask=[z is None for z in zs])
    masked.data[masked.mask] = 1e6
    assert np.array_equal(make(kind, 0.5).batch_filter(masked, Hs=rows, references=x)[0], means)
    for arguments, match in (({}, "pass reference="), ({"references": x[1:]}, "references must have 60 values")):
        with pytest.raises(ValueError, match=match):
            batch.batch_filter(zs, Hs=rows, **arguments)
    batch.update(1.0, H=rows[0], reference=1.0)


@both_kinds
@pytest.mark.parametrize("method", UPDATES)
def test_what_changes_the_state_advances_the_powers_once(kind: str, method: str) -> None:
    kf = make(kind, 0.5)
    kf.H = np.full((1, TAPS), 3.0)
    kf.predict()
    kf.update(2.0, reference=1.0)
    correct(kf, method, 4.0, reference=2.0)
    assert kf.disturbance_power == pytest.approx((2.0**2 + 4.0**2) / 2)
    assert kf.secondary_path_gain == pytest.approx(9.0 / ((1.0 + 4.0) / 2))
    assert kf.constraint_factor == pytest.approx(math.sqrt(0.5 * 3.6 / 10.0))
    before = [getattr(kf, name) for name in POWERS]
    kf.get_update(9.0), kf.residual_of(9.0), kf.log_likelihood_of(9.0), kf.measurement_of_state(kf.x)
    kf.predict()
    kf.predict_steadystate()
    if method != "update_sequential":
        correct(kf, method, None, reference=5.0)  # a missed sample
    assert [getattr(kf, name) for name in POWERS] == before


@both_kinds
def test_a_rated_power_may_come_and_go_and_its_values_be_supplied(kind: str) -> None:
    kf = make(kind, 3.0, secondary_path_gain=1.0)
    kf.rated_power = None
    assert [getattr(kf, name) for name in ("rated_power", "constraint", *POWERS)] == [None, None, 1.0, None, None]
    for name in POWERS[1:]:
        with pytest.raises(ValueError, match=rf"{name}.*rated_power"):
            setattr(kf, name, 1.0)
    kf.constraint_factor = 0.5
    kf.update(2.0, H=np.ones(TAPS))
    assert kf.y.item() == 1.0
    kf.constraint_factor = None
    kf.rated_power = 1.0  # the settings are those that the constraint was given
    kf.update(4.0, H=np.ones(TAPS))
    assert kf.constraint_factor == 0.25
    kf.rated_power = 4.0  # the powers stay
    kf.update(4.0, H=np.ones(TAPS))
    assert kf.constraint_factor == 0.5
    kf.disturbance_power, kf.secondary_path_gain = 64.0, 0.25
    kf.update(4.0, H=np.ones(TAPS))
    assert kf.constraint_factor == 0.125


@both_kinds
def test_a_constraint_that_is_none_or_one_too_many_is_refused(kind: str) -> None:
    noises = {"state_noise": 0.0, "measurement_noise": 1.0} if kind == "random walk" else {}
    made: Any = KFOPC.random_walk if kind == "random walk" else KFOPC
    for both in ({"rated_power": 1.0}, {"fs": FS}):
        with pytest.raises(ValueError, match="give either rated_power= and fs=, or constraint=, which has both"):
            made(3, **both, constraint=OutputPowerConstraint(1.0, fs=8000), **noises)
    with pytest.raises(TypeError, match=r"constraint must be an OutputPowerConstraint or None, got 1\.0"):
        made(3, constraint=1.0, **noises)
    kf = make(kind)
    with pytest.raises(TypeError, match="constraint must be an OutputPowerConstraint or None, got 'tight'"):
        kf.constraint = "tight"
    assert kf.constraint is None


@both_kinds
def test_a_rated_power_needs_the_sample_rate_of_its_memory(kind: str) -> None:
    noises = {"state_noise": 0.0, "measurement_noise": 1.0} if kind == "random walk" else {}
    made: Any = KFOPC.random_walk if kind == "random walk" else KFOPC
    with pytest.raises(ValueError, match=r"needs the sample rate.*give fs=.*kf\.constraint = OutputPowerConstraint"):
        made(3, rated_power=1.0, **noises)
    kf = made(3, **noises)
    for power in (1.0, [1.0]):
        with pytest.raises(ValueError, match="needs the sample rate"):
            kf.rated_power = power
    assert kf.rated_power is kf.constraint is None
    kf.constraint = OutputPowerConstraint(1.0, fs=8000, memory_s=0.1)
    assert kf.rated_power == 1.0
    with pytest.raises(ValueError, match="fs must be greater than 0"):
        made(3, fs=0.0, **noises)
    kf = made(3, fs=4000, **noises)
    assert kf.constraint is None
    kf.rated_power = 2.0
    assert (kf.constraint.fs, kf.constraint.memory_s, kf.rated_power) == (4000.0, 0.5, 2.0)
    assert made(3, rated_power=2.0, fs=4000, **noises).constraint.fs == 4000.0


# What a rated power is not for.


def test_a_tracker_is_refused_before_anything_changes() -> None:
    """Its measurement would be scaled: the estimate of a target at 19.8 m, moving at 2 m/s, would be 1.7 m."""
    kf = KFOPC(2, 1, rated_power=1.0, fs=10)
    kf.F, kf.H = [[1.0, 0.1], [0.0, 1.0]], [[1.0, 0.0]]
    kf.secondary_path_gain, kf.M = 1.0, np.zeros((2, 1))
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
    kf = make("random walk", 1.0, secondary_path_gain=1.0)
    with pytest.raises(ValueError, match="F must be the identity"):
        kf.predict(F=0.9 * np.eye(TAPS))


@both_kinds
@pytest.mark.parametrize("passed", [True, False])
def test_an_H_that_never_changes_is_refused_after_ten_steps(kind: str, passed: bool) -> None:
    kf = make(kind, 1.0, secondary_path_gain=1.0)
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
    kf = make(kind, 1.0, secondary_path_gain=1.0)
    for _ in range(30):
        kf.predict()
        kf.update(0.1, H=np.zeros((1, TAPS)))
