"""What would corrupt a filter is refused with a clear error: nothing has changed, and it goes on as one that never saw it."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from kfopc_filterpy import KFOPC

TAPS, FS = 5, 16000
NAN, INF = math.nan, math.inf
ROW = np.linspace(1.0, 2.0, TAPS)
UPDATES = ["update", "update_steadystate", "update_correlated", "update_sequential"]
UPDATES = [name for name in UPDATES if hasattr(KalmanFilter, name)]  # 1.4.5 has no update_sequential
STATE = ("x", "P", "x_prior", "P_prior", "x_post", "P_post", "K", "S", "SI", "y", "F", "Q", "R", "H", "M", "alpha")
POWERS = ("rated_power", "constraint_factor", "disturbance_power", "secondary_path_gain")
Fault = tuple[Callable[[KFOPC], Any], str]


def make(kind: str, rated_power: float | None = None) -> KFOPC:
    """A filter after some steps."""
    if kind == "random walk":
        kf: KFOPC = KFOPC.random_walk(TAPS, state_noise=1e-4, measurement_noise=0.3, rated_power=rated_power, fs=FS)
    else:
        kf = KFOPC(TAPS, rated_power=rated_power, fs=FS)
        kf.Q, kf.R = 1e-4 * np.eye(TAPS), np.array([[0.3]])
    kf.H, kf.M = ROW.reshape(1, -1).copy(), np.zeros((TAPS, 1))
    run(kf, 8)
    return kf


def run(kf: KFOPC, steps: int) -> None:
    rng = np.random.default_rng(steps)
    for _ in range(steps):
        kf.predict()
        kf.update(rng.normal(), H=rng.normal(size=TAPS), reference=rng.normal())


def require_same_course(kf: KFOPC, twin: KFOPC) -> None:
    """Both are in the same state, and stay so."""
    for steps in (0, 4):
        run(kf, steps), run(twin, steps)
        for name in (*STATE, *POWERS):
            np.testing.assert_array_equal(getattr(kf, name), getattr(twin, name), err_msg=name)


def row_with(value: float) -> np.ndarray:
    row = ROW.copy()
    row[2] = value
    return row


def faults_of_updates() -> dict[str, Fault]:
    """All faults of `update`; of the others, one of each argument."""
    bad_z = {"NaN": NAN, "Inf": INF, "two": [1.0, 2.0], "3-D": np.ones((1, 1, 1)), "text": "loud", "[None]": [None]}
    bad_z |= {"complex": 1.0 + 2.0j, "[complex]": np.array([1.0 + 0.0j]), "[NaN]": np.array([NAN])}
    bad_reference = {"NaN": NAN, "two": [1.0, 2.0], "text": "x"}
    bad_H = {"NaN": row_with(NAN), "long": np.ones(TAPS + 1), "column": np.ones((TAPS, 1)), "number": 2.0}
    bad_R = {"NaN": NAN, "negative": -1.0, "[[-1]]": [[-1.0]], "too large": np.eye(2)}
    found: dict[str, Fault] = {}

    def add(method: str, what: str, match: str, z: Any = 1.0, **arguments: Any) -> None:
        given = [0, z] if method == "update_sequential" else [z]
        found[f"{method}: {what}"] = lambda f: getattr(f, method)(*given, **{"reference": 1.0} | arguments), match

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


def changed(f: KFOPC, name: str, value: Any, step: Callable[[], Any]) -> None:
    """Take a step with an attribute that is wrong, and put back the right one."""
    good = getattr(f, name)
    try:
        setattr(f, name, value)
        step()
    finally:
        setattr(f, name, good)


def faults_of_other_steps() -> dict[str, Fault]:
    zs, rows = [1.0, 2.0, 3.0, 4.0], [ROW] * 4

    def batch(f: KFOPC, **kwargs: Any) -> None:
        f.batch_filter(**{"zs": zs, "Hs": rows, "references": [1.0, 1.0, 0.5, 2.0]} | kwargs)

    def smooth(f: KFOPC, **kwargs: Any) -> None:
        f.rts_smoother(**{"Xs": np.ones((3, TAPS, 1)), "Ps": [np.eye(TAPS)] * 3} | kwargs)

    def moved(f: KFOPC, **inputs: Any) -> None:
        twin = copy.deepcopy(f)
        twin.rated_power = None
        twin.predict(u=1.0, B=np.ones((TAPS, 1)))
        smooth(twin, us=[0.0] * 3)
        smooth(twin, **inputs)

    short = {"Fs": np.eye(TAPS), "Qs": 0.1, "Hs": ROW, "Rs": 0.1, "us": 0.0}
    return {
        "predict: F NaN": (lambda f: f.predict(F=NAN * np.eye(TAPS)), "F"),
        "predict: F of another size": (lambda f: f.predict(F=np.eye(TAPS + 1)), "F"),
        "predict: F as a ragged list": (lambda f: f.predict(F=[[1.0], [1.0, 0.0]]), "F must be .*differ in length"),
        "predict: F complex": (lambda f: f.predict(F=1j), "F"),
        "predict: overflow": (lambda f: f.predict(F=1e200 * np.eye(TAPS)), "NaN, Inf|F must be"),
        "predict: Q beyond a float": (lambda f: f.predict(Q=10**400), "Q"),
        "predict: Q negative": (lambda f: f.predict(Q=-1.0), "Q"),
        "predict: Q of another size": (lambda f: f.predict(Q=np.eye(2)), "Q"),
        "predict: Q with a negative variance": (lambda f: f.predict(Q=np.diag([1.0, 1, -1, 1, 1])), "Q"),
        "predict: P would overflow": (lambda f: f.batch_filter([None] * 2, Qs=[1.5e308] * 2), "overflow|NaN, Inf"),
        "predict: u NaN": (lambda f: f.predict(u=NAN, B=np.ones((TAPS, 1))), "u"),
        "predict: B of another size": (lambda f: f.predict(u=np.ones((1, 1)), B=np.ones((TAPS + 1, 1))), "shape"),
        "predict: x broadcast": (lambda f: f.predict(u=np.ones((1, 3)), B=np.ones((TAPS, 1))), "x would become"),
        "predict_steadystate: u NaN": (lambda f: f.predict_steadystate(u=NAN, B=np.ones((TAPS, 1))), "u"),
        "update: S overflows": (lambda f: f.update(1.0, H=1e160 * ROW, reference=1.0), "overflow|NaN|finite square"),
        "update: 1/S overflows": (lambda f: f.update(1.0, R=1e-310, H=1e-160 * ROW, reference=1.0), "NaN|overflow"),
        "update: x overflows": (
            lambda f: f.update(1e308, R=1e-12, H=1e-3 * ROW, reference=1.0),
            "NaN|overflow|finite square",
        ),
        "H assigned as text": (lambda f: setattr(f, "H", [["a"]]), "H must be a sequence of real numbers"),
        "update_steadystate: K": (
            lambda f: changed(f, "K", np.ones((1, 1)), lambda: f.update_steadystate(1.0)),
            "K must",
        ),
        "update_correlated: M": (
            lambda f: changed(f, "M", np.ones((1, 1)), lambda: f.update_correlated(1.0)),
            "M must",
        ),
        "residual_of: z masked": (lambda f: f.residual_of(np.ma.array([7.0], mask=[True])), "z must not be masked"),
        "residual_of: z of another size": (lambda f: f.residual_of([1.0, 2.0]), "z "),
        "get_update: z of another size": (lambda f: f.get_update([1.0, 2.0]), "z "),
        "log_likelihood_of: z of another size": (
            lambda f: f.log_likelihood_of([1.0, 2.0]),
            r"z must have 1 value\(s\)",
        ),
        "get_prediction: x broadcast": (lambda f: f.get_prediction(u=np.ones((1, 3)), B=np.ones((TAPS, 1))), "x would"),
        "get_prediction: Q a vector": (lambda f: f.get_prediction(Q=np.ones(TAPS)), "Q must have shape"),
        "batch_filter: z NaN": (lambda f: batch(f, zs=[1.0, 2.0, NAN, 4.0]), "step 2 of the batch: z must be finite"),
        "batch_filter: z of another size": (lambda f: batch(f, zs=[[1.0], [2.0], [3.0, 1.0], [4.0]]), "z|shape"),
        "batch_filter: H Inf": (lambda f: batch(f, Hs=[ROW, ROW, ROW, row_with(INF)]), "H"),
        "batch_filter: reference NaN": (lambda f: batch(f, references=[1.0, NAN, 1.0, 1.0]), "references"),
        "batch_filter: silent": (lambda f: batch(f, Hs=[ROW, ROW, 0 * ROW, ROW], Rs=[1.0, 1.0, 0.0, 1.0]), "silent"),
        **{
            f"batch_filter: {name} end early": (
                lambda f, given={name: [one] * 3}: batch(f, **given),
                f"{name} must have",
            )
            for name, one in short.items()
        },
        "rts_smoother: x NaN": (lambda f: smooth(f, Xs=np.full((3, TAPS, 1), NAN)), "Xs must be finite"),
        "rts_smoother: x masked": (lambda f: smooth(f, Xs=np.ma.masked_all((3, TAPS, 1))), "Xs must be finite"),
        "rts_smoother: P of another length": (lambda f: smooth(f, Ps=[np.eye(TAPS)] * 2), "Xs must be .* and Ps"),
        "rts_smoother: one F for all": (lambda f: smooth(f, Fs=np.eye(TAPS)), r"Fs must have shape \(3, 5, 5\)"),
        "rts_smoother: Q of another length": (lambda f: smooth(f, Qs=[np.eye(TAPS)] * 4), "Qs must have shape"),
        "rts_smoother: fading memory": (lambda f: changed(f, "alpha", 1.1, lambda: smooth(f)), "alpha must be 1"),
        "rts_smoother: u missing": (moved, "us= is missing: control inputs moved this filter"),
        "rts_smoother: B missing": (lambda f: moved(f, us=[0.0, None, 1.0]), "Bs= is missing: control inputs moved"),
        "rts_smoother: u of another length": (lambda f: smooth(f, us=[0.0]), "us and Bs must have 3 values"),
        "rts_smoother: B of another size": (
            lambda f: smooth(f, us=[1.0] * 3, Bs=[np.ones((2, 1))] * 3),
            "us and Bs must move 5 states, but those of step 2 move 2",
        ),
        "rts_smoother: u NaN": (lambda f: smooth(f, us=[NAN] * 3, Bs=[np.ones((TAPS, 1))] * 3), "u must be finite"),
        "alpha NaN": (lambda f: setattr(f, "alpha", NAN), "alpha"),
        "alpha whose square overflows": (lambda f: setattr(f, "alpha", 1e200), "alpha"),
        "alpha below 1": (lambda f: setattr(f, "alpha", 0.5), "alpha"),
        "constraint_factor negative": (lambda f: setattr(f, "constraint_factor", -0.5), "constraint_factor"),
        "rated_power negative": (lambda f: setattr(f, "rated_power", -1.0), "rated_power"),
    }


def faults_of_random_walk_assignments() -> dict[str, Fault]:
    bad: dict[str, dict[str, Any]] = {
        "F": {"NaN": NAN * np.eye(TAPS), "of another size": np.eye(2)},
        "Q": {"negative": -1.0, "-I": -np.eye(TAPS), "of another size": np.eye(2)},
        "R": {"negative": -1.0, "[[Inf]]": [[INF]], "of another size": np.eye(2)},
        "P": {"NaN": NAN * np.eye(TAPS), "of another size": np.eye(2)},
        "x": {"NaN": np.full(TAPS, NAN), "of another size": np.ones((2, 1))},
    }
    for name in "FQRPx":
        array = np.ones((1, 1)) if name == "R" else np.eye(TAPS, 1 if name == "x" else TAPS)
        bad[name] |= {
            "masked": np.ma.array(array, mask=array != 0),
            "complex": 1j * array,
            "dates": array.astype("datetime64[s]"),
            "text": array.astype(str),
            "objects": np.full(array.shape, "1", dtype=object),
        }
    return {
        f"{name} {what}": (lambda f, name=name, value=value: setattr(f, name, value), rf"\b{name} (must|would)")
        for name, values in bad.items()
        for what, value in values.items()
    }


FAULTS = faults_of_updates() | faults_of_other_steps()
CASES = [(kind, name) for kind in ("general", "random walk") for name in FAULTS]
CASES += [("random walk", name) for name in faults_of_random_walk_assignments()]


@pytest.mark.parametrize("rated_power", [None, 0.5])
@pytest.mark.parametrize(("kind", "name"), CASES)
def test_a_fault_changes_nothing(kind: str, name: str, rated_power: float | None) -> None:
    fault, match = (FAULTS | faults_of_random_walk_assignments())[name]
    kf = make(kind, rated_power)
    twin = copy.deepcopy(kf)
    with pytest.raises((ValueError, TypeError), match=match):
        fault(kf)
    require_same_course(kf, twin)


@pytest.mark.parametrize("rated_power", [None, 0.5])
@pytest.mark.parametrize("kind", ["general", "random walk"])
@pytest.mark.parametrize("name", ["x", "P", "H"])
def test_a_poison_written_into_an_attribute_is_found_and_can_be_taken_out(
    kind: str, name: str, rated_power: float | None
) -> None:
    kf = make(kind, rated_power)
    twin = copy.deepcopy(kf)
    good = getattr(kf, name)[0, 0]
    getattr(kf, name)[0, 0] = NAN
    with pytest.raises(ValueError, match=rf"NaN.* {name},|{name} must be finite|{name} .*finite|{name} would hold NaN"):
        kf.update(1.0, reference=1.0)
    getattr(kf, name)[0, 0] = good
    require_same_course(kf, twin)


@pytest.mark.parametrize("kind", ["general", "random walk"])
def test_an_interrupted_step_changes_nothing(kind: str) -> None:
    """Whatever breaks off a step of filterpy's own equations, an inverse of the user's among them."""
    kf = make(kind)
    twin = copy.deepcopy(kf)

    def interrupted(_: np.ndarray) -> np.ndarray:
        raise KeyboardInterrupt

    kf.inv = interrupted
    for step in (lambda: kf.update_correlated(1.0), lambda: kf.update(1.0), lambda: kf.batch_filter([None, 1.0])):
        with pytest.raises(KeyboardInterrupt):
            step()
    kf.inv = np.linalg.inv
    require_same_course(kf, twin)


# P: what is no covariance is refused at the next step.


def rotated(*eigenvalues: float) -> np.ndarray:
    """A matrix with these eigenvalues and a positive diagonal."""
    n = len(eigenvalues)
    rotation = np.linalg.qr(np.random.default_rng(3).normal(size=(n, n)))[0]
    return rotation @ np.diag(eigenvalues) @ rotation.T


INDEFINITE = np.eye(TAPS)
INDEFINITE[0, 1] = INDEFINITE[1, 0] = 2.0
NOT_COVARIANCES: dict[str, Any] = {
    "a negative number": -2.0,
    "indefinite": INDEFINITE,
    "indefinite and tiny": 1e-200 * INDEFINITE,
    "indefinite and huge": 1e300 * INDEFINITE,
    "a negative list": (-np.eye(TAPS)).tolist(),
}
COVARIANCES: dict[str, Any] = {
    "singular to rounding": rotated(1.0, 0.3, 0.2, 0.1, -1e-15),
    "of very different sizes": np.diag([1e12, 1.0, 1e-12, 1.0, 1.0]),
    "a number": 3.0,
    "tiny": 1e-300 * np.eye(TAPS),
    "huge": 1e200 * np.eye(TAPS),  # the squares overflow
}
STEPS: dict[str, Callable[[KFOPC], Any]] = {
    "predict": lambda f: f.predict(),
    "update": lambda f: f.update(1.0),
    "update_correlated": lambda f: f.update_correlated(1.0),
    "predict_steadystate": lambda f: f.predict_steadystate(),
    "batch_filter": lambda f: f.batch_filter([1.0, 2.0]),
}


@pytest.mark.parametrize("kind", ["general", "random walk"])
@pytest.mark.parametrize("name", NOT_COVARIANCES)
@pytest.mark.parametrize("step", STEPS)
def test_a_P_that_is_no_covariance_is_refused_at_the_next_step(kind: str, name: str, step: str) -> None:
    kf = make(kind)
    twin, good = copy.deepcopy(kf), kf.P
    kf.P = NOT_COVARIANCES[name]
    with pytest.raises(ValueError, match=r"P must be positive semidefinite"):
        STEPS[step](kf)
    assert np.diagonal(kf.P * np.eye(TAPS))[-1] == np.diagonal(NOT_COVARIANCES[name] * np.eye(TAPS))[-1], "as assigned"
    kf.P = good
    require_same_course(kf, twin)


def test_the_random_walk_refuses_a_P_that_is_not_symmetric() -> None:
    kf = make("random walk")
    kf.P[0, 1] += 1e-3
    with pytest.raises(ValueError, match=r"P must be symmetric, but \[0, 1\] holds"):
        kf.predict()


@pytest.mark.parametrize("name", COVARIANCES)
def test_any_covariance_is_accepted(name: str) -> None:
    """As filterpy's filter uses it, bit for bit."""
    filters = [KalmanFilter(TAPS, 1), KFOPC(TAPS), KFOPC.random_walk(TAPS, state_noise=1.0, measurement_noise=1.0)]
    for kf in filters:
        kf.P = COVARIANCES[name]
        kf.predict()
        kf.update(1.0, H=ROW.reshape(1, -1))
    np.testing.assert_array_equal(filters[0].P, filters[1].P)
    np.testing.assert_allclose(filters[2].x, filters[0].x, rtol=1e-9)


# Attributes that a user saves and puts back.


@pytest.mark.parametrize(("kind", "rated_power"), [("general", 0.5), ("random walk", None), ("random walk", 0.5)])
def test_a_shallow_copy_of_the_attributes_is_refused_and_a_deep_one_is_the_filter(kind: str, rated_power: Any) -> None:
    """Steps write into the powers and into a random walk's P, which a shallow copy shares with the filter."""
    kf = make(kind, rated_power)
    twin = copy.deepcopy(kf)
    shallow, deep = dict(vars(kf)), copy.deepcopy(vars(kf))
    vars(kf).update(shallow)  # nothing was written since
    require_same_course(kf, twin)
    vars(kf).update(shallow)
    with pytest.raises(ValueError, match=r"those of an earlier step.*put back copy\.deepcopy\(kf\.__dict__\)"):
        kf.update(1.0, H=ROW, reference=1.0)
    vars(kf).clear()
    vars(kf).update(deep)
    again = make(kind, rated_power)
    require_same_course(kf, again)


def test_a_general_filter_without_a_rated_power_goes_on_from_a_shallow_copy() -> None:
    kf, twin = make("general"), make("general")
    shallow = dict(vars(kf))
    run(kf, 3)
    vars(kf).update(shallow)
    require_same_course(kf, twin)


# Arguments of other kinds.


@pytest.mark.parametrize("name", ["state_noise", "measurement_noise", "initial_variance"])
def test_variances_are_numbers_of_at_least_zero(name: str) -> None:
    for bad in (-1.0, [1.0, 2.0], None, "quiet", NAN):
        with pytest.raises((ValueError, TypeError), match=name):
            KFOPC.random_walk(4, **{"state_noise": 1.0, "measurement_noise": 1.0} | {name: bad})


def test_F_and_H_may_be_nested_lists() -> None:
    """filterpy fails at its `F.T` and `H.T`; with arrays it is the oracle."""
    F, H, B = [[1, 0.5], [0, 1]], [[1, 0]], np.array([[1.0], [0.0]])
    kf, attributes, arguments = KalmanFilter(2, 1), KFOPC(2), KFOPC(2)
    kf.F, kf.H = np.array(F), np.array(H)
    attributes.F, attributes.H = F, H
    for z in (1.0, 2.0, None, 4.0):
        for f in (kf, attributes):
            f.predict(u=1.0, B=B)
            f.update(z)
        arguments.predict(u=1.0, B=B, F=F)
        arguments.update(z, H=H)
        for f in (attributes, arguments):
            np.testing.assert_array_equal(f.x, kf.x)
            np.testing.assert_array_equal(f.P, kf.P)


@pytest.mark.parametrize("bad", ["4", 4.0, None, [4], np.float64(4.0)])
@pytest.mark.parametrize("name", ["dim_x", "dim_z"])
def test_dimensions_are_whole_numbers(name: str, bad: Any) -> None:
    with pytest.raises(TypeError, match=f"{name} must be a whole number, got "):
        KFOPC(**{"dim_x": 4, "dim_z": 1} | {name: bad})
    assert KFOPC(**{"dim_x": 4, "dim_z": 1} | {name: np.int64(2)}).x.any() == 0


def test_a_rated_power_needs_all_measurements() -> None:
    """The power of the disturbance cannot be taken from some of the microphones."""
    kf, twin = (KFOPC(4, 2, rated_power=1.0, fs=FS) for _ in range(2))
    H = np.ones((2, 4))
    with pytest.raises(ValueError, match="a rated power needs all measurements at once: mask them all"):
        kf.update(np.ma.array([1.0, 2.0], mask=[False, True]), H=H, reference=1.0)
    kf.update(np.ma.masked_all(2), H=H, reference=1.0)
    twin.update(None)
    for f in (kf, twin):
        f.update([1.0, 2.0], H=H, reference=1.0)
    np.testing.assert_array_equal(kf.x, twin.x)
    assert kf.disturbance_power == twin.disturbance_power


@pytest.mark.parametrize(
    ("z", "match"),
    [
        (np.ma.array([1.0, 2.0], mask=[False, True]), r"z must have 3 value\(s\), with the masked ones"),
        (np.ma.array([np.nan, 2.0, 0.0], mask=[False, False, True]), "z must be finite"),
    ],
)
def test_what_is_wrong_beside_a_gap_is_refused(z: np.ma.MaskedArray, match: str) -> None:
    kf = KFOPC(4, 3)
    kf.H = np.eye(3, 4)
    x = kf.x
    with pytest.raises(ValueError, match=match):
        kf.update(z)
    assert kf.x is x


@pytest.mark.skipif("update_sequential" not in UPDATES, reason="filterpy 1.4.5 has no update_sequential")
def test_update_sequential_stays_within_the_measurements() -> None:
    kf = KFOPC(3, 2)
    kf.H = np.eye(2, 3)
    for start, z in ((-1, 1.0), (2, 1.0), (1, [1.0, 2.0])):
        with pytest.raises(ValueError, match=r"z_i must stay within the dim_z = 2 measurements, got [12] from start"):
            kf.update_sequential(start, z, R_i=1.0, H_i=np.ones((np.size(z), 3)))


@pytest.mark.skipif("update_sequential" in UPDATES, reason="filterpy 2.0.0 has update_sequential")
def test_update_sequential_needs_filterpy_2() -> None:
    with pytest.raises(AttributeError, match=r"2\.0\.0"):
        KFOPC(2).update_sequential(0, 1.0)
