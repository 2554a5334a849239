"""Kalman controllers exported as C: compiled, and compared with Python sample by sample. Those of the core: `test_export_core`."""

from __future__ import annotations

import shutil
import subprocess
from collections import Counter
from copy import deepcopy
from functools import cache

import numpy as np
import pytest
from helpers.c99 import STRICT, Program, c_compiler, compiler, operations, succeeds
from scipy import signal

from kfopc_filterpy import (
    KFOPC,
    HardClipAmplifier,
    KalmanController,
    OutputLimiter,
    OutputPowerConstraint,
    fx_rls,
    kf_anc,
    kf_opc,
    kf_opc_repaired,
    kf_pb,
    simulate,
)
from kfopc_filterpy.controllers import MonitoredController
from kfopc_filterpy.export import export_c

L, RATED, WINDOW = 24, 0.5, 800
S = np.array([0.0, 0.9, -0.4, 0.2, 0.1, 0.05])
S_HAT = np.array([0.0, 0.85, -0.35, 0.25, 0.1])  # neither its taps nor its length are those of S
P = [0.0, 0.0, 0.0, 0.8, -0.5, 0.4, 0.3, -0.2, 0.1]
NOISES = {"state_noise": 1e-7, "measurement_noise": 1e-2}
TRAINING, MILLION = 20_000, 1_000_000
ADAPTED, BAD_INPUT, NO_SOLUTION, DIVERGED = range(4)


def limiter(window=WINDOW, rated_power=RATED):
    return OutputLimiter(rated_power, window_s=window / 16000)


def constraint(**settings):
    return OutputPowerConstraint(RATED, **settings)


def given_power():
    own = constraint()
    own.disturbance_power = 3.0
    return own


def fixed_factor():
    own = constraint()
    own.factor = 0.6
    return own


LONG = {  # compared over 10^6 samples
    "KF-ANC": lambda: kf_anc(L, S_HAT, **NOISES),
    "KF-OPC": lambda: kf_opc(L, S_HAT, rated_power=RATED, **NOISES),
    "KF-OPC limited": lambda: kf_opc(L, S_HAT, rated_power=RATED, limiter=limiter(), **NOISES),
    "KF-ANC limited": lambda: kf_anc(L, S_HAT, limiter=limiter(), **NOISES),
}
SHORT = {  # the other settings that have C code of their own
    "KF-ANC, one tap": lambda: kf_anc(1, [0.9], **NOISES),
    "KF-ANC, path longer than filter": lambda: kf_anc(3, S_HAT, **NOISES),
    "KF-OPC, gain given": lambda: kf_opc(L, S_HAT, constraint=constraint(secondary_path_gain=1.2), **NOISES),
    "KF-OPC, power given": lambda: kf_opc(L, S_HAT, constraint=given_power(), **NOISES),
    "KF-OPC, factor fixed": lambda: kf_opc(L, S_HAT, constraint=fixed_factor(), **NOISES),
    "KF-OPC, short memory": lambda: kf_opc(L, S_HAT, constraint=constraint(memory_s=0.001), **NOISES),
    "KF-OPC, twice the precision": lambda: kf_opc(
        L, S_HAT, rated_power=RATED, state_noise=1e-6, measurement_noise=1e-6, initial_variance=100.0
    ),
    "KF-OPC, peaks limited": lambda: kf_opc(
        L, S_HAT, rated_power=RATED, limiter=OutputLimiter(RATED, window_s=0.001, amplitude_limit=1.0), **NOISES
    ),
}


@cache
def noises(n):
    """Reference, a tone in coloured noise that gets louder every 8 s, and a disturbance that it explains in part."""
    rng = np.random.default_rng(1)
    t = np.arange(n) / 16000
    coloured = 0.5 * signal.lfilter([1.0, 0.6], [1.0, -0.5], rng.standard_normal(n))
    x = np.where(t % 8.0 < 5.0, 1.0, 2.5) * (coloured + np.sin(2 * np.pi * 500 * t))
    return x, np.convolve(x, P)[:n] + 0.05 * rng.standard_normal(n)


@cache
def trained_and_run(name, n):
    """Return a controller as it was after training, and its run of n samples from there on."""
    controller = (LONG | SHORT)[name]()
    x, d = noises(TRAINING + n)
    simulate(controller, x[:TRAINING], disturbance=d[:TRAINING], secondary_path=S)
    trained = deepcopy(controller)
    result = simulate(controller, x[TRAINING:], disturbance=d[TRAINING:], secondary_path=S)
    assert result.diverged_at_s is None
    return trained, result, controller.weights


# The result, sample by sample.
#
# float64: Python adds up an inner product in vector lanes, C in order, so they differ by rounding from the first sample
# on: 2e-16 of a value, which the adaptation neither keeps nor amplifies. Behind a limiter a clipped sample is the root of
# what is left of a window's energy, a difference near zero, so the error there is that of the root of N roundings,
# sqrt(800 * 2e-16) = 4e-7.
#
# float32: rounding is 6e-8, and the limiter keeps N + 16 roundings of the energy free, 816 * 1.2e-7 = 1e-4. A clipped
# sample therefore differs by up to sqrt(1e-4 * 800) = 0.3 of the rated amplitude, or more if the two clip different
# samples; few samples are clipped, so the difference is bounded in its mean square.

TOLERANCES = {  # (largest, root of mean square) difference of y over the root of its power, and of the weights
    ("float64", False): (1e-12, 1e-13, 1e-12),
    ("float64", True): (1e-6, 1e-9, 1e-10),
    ("float32", False): (1e-4, 1e-5, 1e-4),
    ("float32", True): (np.inf, 1e-2, 1e-3),
}


def assert_same(name, n, dtype, folder):
    trained, result, weights = trained_and_run(name, n)
    program = Program(trained, folder, dtype)
    out = program.run(result.reference, result.disturbance, S)
    largest, mean, of_weights = TOLERANCES[dtype, trained.limiter is not None]
    scale = np.sqrt(np.mean(result.control_signal**2))
    difference = np.abs(out.y - result.control_signal) / scale
    print(f"{name}, {dtype}: largest {difference.max():.1e}, rms {np.sqrt(np.mean(difference**2)):.1e}")
    assert difference.max() <= largest
    assert np.sqrt(np.mean(difference**2)) <= mean
    np.testing.assert_allclose(out.weights, weights, rtol=0, atol=of_weights * np.abs(weights).max())
    assert not out.status.any()
    assert out.n_bytes == program.exported.n_bytes  # sizeof of the compiled state, and what the export states


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("name", LONG)
def test_c_continues_a_trained_controller_for_a_million_samples_as_python_does(name, dtype, tmp_path):
    assert_same(name, MILLION, dtype, tmp_path)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("name", SHORT)
def test_c_continues_a_controller_of_other_settings_as_python_does(name, dtype, tmp_path):
    assert_same(name, 50_000, dtype, tmp_path)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_no_window_of_the_c_limiters_output_exceeds_the_rated_power(dtype, tmp_path):
    trained, result, _ = trained_and_run("KF-ANC limited", MILLION)
    out = Program(trained, tmp_path, dtype).run(result.reference, result.disturbance, S)
    squares = out.y[: MILLION // WINDOW * WINDOW].astype(np.longdouble) ** 2
    for shift in range(0, WINDOW, 100):
        windows = squares[shift : shift + (squares.size // WINDOW - 1) * WINDOW].reshape(-1, WINDOW)
        assert windows.mean(axis=1).max() <= RATED
    assert np.mean(squares) > 0.5 * RATED  # it is the limit that acts


def test_a_float32_filter_of_python_is_exported_with_its_covariance(tmp_path):
    controller = kf_opc(L, S_HAT, rated_power=RATED, dtype=np.float32, **NOISES)
    x, d = noises(TRAINING + 50_000)
    simulate(controller, x[:TRAINING], disturbance=d[:TRAINING], secondary_path=S)
    program = Program(controller, tmp_path)
    result = simulate(controller, x[TRAINING:], disturbance=d[TRAINING:], secondary_path=S)
    out = program.run(x[TRAINING:], d[TRAINING:], S)
    np.testing.assert_allclose(out.y, result.control_signal, atol=1e-4)  # only Python rounds P to float32


@pytest.mark.parametrize(
    ("dtype", "ratio", "tolerance"), [("float64", 1e6, 1e-9), ("float64", 1e9, 1e-6), ("float32", 1e6, 0.1)]
)
def test_a_large_initial_variance_cancels_no_digits_that_matter(dtype, ratio, tolerance, tmp_path):
    """The rounding of P(0|0) alone is 2e-16, or 6e-8, of 10^6 or 10^9 measurement noises."""
    made = kf_opc(L, S_HAT, rated_power=RATED, state_noise=0.0, measurement_noise=1e-3, initial_variance=1e-3 * ratio)
    x, d = noises(30_000)
    out = Program(made, tmp_path, dtype).run(x, d, S)
    expected = simulate(made, x, disturbance=d, secondary_path=S).control_signal
    np.testing.assert_allclose(out.y, expected, rtol=0, atol=tolerance)
    assert not out.status.any()


def test_a_variance_too_large_for_float32_is_reported_in_c(tmp_path):
    def make(**options):
        return kf_opc(
            L,
            S_HAT,
            rated_power=RATED,
            state_noise=0.0,
            measurement_noise=1e-3,
            initial_variance=1e6,
            **options,
        )

    x, d = noises(30_000)
    simulate(make(dtype=np.float32), x, disturbance=d, secondary_path=S)  # its least state noise keeps P positive
    out = Program(make(), tmp_path, "float32").run(x, d, S)
    assert np.count_nonzero(out.status == NO_SOLUTION) > 10_000
    assert np.isfinite(out.y).all()


# The state that it starts from.


def sample_by_sample(controller, x, e):
    """Return y of two calls per sample."""
    y = np.empty(x.size)
    for n in range(x.size):
        y[n] = controller.control_signal(x[n])
        controller.update(e[n])
    return y


@pytest.mark.parametrize("name", ["KF-OPC limited", "KF-ANC"])
def test_an_export_between_the_two_calls_of_a_sample_continues_with_the_update(name, tmp_path):
    controller = LONG[name]()
    x, e = noises(600)
    sample_by_sample(controller, x[:200], e[:200])
    controller.control_signal(x[200])
    exported = export_c(controller, tmp_path / "anc.c")
    main = tmp_path / "main.c"
    main.write_text(
        '#include "anc.h"\n#include <stdio.h>\nstatic anc_state s;\n'
        'int main(void) { double x, e; anc_init(&s); if (scanf("%lf", &e) != 1) return 1; anc_update(&s, e);\n'
        'while (scanf("%lf %lf", &x, &e) == 2) { printf("%.17g\\n", anc_control_signal(&s, x)); anc_update(&s, e); }\n'
        "return 0; }\n"
    )
    program = tmp_path / "main"
    succeeds(c_compiler(), *STRICT, "-I", tmp_path, main, exported.path, "-lm", "-o", program)
    stream = [repr(float(e[200]))] + [f"{float(a)!r} {float(b)!r}" for a, b in zip(x[201:], e[201:], strict=True)]
    done = subprocess.run([str(program)], input="\n".join(stream), capture_output=True, text=True, check=True)
    controller.update(e[200])
    expected = sample_by_sample(controller, x[201:], e[201:])
    np.testing.assert_allclose(np.array(done.stdout.split(), float), expected, rtol=1e-9, atol=1e-12)


def test_what_was_assigned_before_the_export_is_exported(tmp_path):
    controller = kf_opc(4, S_HAT, rated_power=RATED, **NOISES)
    x, e = noises(300)
    sample_by_sample(controller, x, e)
    controller.estimator.P *= 2.0
    controller.estimator.x[0] += 0.5
    controller.estimator.R = 0.3
    out = Program(controller, tmp_path).run(x, e)
    np.testing.assert_allclose(out.y, sample_by_sample(controller, x, e), rtol=1e-9)


@pytest.mark.parametrize("name", ["KF-OPC limited", "KF-ANC"])
def test_an_export_changes_nothing_in_the_controller(name, tmp_path):
    controller, untouched = LONG[name](), LONG[name]()
    x, e = noises(100)
    for one in (controller, untouched):
        sample_by_sample(one, x, e)
    first = export_c(controller, tmp_path / "first.c", name="anc")
    second = export_c(controller, tmp_path / "second.c", name="anc")
    assert first.path.read_text().replace("first.h", "second.h") == second.path.read_text()
    np.testing.assert_array_equal(controller.estimator.K, untouched.estimator.K)
    np.testing.assert_array_equal(controller.estimator.S, untouched.estimator.S)
    np.testing.assert_array_equal(sample_by_sample(controller, x, e), sample_by_sample(untouched, x, e))


# Bad input.


@pytest.mark.parametrize(("dtype", "large"), [("float64", 1e200), ("float32", 1e30)])
@pytest.mark.parametrize("name", LONG)
def test_a_bad_error_is_refused_and_a_bad_reference_counts_as_zero(name, dtype, large, tmp_path):
    """Python's controller, which is told nothing of the bad errors and zero for the bad references, goes on alike."""
    controller = LONG[name]()
    x, e = (one.copy() for one in noises(900))
    e[[300, 301, 450, 550, 650]] = [np.nan, np.inf, -np.inf, large, np.nan]
    x[[400, 401, 500, 600, 650]] = [np.nan, np.inf, -np.inf, large, np.nan]
    out = Program(controller, tmp_path, dtype).run(x, e)
    expected, refused = np.empty(x.size), np.zeros(x.size, int)
    for n in range(x.size):
        bad_reference, bad_error = not abs(x[n]) < large, not abs(e[n]) < large
        expected[n] = controller.control_signal(0.0 if bad_reference else x[n])
        if bad_reference or bad_error:
            refused[n] = BAD_INPUT
        else:
            controller.update(e[n])
    assert np.count_nonzero(refused) == 9
    np.testing.assert_array_equal(out.status, refused)
    np.testing.assert_allclose(out.y, expected, rtol=0, atol=1e-9 if dtype == "float64" else 2e-2)


@pytest.mark.parametrize(("dtype", "large"), [("float64", 1.2e154), ("float32", 1.2e19)])
def test_a_reference_that_overflows_in_the_path_is_refused_as_long_as_the_path_hears_it(dtype, large, tmp_path):
    x, e = (one.copy() for one in noises(400))
    e[:110] = 0.0  # the weights are still 0, or y would overflow too
    x[100] = large  # its square is finite, that of 3 times as much is not
    out = Program(kf_anc(4, [3.0, 3.0], **NOISES), tmp_path, dtype).run(x, e)
    np.testing.assert_array_equal(np.flatnonzero(out.status), [100, 101])
    assert np.abs(out.y[110:]).max() < 10.0


def test_an_update_without_a_solution_is_refused_and_changes_nothing(tmp_path):
    """With q = 0, a silent reference tells nothing."""
    controller = kf_anc(4, [1.0, 0.5], state_noise=1e-6, measurement_noise=0.0)
    x, e = (one.copy() for one in noises(300))
    x[100:120] = 0.0
    out = Program(controller, tmp_path).run(x, e)
    expected = np.empty(x.size)
    for n in range(x.size):
        expected[n] = controller.control_signal(x[n])
        if out.status[n] == ADAPTED:
            controller.update(e[n])
        else:
            assert out.status[n] == NO_SOLUTION
            with pytest.raises(ValueError, match="tells nothing"):
                deepcopy(controller).update(e[n])
    silent = np.arange(100 + 1 + 3, 120)  # x' has left the filter: one more tap of the path, then those of the filter
    np.testing.assert_array_equal(np.flatnonzero(out.status), silent)
    np.testing.assert_allclose(out.y, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def test_an_innovation_variance_that_overflows_is_refused(tmp_path):
    controller = kf_anc(2, [1.0], state_noise=0.0, measurement_noise=1.0, initial_variance=1e10)
    x, e = (one[:200].copy() for one in noises(300))
    x[100] = (
        1e150  # its square is finite, but not 10^10 times as much once the noise has corrected the weights a little
    )
    x[:100], e[:101] = 0.0, 0.0
    out = Program(controller, tmp_path).run(x, e)
    np.testing.assert_array_equal(np.flatnonzero(out.status == NO_SOLUTION), [100, 101])
    assert set(out.status) == {ADAPTED, NO_SOLUTION}
    expected = [controller.control_signal(x[n]) for n in range(102)]
    expected = np.append(expected, sample_by_sample(controller, x[102:], e[102:]))
    np.testing.assert_allclose(out.y, expected, rtol=0, atol=1e-8 * np.abs(expected).max())


def test_weights_that_would_overflow_are_refused(tmp_path):
    """The gain is about 1/h without measurement noise, so a tiny h and a large error overflow."""
    controller = kf_anc(1, [1.0], state_noise=0.0, measurement_noise=0.0)
    out = Program(controller, tmp_path).run(np.array([7e-155]), np.array([1.3e154]))
    np.testing.assert_array_equal(out.status, [NO_SOLUTION])
    np.testing.assert_array_equal(out.weights, [0.0])


def test_a_variance_too_large_for_twice_the_precision_is_updated_as_in_python(tmp_path):
    controller = kf_anc(1, [1.0], state_noise=1e91, measurement_noise=1.0, initial_variance=1e105)  # r beyond rounding
    x, e = noises(300)
    out = Program(controller, tmp_path).run(x, e)
    np.testing.assert_allclose(out.y, sample_by_sample(controller, x, e), rtol=1e-9)
    assert not out.status.any()


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_in_silence_the_last_gain_stays(dtype, tmp_path):
    """After 15 000 samples with a memory of 16, the running powers are zero, and their ratio has no digits long before."""
    controller = kf_opc(4, S_HAT, constraint=constraint(memory_s=0.001), state_noise=1e-6, measurement_noise=0.1)
    x, e = (one.copy() for one in noises(20_000))
    x[1000:16_000] = 0.0
    out = Program(controller, tmp_path, dtype).run(x, e)
    tolerance = 1e-9 if dtype == "float64" else 1e-2
    np.testing.assert_allclose(out.y, sample_by_sample(controller, x, e), rtol=0, atol=tolerance)
    assert not out.status.any()


@pytest.mark.parametrize("limited", [False, True])
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_a_control_signal_that_overflows_is_silent_and_its_update_is_refused(dtype, limited, tmp_path):
    large = 1e300 if dtype == "float64" else 1e34
    controller = kf_anc(2, [1.0], limiter=limiter() if limited else None, **NOISES)
    controller.estimator.x = np.array([[large], [0.0]])
    x = np.array([1e-3 / large, 1e9, 0.0])
    out = Program(controller, tmp_path, dtype).run(x, np.ones(3))
    np.testing.assert_array_equal(out.status, [ADAPTED, DIVERGED, ADAPTED])
    np.testing.assert_allclose(out.y, [1e-3, 0.0, 0.0], rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "dtype"),
    [(name, "float64") for name in [*LONG, "KF-OPC, twice the precision"]] + [("KF-OPC limited", "float32")],
)
def test_sanitizers_find_nothing(name, dtype, tmp_path):
    options = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    probe = tmp_path / "probe.c"
    probe.write_text("int main(void) { return 0; }\n")
    built = subprocess.run([c_compiler(), *options, str(probe), "-o", str(tmp_path / "probe")], capture_output=True)
    if built.returncode != 0 or subprocess.run([str(tmp_path / "probe")], capture_output=True).returncode != 0:
        pytest.skip("the compiler has no address and undefined-behaviour sanitizers")
    controller = (LONG | SHORT)[name]()
    x, e = (one.copy() for one in noises(5000))
    x[1000], x[2000], e[3000], e[3100] = np.nan, np.inf, np.nan, -np.inf
    out = Program(controller, tmp_path, dtype, options).run(x, e)
    np.testing.assert_array_equal(np.flatnonzero(out.status), [1000, 2000, 3000, 3100])


# What it costs.


@pytest.mark.parametrize("name", [*LONG, *SHORT])
def test_the_stated_operations_are_those_that_are_counted(name, tmp_path):
    x, e = noises(3000)
    exported, counted = operations((LONG | SHORT)[name](), tmp_path, x, e)
    rare = ("limited" in name) or "twice" in name
    assert counted.max() <= exported.most_operations
    if not rare:
        assert Counter(counted[10:]).most_common(1)[0][0] == exported.operations


def test_the_worst_samples_of_limiter_and_kalman_filter_are_counted(tmp_path):
    rng = np.random.default_rng(2)
    x, e = rng.standard_normal((2, 4000)) * np.where(np.arange(4000) % 500 < 20, 10.0, 1.0)  # bursts, which are clipped
    exported, counted = operations(kf_anc(8, S_HAT, limiter=limiter(50, 0.01), **NOISES), tmp_path, x, e)
    clipped, lap = 5, 2 * 49
    assert {exported.operations, exported.operations + clipped, exported.operations + lap} <= set(counted)
    alone = export_c(kf_anc(8, S_HAT, **NOISES), tmp_path / "alone.c")
    twice_the_precision = alone.most_operations - alone.operations
    assert exported.most_operations == exported.operations + clipped + lap + twice_the_precision
    exported, counted = operations(kf_anc(8, S_HAT, state_noise=1e-3, measurement_noise=1e-9), tmp_path, x, e)
    assert Counter(counted).most_common(1)[0][0] == exported.most_operations


def test_the_header_and_the_repr_state_the_cost(tmp_path):
    exported = export_c(kf_opc(L, S_HAT, rated_power=RATED, **NOISES), tmp_path / "anc.c", dtype="float32")
    cost = f"state of {exported.n_bytes:,} bytes, {exported.operations:,} operations per sample"
    assert cost in exported.header_path.read_text()
    assert cost in repr(exported)
    assert "KF-OPC: 24 taps, rated power 0.5" in exported.header_path.read_text()
    double = export_c(kf_opc(L, S_HAT, rated_power=RATED, **NOISES), tmp_path / "anc.c")
    assert exported.n_bytes < 0.6 * double.n_bytes


def test_the_object_file_needs_nothing_but_the_mathematics_library(tmp_path):
    if shutil.which("nm") is None:
        pytest.skip("needs nm, which lists a file's symbols")
    for name in ("KF-OPC limited", "KF-ANC"):
        path = export_c((LONG | SHORT)[name](), tmp_path / "anc.c").path
        succeeds(c_compiler(), *STRICT, "-c", path, "-o", tmp_path / "anc.o")
        symbols = subprocess.run(["nm", str(tmp_path / "anc.o")], capture_output=True, text=True, check=True).stdout
        needed = {line.split()[-1] for line in symbols.splitlines() if " U " in line}
        assert needed <= {"fma", "fmaf", "sqrt", "memcpy", "memset"}  # a compiler may copy and clear by calls
        public = {line.split()[-1] for line in symbols.splitlines() if " T " in line}
        assert public == {"anc_init", "anc_control_signal", "anc_update"}


# The files.


def test_two_controllers_of_other_names_link_into_one_program(tmp_path):
    x, e = noises(400)
    controllers = {"left": LONG["KF-OPC limited"](), "right_2": LONG["KF-ANC"]()}
    export_c(controllers["left"], tmp_path / "left.c")
    export_c(controllers["right_2"], tmp_path / "other.c", name="right_2", dtype="float32")
    main = tmp_path / "main.c"
    main.write_text(
        '#include "left.h"\n#include "other.h"\n#include <stdio.h>\nstatic left_state a;\nstatic right_2_state b;\n'
        "int main(void) { double x, e; left_init(&a); right_2_init(&b);\n"
        'while (scanf("%lf %lf", &x, &e) == 2) { printf("%.17g %.17g\\n", left_control_signal(&a, x),\n'
        "(double)right_2_control_signal(&b, (float)x)); left_update(&a, e); right_2_update(&b, (float)e); }\n"
        "return LEFT_TAPS == RIGHT_2_TAPS ? LEFT_ADAPTED : 1; }\n"
    )
    sources = (main, tmp_path / "left.c", tmp_path / "other.c")
    succeeds(c_compiler(), *STRICT, "-I", tmp_path, *sources, "-lm", "-o", tmp_path / "main")
    stream = "\n".join(f"{float(a)!r} {float(b)!r}" for a, b in zip(x, e, strict=True))
    done = subprocess.run([str(tmp_path / "main")], input=stream, capture_output=True, text=True, check=True)
    y = np.array(done.stdout.split(), float).reshape(-1, 2)
    np.testing.assert_allclose(y[:, 0], sample_by_sample(controllers["left"], x, e), rtol=0, atol=1e-9)
    np.testing.assert_allclose(y[:, 1], sample_by_sample(controllers["right_2"], x, e), rtol=0, atol=1e-3)


def test_the_header_can_be_included_from_cpp(tmp_path):
    export_c(LONG["KF-OPC"](), tmp_path / "anc.c")
    main = tmp_path / "main.cpp"
    main.write_text('#include "anc.h"\nint main() { static anc_state s; anc_init(&s); return anc_update(&s, 0.0); }\n')
    succeeds(c_compiler(), *STRICT, "-c", tmp_path / "anc.c", "-o", tmp_path / "anc.o")
    options = ("-Wall", "-Wextra", "-Wpedantic", "-Werror", "-I", tmp_path)
    succeeds(compiler("c++", "g++"), *options, main, tmp_path / "anc.o", "-lm", "-o", tmp_path / "main")
    succeeds(tmp_path / "main")


def test_fast_math_is_refused_by_the_file_itself(tmp_path):
    path = export_c(LONG["KF-OPC"](), tmp_path / "anc.c").path
    command = [c_compiler(), "-std=c99", "-ffast-math", "-c", str(path), "-o", str(tmp_path / "anc.o")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode != 0
    assert "removes the checks for NaN" in done.stderr


def test_a_name_cannot_end_the_comment_that_it_stands_in(tmp_path):
    controller = kf_anc(2, [1.0], **NOISES)
    controller.name = "mine */ int broken;"
    Program(controller, tmp_path)


# What is refused.


class Own(KalmanController):
    """A Kalman filter with calls of its own."""

    def update(self, error):
        super().update(0.5 * error)


def uncertain():
    controller = LONG["KF-OPC"]()
    controller.secondary_path_uncertainty = 0.2
    return controller


def fading():
    controller = LONG["KF-OPC"]()
    controller.estimator.alpha = 1.01
    return controller


def full_state_noise():
    controller = kf_anc(2, [1.0], **NOISES)
    controller.estimator.Q = np.diag([1.0, 2.0])
    return controller


NOT_EXPORTED = {
    "a number": (lambda: 3.0, TypeError, "float"),
    "FxRLS": (lambda: fx_rls(4, S_HAT, forgetting=0.999), ValueError, "fading memory"),
    "KF-PB": (lambda: kf_pb(4, S_HAT, rated_power=RATED, fs=16000, **NOISES), TypeError, "KF-PB"),
    "repaired": (lambda: kf_opc_repaired(4, S_HAT, rated_power=RATED, **NOISES), TypeError, "KF-OPC"),
    "several loudspeakers": (
        lambda: kf_opc(4, np.ones((1, 2, 3)), rated_power=RATED, **NOISES),
        ValueError,
        "several channels",
    ),
    "channel axes": (lambda: kf_anc(4, np.ones((1, 1, 3)), **NOISES), ValueError, "several channels"),
    "amplifier": (
        lambda: kf_opc(4, S_HAT, rated_power=RATED, amplifier=HardClipAmplifier(1.0), **NOISES),
        ValueError,
        "an amplifier model",
    ),
    "uncertain path": (uncertain, ValueError, "a secondary_path_uncertainty"),
    "sliding window": (
        lambda: kf_opc(4, S_HAT, constraint=constraint(window="sliding"), **NOISES),
        ValueError,
        "sliding window",
    ),
    "fading memory": (fading, ValueError, "a fading memory"),
    "full state noise": (full_state_noise, TypeError, "KF-ANC"),
    "monitor": (lambda: MonitoredController(LONG["KF-OPC"]()), TypeError, "MonitoredController"),
    "own calls": (lambda: Own(KFOPC.random_walk(4, **NOISES), S_HAT), TypeError, "Own"),
}


@pytest.mark.parametrize("case", NOT_EXPORTED)
def test_a_controller_without_c_code_is_refused_and_the_message_lists_those_that_have_it(case, tmp_path):
    make, error, reason = NOT_EXPORTED[case]
    with pytest.raises(error, match="kf_opc: one channel") as refusal:
        export_c(make(), tmp_path / "anc.c")
    assert reason in str(refusal.value)
    assert list(tmp_path.iterdir()) == []


BAD_ARGUMENTS = {
    "path": ({"path": "anc.txt"}, "must end in .c"),
    "stem": ({"path": "my anc.c"}, "C identifier"),
    "name": ({"name": "2nd"}, "C identifier"),
    "underscore": ({"name": "_anc"}, "C identifier"),
    "empty name": ({"name": ""}, "C identifier"),
    "dtype": ({"dtype": "float16"}, "float64 or numpy.float32"),
}


@pytest.mark.parametrize("case", BAD_ARGUMENTS)
def test_bad_arguments_are_refused_before_a_file_is_written(case, tmp_path):
    arguments, reason = BAD_ARGUMENTS[case]
    arguments = {"path": "anc.c"} | arguments
    with pytest.raises(ValueError, match=reason):
        export_c(LONG["KF-OPC"](), tmp_path / arguments.pop("path"), **arguments)
    assert list(tmp_path.iterdir()) == []


def test_what_float32_cannot_hold_is_refused(tmp_path):
    with pytest.raises(ValueError, match="covariance must be finite in float32"):
        export_c(kf_anc(2, [1.0], initial_variance=1e39, **NOISES), tmp_path / "anc.c", dtype="float32")
    long = kf_anc(2, [1.0], limiter=limiter(100_000), **NOISES)
    with pytest.raises(ValueError, match=r"window of 100000 samples is too long for float32.*at most"):
        export_c(long, tmp_path / "anc.c", dtype="float32")
    assert list(tmp_path.iterdir()) == []
    assert export_c(long, tmp_path / "anc.c").n_bytes > 3 * 8 * 100_000
