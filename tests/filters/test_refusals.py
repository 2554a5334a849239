"""What would corrupt a filter is refused with a clear error: nothing has changed, and it goes on as one that never saw it."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from kfopc_filterpy import KFOPC

TAPS, FS = 5, 16000
ROW, EYE = np.linspace(1.0, 2.0, TAPS), np.eye(TAPS)
STATE = ("x", "P", "x_prior", "P_prior", "x_post", "P_post", "K", "S", "SI", "y", "F", "Q", "R", "H", "M", "alpha")
POWERS = ("rated_power", "constraint_factor", "disturbance_power", "secondary_path_gain")
KINDS = [(kind, power) for kind in ("general", "random walk") for power in (None, 0.5)]


def make(kind: str, rated_power: float | None = None) -> KFOPC:
    """A filter after some steps."""
    settings: Any = {"rated_power": rated_power, "fs": FS}
    if kind == "random walk":
        kf: KFOPC = KFOPC.random_walk(TAPS, state_noise=1e-4, measurement_noise=0.3, **settings)
    else:
        kf = KFOPC(TAPS, **settings)
        kf.Q, kf.R = 1e-4 * EYE, np.array([[0.3]])
    kf.H, kf.M = ROW.reshape(1, TAPS), np.zeros((TAPS, 1))
    run(kf, 8)
    return kf


def run(kf: KFOPC, steps: int) -> None:
    rng = np.random.default_rng(steps)
    for _ in range(steps):
        kf.predict()
        kf.update(rng.normal(), H=rng.normal(size=(1, TAPS)), reference=rng.normal())


def require_same_course(kf: KFOPC, twin: KFOPC) -> None:
    """Both are in the same state, and stay so."""
    for steps in (0, 4):
        run(kf, steps), run(twin, steps)
        for name in (*STATE, *POWERS):
            np.testing.assert_array_equal(getattr(kf, name), getattr(twin, name), err_msg=name)


def batch(f: KFOPC, **changed: Any) -> None:
    f.batch_filter(**{"zs": [1.0, 2.0, 3.0, 4.0], "Hs": [ROW] * 4, "references": [1.0, 1.0, 0.5, 2.0]} | changed)


def smooth(f: KFOPC, **changed: Any) -> None:
    f.rts_smoother(**{"Xs": np.ones((3, TAPS, 1)), "Ps": [EYE] * 3} | changed)


# ---- Lines of code and what their last statement says; what stands before it is done with the twin, too.

FITS_NOT = r"R must have shape \(2, 2\), as H has rows, got .* for dim_z = 1|needs one measurement, got 2"
UPDATES = {
    'f.update("loud")': "z must be a number or an array of numbers, or None",
    "f.update(nan)": r"z must be finite.*If a value is missing, mask it",
    "f.update([1.0, 2.0])": r"z must have 1 value\(s\)",
    "f.update(ones((1, 1, 1)))": "z must have .* got shape",
    "f.update(1.0 + 2.0j)": "z must be real, got complex",
    "f.update(1.0, reference=nan)": "reference must be finite",
    "f.update(1.0, reference=[1.0, 2.0])": "reference must be a single number",
    "f.update(1.0, H=np.where(ROW > 1.5, nan, ROW), reference=1.0)": "H must be finite",
    "f.update(1.0, H=ones(6), reference=1.0)": r"H must have shape \(5,\) or \(dim_z, 5\), got \(6,\)",
    "f.update(1.0, H=2.0, reference=1.0)": "H must have shape",
    "f.update([1.0, 2.0, 3.0], H=ones((2, 5)))": r"z must have 2 value\(s\)",
    "f.update(1.0, R=nan, reference=1.0)": "R must be finite",
    "f.update(1.0, R=-1.0, reference=1.0)": "R must not be negative",
    "f.update(1.0, R=np.eye(2), reference=1.0)": "R must (have shape|be a single number)",
    **{f"f.update([1.0, 2.0], R={R}, H=ones((2, 5)), reference=1.0)": FITS_NOT for R in ("2.0", "None", "[[3.0]]")},
    "f.update(1.0, R=0.0, H=0 * ROW, reference=1.0)": "a silent reference",
    "f.update(1.0, H=1e160 * ROW, reference=1.0)": "overflow|finite square",
    "f.update(1.0, R=1e-310, H=1e-160 * ROW, reference=1.0)": "overflow",
    "f.update(1e308, R=1e-12, H=1e-3 * ROW, reference=1.0)": "overflow|finite square",
    "f.update_steadystate(nan)": "z must be finite",
    "f.update_steadystate(np.ma.masked)": "z must not be masked, except in update",
    "f.K = ones((1, 1)); f.update_steadystate(1.0)": r"K must have shape \(5, 1\)",
    "f.update_correlated(nan)": "z must be finite",
    "f.update_correlated(1.0, H=0 * ROW, R=0.0, reference=1.0)": "a silent reference",
    "f.M = ones((1, 1)); f.update_correlated(1.0)": r"M must have shape \(5, 1\)",
}
SEQUENTIAL = {
    "f.update_sequential(0, nan)": "z must be finite",
    "f.update_sequential(0, 1.0, H_i=nan * ROW)": "H_i must be finite",
    "f.update_sequential(0, 1.0, R_i=nan)": "R_i must be finite",
    "f.update_sequential(0, 1.0, H_i=0 * ROW, R_i=0.0)": "a silent reference",
    "f.update_sequential(0, 1e308, R_i=1e-12, H_i=1e-3 * ROW, reference=1.0)": "NaN, Inf|finite square",
    "f.update_sequential(-1, 1.0)": "z_i must stay within the dim_z = 1 measurements, got 1 from start = -1 on",
    "f.update_sequential(0, [1.0, 2.0])": "z_i must stay within the dim_z = 1 measurements, got 2 from start = 0 on",
}
OTHER_STEPS = {
    "f.predict(F=nan * EYE)": "F must be (finite|the identity)",
    "f.predict(F=np.eye(6))": r"F must (have shape|be the identity)",
    "f.predict(F=[[1.0], [1.0, 0.0]])": "F must be .*differ in length",
    "f.predict(F=1e200 * EYE)": "overflow|F must be the identity",
    "f.predict(Q=-1.0)": "Q must not be negative",
    "f.predict(Q=np.eye(2))": "Q must have shape",
    "f.predict(Q=np.diag([1.0, 1, -1, 1, 1]))": "Q must not be negative",
    "f.batch_filter([None] * 2, Qs=[1.5e308] * 2)": "step 1 of the batch: .*overflow",
    "f.predict(u=nan, B=ones((5, 1)))": "u must be finite",
    "f.predict(u=1.0, B=np.ma.masked_all((5, 1)))": "B must be finite",
    "f.predict(u=ones((1, 1)), B=ones((6, 1)))": r"predict: .*\(shapes: .*'B': \(6, 1\)",
    "f.predict(u=ones((1, 3)), B=ones((5, 1)))": "x would become",
    "f.predict_steadystate(u=nan, B=ones((5, 1)))": "u must be finite",
    "f.predict_steadystate(u=ones((2, 1)), B=ones((5, 1)))": r"predict_steadystate: .*\(shapes: .*'u': \(2, 1\)",
    "f.get_prediction(u=ones((1, 3)), B=ones((5, 1)))": "x would become",
    "f.residual_of(np.ma.array([7.0], mask=[True]))": "z must not be masked",
    "f.residual_of([1.0, 2.0])": r"z must have 1 value\(s\)",
    "f.log_likelihood_of([1.0, 2.0])": r"z must have 1 value\(s\)",
    "batch(f, zs=[1.0, 2.0, nan, 4.0])": "step 2 of the batch: z must be finite",
    "batch(f, zs=[[1.0], [2.0], [3.0, 1.0], [4.0]])": r"step 2 of the batch: z must have 1 value\(s\)",
    "batch(f, references=[1.0, nan, 1.0, 1.0])": "references must be finite",
    "batch(f, references=[1.0, 1.0, 1.0])": r"references must have 4 values, got shape \(3,\)",
    "batch(f, Hs=[ROW, ROW, 0 * ROW, ROW], Rs=[1.0, 1.0, 0.0, 1.0])": "step 2 of the batch: .*a silent reference",
    **{f"batch(f, {name}=[{one}] * 3)": rf"{name} must have one value for each of the 4 of zs, got 3"
       for name, one in {"Fs": "EYE", "Qs": 0.1, "Hs": "ROW", "Rs": 0.1, "us": 0.0, "Bs": "ROW"}.items()},
    "smooth(f, Xs=np.full((3, 5, 1), nan))": "Xs must be finite",
    "smooth(f, Ps=[EYE] * 2)": "Xs must be .* and Ps",
    "smooth(f, Fs=EYE)": r"Fs must have shape \(3, 5, 5\)",
    "smooth(f, Qs=[EYE] * 4)": "Qs must have shape",
    "f.alpha = 1.1; smooth(f)": "alpha must be 1, got 1.1",
    "f.predict(u=1.0, B=EYE[:, :1]); f.predict(); smooth(f)": "control inputs moved this filter",
    'f.H = [["a"]]': "H must be a sequence of real numbers",
    "f.alpha = nan": "alpha must be finite",
    "f.alpha = 1e200": "the square of alpha must be finite",
    "f.alpha = 0.5": "alpha",
    "f.constraint_factor = -0.5": "constraint_factor (must not be negative|needs a constraint)",
    "f.constraint_factor = 1.5": "constraint_factor (must be 1 at most .*got 1.5|needs a constraint)",
    "f.constraint_factor = 1 + 1e-10": r"constraint_factor (must be 1 at most .*got 1\.0000000001:|needs a constraint)",
    "f.rated_power = -1.0": "rated_power must be greater than 0",
    "f.rated_power = [1.0, 2.0]": "rated_power must be a single number",
    'f.constraint = "tight"': "constraint must be an OutputPowerConstraint or None, got 'tight'; kf_opc takes several",
}  # fmt: skip
OF_WALKS = {
    "f.F = np.eye(2)": "F must have shape",
    "f.Q = -EYE": "Q must not be negative",
    "f.Q = np.eye(2)": "Q must have shape",
    "f.R = -1.0": "R must not be negative",
    "f.R = np.eye(2)": "R must have shape",
    "f.P = np.eye(2)": "P must have shape",
    "f.x = np.full(5, nan)": "x must be finite",
    "f.x = ones((2, 1))": r"x would become \(2, 1\), for 5 states",
}
KINDS_OF_ARRAYS = ["np.ma.array({0}, mask={0} != 0)", "1j * {0}", "{0}.astype('datetime64[s]')", "{0}.astype(str)"]
KINDS_OF_ARRAYS += ["{0}.astype(str).astype(object)"]
OF_WALKS |= {
    f"f.{name} = {kind.format(array)}": rf"\b{name} must"
    for name, array in {"F": "EYE", "Q": "EYE", "R": "ones((1, 1))", "P": "EYE", "x": "ones((5, 1))"}.items()
    for kind in KINDS_OF_ARRAYS
}
BOTH = UPDATES | OTHER_STEPS | (SEQUENTIAL if hasattr(KalmanFilter, "update_sequential") else {})  # 1.4.5 has none
CASES = [(*kind, code, says) for kind in KINDS for code, says in BOTH.items()]
CASES += [(*kind, code, says) for kind in KINDS[2:] for code, says in OF_WALKS.items()]


@pytest.mark.parametrize(("kind", "rated_power", "code", "says"), CASES)
def test_a_fault_changes_nothing(kind: str, rated_power: float | None, code: str, says: str) -> None:
    kf = make(kind, rated_power)
    twin = copy.deepcopy(kf)
    scope = globals() | {"nan": math.nan, "inf": math.inf, "ones": np.ones}
    *before, fault = code.split("; ")
    for statement in before:
        for f in (kf, twin):
            exec(statement, scope | {"f": f})
    with pytest.raises((ValueError, TypeError), match=says):
        exec(fault, scope | {"f": kf})
    require_same_course(kf, twin)


@pytest.mark.parametrize(("kind", "rated_power"), KINDS)
@pytest.mark.parametrize("name", ["x", "P", "H"])
def test_a_poison_written_into_an_attribute_is_found_and_can_be_taken_out(
    kind: str, name: str, rated_power: float | None
) -> None:
    kf = make(kind, rated_power)
    twin = copy.deepcopy(kf)
    good = getattr(kf, name)[0, 0]
    getattr(kf, name)[0, 0] = math.nan
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
STEPS = ["predict()", "update(1.0)", "update_correlated(1.0)", "predict_steadystate()", "batch_filter([1.0, 2.0])"]


@pytest.mark.parametrize("kind", ["general", "random walk"])
@pytest.mark.parametrize("name", NOT_COVARIANCES)
@pytest.mark.parametrize("step", STEPS)
def test_a_P_that_is_no_covariance_is_refused_at_the_next_step(kind: str, name: str, step: str) -> None:
    kf = make(kind)
    twin, good = copy.deepcopy(kf), kf.P
    kf.P = NOT_COVARIANCES[name]
    with pytest.raises(ValueError, match=r"P must be positive semidefinite"):
        eval(f"kf.{step}")
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


# Arguments of other kinds.


@pytest.mark.parametrize("name", ["state_noise", "measurement_noise", "initial_variance"])
def test_variances_are_numbers_of_at_least_zero(name: str) -> None:
    for bad in (-1.0, [1.0, 2.0], None, "quiet", math.nan):
        with pytest.raises((ValueError, TypeError), match=name):
            KFOPC.random_walk(4, **{"state_noise": 1.0, "measurement_noise": 1.0} | {name: bad})


@pytest.mark.parametrize("bad", ["4", 4.0, None, [4], np.float64(4.0)])
@pytest.mark.parametrize("name", ["dim_x", "dim_z"])
def test_dimensions_are_whole_numbers(name: str, bad: Any) -> None:
    with pytest.raises(TypeError, match=f"{name} must be a whole number, got "):
        KFOPC(**{"dim_x": 4, "dim_z": 1} | {name: bad})
    assert KFOPC(**{"dim_x": 4, "dim_z": 1} | {name: np.int64(2)}).x.any() == 0


def test_what_is_wrong_beside_a_gap_is_refused() -> None:
    kf = KFOPC(4, 3)
    x = kf.x
    for z, says in (
        ([1.0, 2.0], r"z must have 3 value\(s\), with the masked ones"),
        ([math.nan, 2.0, 0.0], "z must be finite"),
    ):
        with pytest.raises(ValueError, match=says):
            kf.update(np.ma.array(z, mask=np.arange(len(z)) == 1))
    assert kf.x is x


@pytest.mark.skipif(not hasattr(KalmanFilter, "update_sequential"), reason="filterpy 1.4.5 has no update_sequential")
def test_update_sequential_writes_into_no_array_that_is_held() -> None:
    """As filterpy does; then a step could not be undone."""
    kf = make("general")
    held = [getattr(kf, name) for name in ("x", "y", "K", "z")]
    before = copy.deepcopy(held)
    kf.update_sequential(0, 1.0)
    np.testing.assert_equal(held, before)


@pytest.mark.skipif(hasattr(KalmanFilter, "update_sequential"), reason="filterpy 2.0.0 has update_sequential")
def test_update_sequential_needs_filterpy_2() -> None:
    with pytest.raises(AttributeError, match=r"2\.0\.0"):
        KFOPC(2).update_sequential(0, 1.0)
