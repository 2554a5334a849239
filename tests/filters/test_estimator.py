"""KFOPC beyond filterpy's filter: the scaled measurement, eq. 9-13, and what it refuses.

Each test of the constraint and of faults runs with the general filter and with the random-walk one. Where the two
must give what filterpy gives for the scaled measurement, the comparison is exact; against the plain-Python filter
below it is 1e-10 relative, the rounding of some hundred steps in another order of sums.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given
from hypothesis import strategies as st
from oracles.kalman import correct as correct_by_hand
from oracles.powers import Constraint

from kfopc_filterpy import KFOPC, OutputPowerConstraint

TAPS, STATE_NOISE, NOISE = 5, 1e-4, 0.3
NAN, INF = math.nan, math.inf
HAS_SEQUENTIAL = hasattr(KalmanFilter, "update_sequential")  # not in filterpy 1.4.5
KINDS = ["general", "random walk"]
UPDATES = ["update", "update_steadystate", "update_correlated"] + ["update_sequential"] * HAS_SEQUENTIAL

both_kinds = pytest.mark.parametrize("kind", KINDS)
rated_or_not = pytest.mark.parametrize("rated_power", [None, 0.5])


def make(kind: str, rated_power: float | None = None, **settings: Any) -> KFOPC:
    """A filter; `settings` are those of its constraint."""
    own: dict[str, Any] = {"rated_power": rated_power}
    if rated_power is not None and settings:
        own = {"constraint": OutputPowerConstraint(rated_power, **settings)}
    if kind == "random walk":
        kf: KFOPC = KFOPC.random_walk(TAPS, state_noise=STATE_NOISE, measurement_noise=NOISE, **own)
    else:
        kf = KFOPC(TAPS, **own)
        kf.Q, kf.R = STATE_NOISE * np.eye(TAPS), np.array([[NOISE]])
    kf.M = np.zeros((TAPS, 1))  # 1.4.5 makes it (1, 1), which its own update_correlated cannot use
    return kf


POWERS = ("constraint_factor", "disturbance_power", "secondary_path_gain")
SHOWN = ("x", "P", "x_prior", "P_prior", "x_post", "P_post", "K", "S", "SI", "y", "z", "F", "Q", "R", "H", "alpha")


def assert_same(kf: KFOPC, other: KFOPC, names: tuple[str, ...] = (*SHOWN, *POWERS, "rated_power")) -> None:
    for name in names:
        np.testing.assert_array_equal(getattr(kf, name), getattr(other, name), err_msg=name)


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


# The scaled measurement.


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
        assert kf.likelihood == ours.likelihood
        assert ours.log_likelihood_of(measured) == kf.log_likelihood_of(factor * measured)
    assert np.array_equal(ours.z, measured)
    assert ours.z.shape == kf.z.shape


@both_kinds
def test_batch_filter_scales_and_takes_references(kind: str) -> None:
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
    assert_same(batch, steps)
    assert steps.constraint_factor < 1.0
    with pytest.raises(ValueError, match="reference"):
        batch.batch_filter(zs, Hs=list(rows))  # the references were those of the batch only
    with pytest.raises(ValueError, match=r"references must have 60 values, got 59"):
        batch.batch_filter(zs, Hs=list(rows), references=x[1:])


# Power estimates: which methods advance them, and what can be supplied.


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


@both_kinds
def test_what_leaves_the_state_leaves_the_powers(kind: str) -> None:
    kf = make(kind, 0.5)
    kf.H = np.full((1, TAPS), 3.0)
    kf.predict()
    kf.update(2.0, reference=1.0)
    before = copy.deepcopy(kf)
    kf.get_update(9.0), kf.residual_of(9.0), kf.log_likelihood_of(9.0), kf.measurement_of_state(kf.x)
    kf.predict()
    kf.predict_steadystate()
    for method in ("update", "update_steadystate", "update_correlated"):  # missed samples
        getattr(kf, method)(None, reference=5.0)
        assert kf.z.tolist() == [[None]]
        assert kf.y.tolist() == [[0.0]]
    assert_same(kf, before, POWERS)


def test_without_a_rated_power() -> None:
    kf = make("general")
    assert (kf.rated_power, kf.constraint, kf.constraint_factor) == (None, None, 1.0)
    assert (kf.disturbance_power, kf.secondary_path_gain) == (None, None)
    for name in ("disturbance_power", "secondary_path_gain"):
        with pytest.raises(ValueError, match=rf"{name}.*rated_power"):
            setattr(kf, name, 1.0)
    kf.constraint_factor = 0.5
    kf.predict()
    kf.update(2.0, H=np.ones(TAPS))
    assert kf.y.item() == 1.0
    kf.constraint_factor = None
    assert kf.constraint_factor == 1.0


def test_the_rated_power_may_come_and_go() -> None:
    kf = make("general", 3.0, secondary_path_gain=1.0)
    kf.rated_power = None
    kf.rated_power = 1.0  # the settings are those that the constraint was given
    kf.update(4.0, H=np.ones(TAPS))
    assert kf.constraint_factor == 0.25
    kf.rated_power = 4.0  # the powers stay
    kf.update(4.0, H=np.ones(TAPS))
    assert kf.constraint_factor == 0.5
    kf.rated_power = None
    kf.update(4.0, H=np.ones(TAPS))
    assert kf.constraint_factor == 1.0


# Faults: a clear error, nothing changed, and the filter goes on as one that never saw them.


ROW = np.linspace(1.0, 2.0, TAPS)
Fault = tuple[Callable[[KFOPC], Any], str]


def row_with(value: float) -> np.ndarray:
    row = ROW.copy()
    row[2] = value
    return row


def faults_of_updates() -> dict[str, Fault]:
    """All faults of `update`; of the others, one of each argument."""
    bad_z = {"NaN": NAN, "Inf": INF, "two": [1.0, 2.0], "3-D": np.ones((1, 1, 1)), "text": "loud", "[None]": [None]}
    bad_z |= {"complex": 1.0 + 2.0j, "[complex]": np.array([1.0 + 0.0j])}
    bad_reference = {"NaN": NAN, "two": [1.0, 2.0], "text": "x"}
    bad_H = {"NaN": row_with(NAN), "long": np.ones(TAPS + 1), "column": np.ones((TAPS, 1)), "number": 2.0}
    bad_R = {"NaN": NAN, "negative": -1.0, "[[-1]]": [[-1.0]], "too large": np.eye(2)}
    found: dict[str, Fault] = {}

    def add(method: str, what: str, match: str, z: Any = 1.0, **arguments: Any) -> None:
        found[f"{method}: {what}"] = lambda f: correct(f, method, z, **{"reference": 1.0} | arguments), match

    for method in UPDATES:
        suffix = "_i" if method == "update_sequential" else ""
        values = [("z", bad_z), ("reference", bad_reference)]
        if method != "update_steadystate":
            values += [("H", bad_H), ("R", bad_R)]
            add(method, "silent reference", "silent", **{"H" + suffix: np.zeros(TAPS), "R" + suffix: 0.0})
        for name, cases in values:
            for what, value in list(cases.items())[: None if method == "update" else 1]:
                match = "z must be real, got complex" if "complex" in what else rf"\b{name}\b|{name}_"
                add(method, f"{name} {what}", match, **{name + suffix * (name in "HR"): value})
        if method != "update":  # which takes it as missing
            add(method, "z masked", "z must not be masked, except in update", z=np.ma.masked)
    add("update", "two rows for one measurement", "z", z=[1.0, 2.0, 3.0], H=np.ones((2, TAPS)))
    return found


def faults_of_other_steps() -> dict[str, Fault]:
    zs, rows = [1.0, 2.0, 3.0, 4.0], [ROW] * 4

    def batch(f: KFOPC, **kwargs: Any) -> None:
        f.batch_filter(**{"zs": zs, "Hs": rows, "references": [1.0, 1.0, 0.5, 2.0]} | kwargs)

    return {
        "predict: F NaN": (lambda f: f.predict(F=NAN * np.eye(TAPS)), "F"),
        "predict: F of another size": (lambda f: f.predict(F=np.eye(TAPS + 1)), "F"),
        "predict: F as a ragged list": (lambda f: f.predict(F=[[1.0], [1.0, 0.0]]), "F must be .*differ in length"),
        "predict: F complex": (lambda f: f.predict(F=1j), "F"),
        "predict: Q beyond a float": (lambda f: f.predict(Q=10**400), "Q"),
        "H assigned as text": (lambda f: setattr(f, "H", [["a"]]), "H must be a sequence of real numbers"),
        "residual_of: z masked": (lambda f: f.residual_of(np.ma.array([7.0], mask=[True])), "z must not be masked"),
        "predict: Q negative": (lambda f: f.predict(Q=-1.0), "Q"),
        "predict: Q of another size": (lambda f: f.predict(Q=np.eye(2)), "Q"),
        "predict: Q with a negative variance": (lambda f: f.predict(Q=np.diag([1.0, 1, -1, 1, 1])), "Q"),
        "predict: u NaN": (lambda f: f.predict(u=NAN, B=np.ones((TAPS, 1))), "u"),
        "predict: B of another size": (lambda f: f.predict(u=np.ones((1, 1)), B=np.ones((TAPS + 1, 1))), "shape"),
        "predict: x broadcast": (lambda f: f.predict(u=np.ones((1, 3)), B=np.ones((TAPS, 1))), "x would become"),
        "predict: overflow": (lambda f: f.predict(F=1e200 * np.eye(TAPS)), "NaN or Inf"),
        "predict_steadystate: u NaN": (lambda f: f.predict_steadystate(u=NAN, B=np.ones((TAPS, 1))), "u"),
        "batch_filter: z NaN": (lambda f: batch(f, zs=[1.0, 2.0, NAN, 4.0]), "z"),
        "batch_filter: z of another size": (lambda f: batch(f, zs=[[1.0], [2.0], [3.0, 1.0], [4.0]]), "z|shape"),
        "batch_filter: H Inf": (lambda f: batch(f, Hs=[ROW, ROW, ROW, row_with(INF)]), "H"),
        "batch_filter: reference NaN": (lambda f: batch(f, references=[1.0, NAN, 1.0, 1.0]), "references"),
        "batch_filter: silent": (lambda f: batch(f, Hs=[ROW, ROW, 0 * ROW, ROW], Rs=[1.0, 1.0, 0.0, 1.0]), "silent"),
        **{
            f"batch_filter: {name} end early": (
                lambda f, name=name, value=value: batch(f, **{name: [value] * 3}),
                f"{name} must have",
            )
            for name, value in {"Fs": np.eye(TAPS), "Qs": 0.1, "Hs": ROW, "Rs": 0.1, "us": 0.0}.items()
        },
        "alpha NaN": (lambda f: setattr(f, "alpha", NAN), "alpha"),
        "alpha whose square overflows": (lambda f: setattr(f, "alpha", 1e200), "alpha"),
        "alpha below 1": (lambda f: setattr(f, "alpha", 0.5), "alpha"),
        "constraint_factor negative": (lambda f: setattr(f, "constraint_factor", -0.5), "constraint_factor"),
        "rated_power negative": (lambda f: setattr(f, "rated_power", -1.0), "rated_power"),
    }


def faults_of_random_walk_assignments() -> dict[str, Fault]:
    asymmetric = np.eye(TAPS)
    asymmetric[0, 1] = 0.5
    bad = {
        "F": {"NaN": NAN * np.eye(TAPS), "of another size": np.eye(2)},
        "Q": {"negative": -1.0, "-I": -np.eye(TAPS), "of another size": np.eye(2)},
        "R": {"negative": -1.0, "[[Inf]]": [[INF]], "of another size": np.eye(2)},
        "P": {"NaN": NAN * np.eye(TAPS), "asymmetric": asymmetric, "of another size": np.eye(2)},
        "state_noise": {"negative": -1.0, "two": [1.0, 2.0], "None": None},
        "measurement_noise": {"negative": -1.0, "text": "quiet"},
    }
    return {
        f"{name} {what}": (lambda f, name=name, value=value: setattr(f, name, value), name)
        for name, values in bad.items()
        for what, value in values.items()
    }


STEP_FAULTS = faults_of_updates() | faults_of_other_steps()
FAULTS = [(kind, name) for kind in KINDS for name in STEP_FAULTS]
OVERFLOWS: dict[str, Fault] = {  # on a random walk to rounding only, see test_random_walk.py
    "1/S": (lambda f: f.update(1.0, R=1e-310, H=1e-160 * ROW, reference=1.0), "NaN or Inf|overflow"),
    "x": (lambda f: f.update(1e308, R=1e-12, H=1e-3 * ROW, reference=1.0), "NaN or Inf|overflow|finite square"),
}
FAULTS += [("general", name) for name in OVERFLOWS]
FAULTS += [("random walk", name) for name in faults_of_random_walk_assignments()]


def healthy_run(kf: KFOPC, steps: int, start: int = 0) -> None:
    x, rows, d = scene(30)
    for k in range(start, start + steps):
        kf.predict()
        kf.update(d[k], H=rows[k], reference=x[k])


@rated_or_not
@pytest.mark.parametrize(("kind", "name"), FAULTS)
def test_a_fault_changes_nothing(kind: str, name: str, rated_power: float | None) -> None:
    fault, match = (STEP_FAULTS | OVERFLOWS | faults_of_random_walk_assignments())[name]
    kf = make(kind, rated_power)
    kf.H = ROW.reshape(1, -1)
    healthy_run(kf, 8)
    twin = copy.deepcopy(kf)
    with pytest.raises((ValueError, TypeError, AttributeError), match=match) as caught:
        fault(kf)
    assert str(caught.value), "an error says what is wrong"
    assert_same(kf, twin)
    for f in (kf, twin):
        healthy_run(f, 8, start=8)
    assert_same(kf, twin)


@rated_or_not
@both_kinds
@pytest.mark.parametrize("name", ["x", "P", "H"])
def test_a_poison_written_into_an_attribute_is_found_and_can_be_taken_out(
    kind: str, name: str, rated_power: float | None
) -> None:
    kf = make(kind, rated_power)
    kf.H = ROW.reshape(1, -1).copy()
    healthy_run(kf, 5)
    twin = copy.deepcopy(kf)
    good = getattr(kf, name)[0, 0]
    getattr(kf, name)[0, 0] = NAN
    with pytest.raises(ValueError, match=rf"NaN.* {name},|{name} must be finite|{name} .*finite|{name} would hold NaN"):
        kf.update(1.0, reference=1.0)
    getattr(kf, name)[0, 0] = good
    for f in (kf, twin):
        healthy_run(f, 5, start=5)
    np.testing.assert_array_equal(kf.x, twin.x)
    np.testing.assert_allclose(kf.P, twin.P, rtol=1e-13)  # taken in as edited, at another moment


@both_kinds
def test_an_interrupted_step_changes_nothing(kind: str) -> None:
    """Whatever breaks off a step of filterpy's own equations, an inverse of the user's among them."""
    kf = make(kind)
    healthy_run(kf, 3)
    twin = copy.deepcopy(kf)

    def interrupted(_: np.ndarray) -> np.ndarray:
        raise KeyboardInterrupt

    kf.inv = twin.inv = interrupted
    with pytest.raises(KeyboardInterrupt):
        kf.update_correlated(1.0, H=ROW)
    assert_same(kf, twin)


@pytest.mark.skipif(not HAS_SEQUENTIAL, reason="filterpy 1.4.5 has no update_sequential")
def test_update_sequential_stays_within_the_measurements() -> None:
    kf = KFOPC(3, 2)
    kf.H = np.eye(2, 3)
    for start, z in ((-1, 1.0), (2, 1.0), (1, [1.0, 2.0])):
        with pytest.raises(ValueError, match="start"):
            kf.update_sequential(start, z, R_i=1.0, H_i=np.ones((np.size(z), 3)))
    kf.update(np.array([1.0, 2.0]), H=np.eye(2, 3))
    kf.update_sequential(1, 1.0)
    assert kf.z.tolist() == [[1.0], [1.0]]


@pytest.mark.skipif(HAS_SEQUENTIAL, reason="filterpy 2.0.0 has update_sequential")
def test_update_sequential_needs_filterpy_2() -> None:
    with pytest.raises(AttributeError, match=r"2\.0\.0"):
        KFOPC(2).update_sequential(0, 1.0)


@pytest.mark.parametrize(
    "make", [KFOPC, lambda n, **own: KFOPC.random_walk(n, state_noise=0, measurement_noise=1, **own)]
)
def test_a_constraint_that_is_none_or_one_too_many_is_refused(make: Callable) -> None:
    with pytest.raises(ValueError, match=r"give either rated_power= or constraint=.*, not both"):
        make(3, rated_power=1.0, constraint=OutputPowerConstraint(1.0))
    with pytest.raises(TypeError, match=r"constraint must be an OutputPowerConstraint or None, got 1\.0"):
        make(3, constraint=1.0)
    kf = make(3)
    with pytest.raises(TypeError, match="constraint must be an OutputPowerConstraint or None, got 'tight'"):
        kf.constraint = "tight"
    assert kf.constraint is None
