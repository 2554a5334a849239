"""The loop against the plain-Python one of `oracles.modified_anc`, and its compiled form against its steps."""

import numpy as np
import pytest
from helpers.comparing import SIGNALS, assert_same_run
from helpers.loop import AMPLIFIERS, FEEDBACK, FS, MEMORY_S, MU, N_TAPS, P0, S_HAT, Q, R, S, noises, run, sensor_noise
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import modified_anc as oracle

from kfopc_filterpy import (
    KFOPC,
    FxLMS,
    HardClipAmplifier,
    KalmanController,
    MOVFxLMS,
    OutputPowerConstraint,
    kf_anc,
    kf_opc,
    simulate,
)
from kfopc_filterpy.loop.simulation import STRETCH


def controller(name, *, rated_power=0.3, n_taps=N_TAPS):
    kalman = {"state_noise": R, "measurement_noise": Q, "initial_variance": P0}
    constraint = OutputPowerConstraint(rated_power, fs=FS, memory_s=MEMORY_S)
    if name == "KF-ANC":
        return kf_anc(n_taps, S_HAT, **kalman)
    if name == "KF-OPC":
        return kf_opc(n_taps, S_HAT, constraint=constraint, **kalman)
    if name == "FxLMS":
        return FxLMS(n_taps, S_HAT, step_size=MU)
    return MOVFxLMS(n_taps, S_HAT, step_size=MU, constraint=constraint)


def reference_algorithm(name):
    if name in ("KF-ANC", "FxLMS"):  # they only follow the powers, as eq. 10-11 with the defaults
        factor = oracle.Factor(None)
    else:
        factor = oracle.Factor(0.3, None, MEMORY_S, FS, "exponential")
    if name in ("KF-ANC", "KF-OPC"):
        return oracle.Kalman(N_TAPS, factor, r=R, q=Q, p0=P0)
    return oracle.LMS(N_TAPS, factor, mu=MU)


NAMES = ("KF-ANC", "KF-OPC", "FxLMS", "MOV-FxLMS")


def assert_agrees(result, expected):
    # Rounding of 500 steps in another order of summation. The loops contract, and where clipping makes weights grow
    # they do so linearly; errors are some 1e-14 of the largest value, the Kalman covariance's some 1e-12.
    for name in SIGNALS:
        want, got = expected[name], getattr(result, name)
        assert got.shape == want.shape, name
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-10 * np.nanmax(np.abs(want)), err_msg=name)


@pytest.mark.parametrize(
    ("amplifier", "feedback"), [("none", None), ("hard", FEEDBACK), ("soft", FEEDBACK)], ids=["", "hard", "soft"]
)
@pytest.mark.parametrize("name", NAMES)
def test_every_controller_is_the_papers_loop(name, amplifier, feedback):
    x, d, _ = noises()
    ours, theirs = AMPLIFIERS[amplifier]
    expected = oracle.modified_anc(
        reference_algorithm(name),
        x,
        d,
        S,
        S_HAT,
        noise=sensor_noise(),
        amplifier=theirs,
        feedback=(0.0,) if feedback is None else feedback,
    )
    result = run(controller(name), amplifier=ours, feedback=feedback)
    assert_agrees(result, expected)
    assert result.algorithm == name
    assert (np.min(expected["constraint_factor"]) < 0.9) == (name in ("KF-OPC", "MOV-FxLMS"))  # it did act
    if amplifier in ("hard", "soft"):
        assert np.max(np.abs(expected["control_signal"])) > 0.7  # the amplifier did act


@pytest.mark.parametrize(("own", "rated_power"), [("filterpy", None), ("KFOPC", None), ("KFOPC", 0.3)])
def test_any_filterpy_filter_runs_in_the_loop(own, rated_power):
    """filterpy's own KalmanFilter and a KFOPC with filterpy's equations leave what the O(L^2) one leaves."""
    name = "KF-ANC" if rated_power is None else "KF-OPC"
    if own == "KFOPC":
        constraint = OutputPowerConstraint(rated_power, fs=FS, memory_s=MEMORY_S) if rated_power else None
        estimator = KFOPC(dim_x=N_TAPS, dim_z=1, constraint=constraint)
    else:
        estimator = oracle.KalmanFilter(dim_x=N_TAPS, dim_z=1)
    estimator.Q, estimator.R, estimator.P = R * np.eye(N_TAPS), np.array([[Q]]), P0 * np.eye(N_TAPS)
    generic, fast = run(KalmanController(estimator, S_HAT)), run(controller(name))
    assert generic.algorithm == name
    for signal in SIGNALS:
        want = getattr(fast, signal)
        # filterpy's Joseph form of P and ours differ by rounding, 1e-12 of P after 500 steps at P0/R = 50
        np.testing.assert_allclose(getattr(generic, signal), want, rtol=0, atol=1e-10 * np.nanmax(np.abs(want)))


# ---- One definition of the equations, two ways to run them


@pytest.mark.parametrize("name", ["KF-OPC", "MOV-FxLMS"])
def test_pieces_of_the_compiled_loop_do_not_show(name):
    """Progress comes after each; the steps have none."""
    n, done = 2 * STRETCH + 7, []
    whole = run(controller(name), n=n, progress=done.append)
    assert done == [STRETCH, STRETCH, 7]
    assert_same_run(whole, run(controller(name), n=n, compiled=False))


# ---- What must hold for any signal


@given(exponent=st.integers(-20, 20), seed=st.integers(0, 1000))
@settings(max_examples=25)
@pytest.mark.parametrize("name", ["KF-OPC", "MOV-FxLMS"])
def test_scaled_noise_and_rated_power_scale_the_control(name, exponent, seed):
    """x, d by c, rated power, q, and 1/mu by c^2: the weights stay and y, e, y_amp grow by c (exactly: c = 2^k)."""
    c = 2.0**exponent
    x, d, _ = noises(200, seed)

    def at_scale(c):
        constraint = OutputPowerConstraint(0.3 * c**2, fs=FS, memory_s=MEMORY_S)
        if name == "KF-OPC":
            made = kf_opc(N_TAPS, S_HAT, constraint=constraint, state_noise=R, measurement_noise=Q * c**2)
        else:
            made = MOVFxLMS(N_TAPS, S_HAT, step_size=MU / c**2, constraint=constraint)
        return simulate(
            made,
            c * x,
            disturbance=c * d,
            secondary_path=S,
            fs=FS,
            amplifier=HardClipAmplifier(0.7 * c),
            sensor_noise_std=0.05 * c,
            rng=5,
            record_weights_every=10,
        )

    one, scaled = at_scale(1.0), at_scale(c)
    np.testing.assert_array_equal(scaled.control_signal, c * one.control_signal)
    np.testing.assert_array_equal(scaled.error, c * one.error)
    np.testing.assert_array_equal(scaled.weights, one.weights)
    np.testing.assert_array_equal(scaled.constraint_factor, one.constraint_factor)


@given(seed=st.integers(0, 1000), rated_power=st.floats(1e4, 1e8))
@settings(max_examples=25)
def test_with_rated_power_to_spare_the_constrained_are_the_unconstrained(seed, rated_power):
    x, d, _ = noises(200, seed)
    for constrained, free in (("KF-OPC", "KF-ANC"), ("MOV-FxLMS", "FxLMS")):
        one, other = (
            simulate(controller(name, rated_power=rated_power), x, disturbance=d, secondary_path=S, fs=FS)
            for name in (constrained, free)
        )
        np.testing.assert_array_equal(one.constraint_factor, 1.0)
        np.testing.assert_array_equal(one.control_signal, other.control_signal)
        np.testing.assert_array_equal(one.error, other.error)
