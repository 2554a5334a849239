"""What must hold of the loop for any signal, its pieces, and filterpy's own filters in it."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.signal
from helpers.comparing import SIGNALS, assert_same_run
from helpers.controllers import ALL, MAKERS
from helpers.loop import FS, MEMORY_S, MU, N_TAPS, S_HAT, Q, R, S, noises, run
from helpers.simulation import Stepwise
from hypothesis import given, settings
from hypothesis import strategies as st

from kfopc_filterpy import HardClipAmplifier, OutputPowerConstraint, Plant, kf_opc, mov_fx_lms, simulate
from kfopc_filterpy.loop.simulation import STRETCH


@pytest.mark.parametrize(("own", "name"), [("filterpy's filter", "KF-ANC"), ("KFOPC", "KF-OPC")])
def test_any_filterpy_filter_runs_in_the_loop(own, name):
    """filterpy's own KalmanFilter and a KFOPC with filterpy's equations leave what the core's filter leaves."""
    generic, fast = run(ALL[own]()), run(MAKERS[name]())
    assert generic.algorithm == name
    for signal in SIGNALS:
        want = getattr(fast, signal)
        # filterpy's Joseph form of P and ours differ by rounding, 1e-12 of P after 500 steps at P0/R = 50
        np.testing.assert_allclose(getattr(generic, signal), want, rtol=0, atol=1e-10 * np.nanmax(np.abs(want)))


# ---- One definition of the equations, two ways to run them


@pytest.mark.parametrize("name", ["KF-OPC", "MOV"])
def test_pieces_of_the_compiled_loop_do_not_show(name):
    """Progress comes after each; the steps have none."""
    n, done = 2 * STRETCH + 7, []
    whole = run(MAKERS[name](), n=n, progress=done.append)
    assert done == [STRETCH, STRETCH, 7]
    assert_same_run(whole, run(Stepwise(MAKERS[name]()), n=n))


# ---- What must hold for any signal


def test_feedback_of_one_sample_is_a_recursion():
    """y(n) = x(n) + 0.5 y(n - 1), of a controller that passes its reference."""
    through = SimpleNamespace(name="through", control_signal=lambda x: x, update=lambda e: None)
    x, d, _ = noises(200, 0)
    result = simulate(through, x, Plant([1.0], feedback=[0.0, 0.5], fs=FS), disturbance=d)
    np.testing.assert_allclose(result.control_signal, scipy.signal.lfilter([1.0], [1.0, -0.5], x), rtol=0, atol=1e-13)


@given(exponent=st.integers(-20, 20), seed=st.integers(0, 1000))
@settings(max_examples=25)
@pytest.mark.parametrize("name", ["KF-OPC", "MOV"])
def test_scaled_noise_and_rated_power_scale_the_control(name, exponent, seed):
    """x, d by c, rated power, q, and 1/mu by c^2: the weights stay and y, e, y_amp grow by c (exactly: c = 2^k)."""
    x, d, _ = noises(200, seed)

    def at_scale(c):
        constraint = OutputPowerConstraint(0.3 * c**2, fs=FS, memory_s=MEMORY_S)
        if name == "KF-OPC":
            made = kf_opc(N_TAPS, S_HAT, constraint=constraint, state_noise=R, measurement_noise=Q * c**2)
        else:
            made = mov_fx_lms(N_TAPS, S_HAT, step_size=MU / c**2, constraint=constraint)
        plant = Plant(S, amplifier=HardClipAmplifier(0.7 * c), fs=FS, sensor_noise_std=0.05 * c)
        return simulate(made, c * x, plant, disturbance=c * d, rng=5, record_weights_every=10)

    one, scaled = at_scale(1.0), at_scale(2.0**exponent)
    for signal, factor in (("control_signal", 2.0**exponent), ("error", 2.0**exponent), ("weights", 1.0)):
        np.testing.assert_array_equal(getattr(scaled, signal), factor * getattr(one, signal))
    np.testing.assert_array_equal(scaled.constraint_factor, one.constraint_factor)


@given(seed=st.integers(0, 1000), rated_power=st.floats(1e4, 1e8))
@settings(max_examples=25)
def test_with_rated_power_to_spare_the_constrained_are_the_unconstrained(seed, rated_power):
    x, d, _ = noises(200, seed)
    plant = Plant(S, fs=FS)
    for names in (("KF-OPC", "KF-ANC"), ("MOV", "FxLMS")):
        made, other_made = (MAKERS[name]() for name in names)
        made.rated_power = rated_power
        one, other = (simulate(each, x, plant, disturbance=d) for each in (made, other_made))
        np.testing.assert_array_equal(one.constraint_factor, 1.0)
        np.testing.assert_array_equal(one.control_signal, other.control_signal)
        np.testing.assert_array_equal(one.error, other.error)
