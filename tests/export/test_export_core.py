"""Controllers of the core exported as C: the bits of Python, in float64."""

from __future__ import annotations

import shutil
import subprocess
from copy import deepcopy
from functools import cache

import numpy as np
import pytest
from helpers.c99 import STRICT, CoreProgram, c_compiler, compiler, succeeds
from helpers.channels import random_paths, through

from kfopc_filterpy import (
    ClippingFxLMS,
    DiagonalKalman,
    FastArrayKalman,
    FxLMS,
    FxNLMS,
    HardClipAmplifier,
    LeakyFxLMS,
    MOVFxLMS,
    OptimalLeakyFxLMS,
    OutputLimiter,
    OutputPowerConstraint,
    RescalingFxLMS,
    SoftSaturationAmplifier,
    TwoGradientFxLMS,
    simulate,
)
from kfopc_filterpy.controllers import MonitoredController
from kfopc_filterpy.core.building import FOLDER
from kfopc_filterpy.export import export_c
from kfopc_filterpy.export.core import SHARED, joined

L, RATED, WINDOW = 24, 0.5, 800
TRAINING, SAMPLES = 9_000, 20_000
S_HAT = np.array([0.0, 0.85, -0.35, 0.25, 0.1])
S = np.array([0.0, 0.9, -0.4, 0.2, 0.1, 0.05])
S_TWO = random_paths(2, 2, 6, seed=1)
S_TWO_HAT = S_TWO[..., :5] + 0.02 * random_paths(2, 2, 5, seed=2)
P_TWO = random_paths(2, 2, 30, seed=3, delay=8)

ALGORITHMS = {
    "FxLMS": (FxLMS, {"step_size": 2e-4}),
    "FxNLMS": (FxNLMS, {"step_size": 0.005}),
    "leaky": (LeakyFxLMS, {"step_size": 2e-4, "leak": 0.3}),
    "optimal leaky": (OptimalLeakyFxLMS, {"step_size": 2e-4, "rated_power": RATED}),
    "MOV": (MOVFxLMS, {"step_size": 2e-4, "rated_power": RATED}),
    "MOV modified": (MOVFxLMS, {"step_size": 2e-4, "rated_power": RATED, "modified": True}),
    "MOV fixed": (MOVFxLMS, {"step_size": 2e-4, "rated_power": RATED, "penalty_factor": 0.3}),
    "two-gradient": (TwoGradientFxLMS, {"step_size": 2e-4, "amplitude_limit": 0.8, "output_step_size": 1e-4}),
    "clipping": (ClippingFxLMS, {"step_size": 2e-4, "amplitude_limit": 0.8}),
    "rescaling": (RescalingFxLMS, {"step_size": 2e-4, "amplitude_limit": 0.8}),
    "diagonal KF": (DiagonalKalman, {"state_noise": 1e-7, "measurement_noise": 1e-2}),
    "diagonal KF-OPC": (DiagonalKalman, {"state_noise": 1e-7, "measurement_noise": 1e-2, "rated_power": RATED}),
}
ONE_CHANNEL = {
    "fast array": (FastArrayKalman, {"measurement_noise": 1.0, "rated_power": RATED}),
    "finite memory": (FastArrayKalman, {"measurement_noise": 1.0, "memory": 500}),
}
LIMITED = ["FxLMS", "leaky", "MOV", "clipping"]


def limiter(window=WINDOW, rated_power=RATED):
    return OutputLimiter(rated_power, window_s=window / 16000)


def constraint(rated_power=RATED):
    return OutputPowerConstraint(rated_power, window="sliding", memory_s=0.01)


def plain(name):
    kind, settings = (ALGORITHMS | ONE_CHANNEL)[name]
    return kind(L, S_HAT, **settings)


def everything(name, channels):
    """Return a controller with all that it takes."""
    kind, settings = ALGORITHMS[name]
    settings = dict(settings)
    two = channels == 2
    if settings.pop("rated_power", None):
        settings["constraint"] = [constraint(), constraint(0.3)] if two else constraint()
        hard, soft = HardClipAmplifier(1.2), SoftSaturationAmplifier(1.5, sharpness=1.7)
        settings["amplifier"] = [hard, soft] if two else soft
    for each in ("leak", "amplitude_limit", "penalty_factor"):
        if two and each in settings:
            settings[each] = [settings[each], 1.5 * settings[each]]
    limiters = [limiter(), limiter(rated_power=0.3)] if two else limiter()
    made = kind(L, S_TWO_HAT if two else S_HAT, n_references=channels, limiter=limiters, **settings)
    made.secondary_path_uncertainty = 0.2
    return made


CONTROLLERS = (
    {name: lambda name=name: plain(name) for name in ALGORITHMS | ONE_CHANNEL}
    | {f"{name}, everything": lambda name=name: everything(name, 1) for name in ALGORITHMS}
    | {f"{name}, 2x2x2": lambda name=name: everything(name, 2) for name in ALGORITHMS}
    | {
        f"{name}, limited": lambda name=name: ALGORITHMS[name][0](L, S_HAT, limiter=limiter(), **ALGORITHMS[name][1])
        for name in LIMITED
    }
)


@cache
def noises():
    """References, a tone in noise that gets louder, and disturbances, with two channels each."""
    rng = np.random.default_rng(1)
    n = TRAINING + SAMPLES
    t = np.arange(n)
    x = np.where(t % 7000 < 5000, 1.0, 2.5) * (0.5 * rng.standard_normal((2, n)) + np.sin(0.2 * t))
    return x, through(P_TWO, x) + 0.05 * rng.standard_normal((2, n))


def ran(controller, part):
    x, d = (signal[:, part] for signal in noises())
    path = S_TWO
    if not controller.multichannel:
        x, d, path = x[0], d[0], S
    result = simulate(controller, x, disturbance=d, secondary_path=path)
    assert result.diverged_at_s is None
    return result


@cache
def trained_and_run(name):
    """Return a controller as it was after training, and its run from there on."""
    controller = CONTROLLERS[name]()
    ran(controller, slice(TRAINING))
    trained = deepcopy(controller)
    return trained, ran(controller, slice(TRAINING, None))


@pytest.mark.parametrize("name", CONTROLLERS)
def test_float64_gives_the_bits_of_python(name, tmp_path):
    trained, result = trained_and_run(name)
    out = CoreProgram(trained, tmp_path).run(result.reference, result.error)
    np.testing.assert_array_equal(out.y, np.atleast_2d(result.control_signal))
    assert np.abs(out.y).max() > 0.1
    assert out.self_tests == [0, 0]
    assert not out.status.any()


@pytest.mark.parametrize("name", [name for name in CONTROLLERS if name != "finite memory"])
def test_float32_follows_python(name, tmp_path):
    """But for the finite memory, whose arrays are lost sooner and then restarted."""
    trained, result = trained_and_run(name)
    program = CoreProgram(trained, tmp_path, "float32")
    out = program.run(result.reference, result.error)
    scale = np.sqrt(np.mean(result.control_signal**2))
    difference = np.abs(out.y - result.control_signal) / scale
    print(f"{name}: largest {difference.max():.1e}, rms {np.sqrt(np.mean(difference**2)):.1e}")
    assert np.sqrt(np.mean(difference**2)) <= (1e-3 if trained.limiter is None else 1e-2)
    assert trained.limiter is not None or difference.max() <= 1e-2
    assert out.self_tests == [0, 0]
    assert not out.status.any()
    assert out.n_bytes == program.exported.n_bytes


@pytest.mark.parametrize("options", [("-DLANES_OF_ONE=1",), ("-O0",), ("-march=native",)], ids="".join)
def test_the_bits_do_not_depend_on_the_processor(options, tmp_path):
    trained, result = trained_and_run("MOV, 2x2x2")
    out = CoreProgram(trained, tmp_path, options=options).run(result.reference, result.error)
    np.testing.assert_array_equal(out.y, result.control_signal)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_the_stated_size_is_that_of_the_state(dtype, tmp_path):
    for name in ("FxLMS", "MOV, 2x2x2"):
        program = CoreProgram(CONTROLLERS[name](), tmp_path, dtype)
        assert program.run(*np.zeros((2, CONTROLLERS[name]().n_references, 1))).n_bytes == program.exported.n_bytes
        block = CONTROLLERS[name]()._opened()
        assert dtype == "float32" or f"block[{block.memory.size // 8}]" in program.exported.header_path.read_text()


def test_the_self_test_finds_a_difference(tmp_path):
    trained, _ = trained_and_run("FxLMS")
    program = CoreProgram(trained, tmp_path)
    source = program.exported.path.read_text()
    at = source.index("expected[COMPARED]")
    digit = source.index(".", at) + 12  # one digit of the first output
    program.exported.path.write_text(source[:digit] + str(9 - int(source[digit])) + source[digit + 1 :])
    main = tmp_path / "main.c"
    main.write_text(
        '#include "anc.h"\nstatic anc_state s;\nint main(void) { return anc_self_test(&s) == 1 ? 0 : 1; }\n'
    )
    succeeds(c_compiler(), *STRICT, "-I", tmp_path, main, program.exported.path, "-lm", "-o", tmp_path / "main")
    succeeds(tmp_path / "main")


@pytest.mark.parametrize("name", ["FxLMS, limited", "MOV, 2x2x2"])
def test_an_export_between_the_two_calls_of_a_sample_continues_with_the_update(name, tmp_path):
    controller = CONTROLLERS[name]()
    x, e = (signal[: controller.n_references, :100] for signal in noises())
    calls = (lambda a: a) if controller.multichannel else (lambda a: a[0])
    for n in range(50):
        controller.control_signal(calls(x[:, n]))
        controller.update(calls(e[:, n]))
    controller.control_signal(calls(x[:, 50]))
    kind = "const double e[]" if controller.multichannel else "const double e"
    values = ", ".join(repr(float(value)) for value in e[:, 50])
    exported = export_c(controller, tmp_path / "anc.c")
    main = tmp_path / "main.c"
    count = controller.n_loudspeakers
    signal = "anc_control_signal(&s, x, y)" if controller.multichannel else "y[0] = anc_control_signal(&s, x[0])"
    references = ", ".join(repr(float(value)) for value in x[:, 51])
    main.write_text(
        f'#include "anc.h"\n#include <stdio.h>\nstatic anc_state s;\nint main(void) {{ {kind} = {{{values}}};\n'
        f"const double x[] = {{{references}}}; double y[{count}]; anc_init(&s); anc_update(&s, e); {signal};\n"
        f'for (int j = 0; j < {count}; j++) printf("%.17g\\n", y[j]);\nreturn 0; }}\n'
    )
    succeeds(c_compiler(), *STRICT, "-I", tmp_path, main, exported.path, "-lm", "-o", tmp_path / "main")
    done = subprocess.run([str(tmp_path / "main")], capture_output=True, text=True, check=True)
    controller.update(calls(e[:, 50]))
    np.testing.assert_array_equal(
        np.array(done.stdout.split(), float), np.ravel(controller.control_signal(calls(x[:, 51])))
    )


@pytest.mark.parametrize("name", ["FxLMS, limited", "MOV, 2x2x2"])
def test_an_export_changes_nothing_in_the_controller(name, tmp_path):
    controller, untouched = CONTROLLERS[name](), CONTROLLERS[name]()
    for one in (controller, untouched):
        ran(one, slice(200))
    first = export_c(controller, tmp_path / "first.c", name="anc")
    second = export_c(controller, tmp_path / "second.c", name="anc")
    assert first.path.read_text().replace("first.h", "second.h") == second.path.read_text()
    results = [ran(one, slice(200, 400)).control_signal for one in (controller, untouched)]
    np.testing.assert_array_equal(*results)


# The limiter in float32: more margin for rounding, and the guarantee holds.


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_no_window_of_the_c_limiters_output_exceeds_the_rated_power(dtype, tmp_path):
    trained, _ = trained_and_run("FxLMS, limited")
    rng = np.random.default_rng(5)
    out = CoreProgram(trained, tmp_path, dtype).run(*(3.0 * rng.standard_normal((2, 200_000))))
    energy = np.cumsum(np.concatenate([np.zeros(1), out.y[0]]).astype(np.longdouble) ** 2)
    windows = (energy[WINDOW:] - energy[:-WINDOW]) / WINDOW
    assert windows.max() <= RATED
    assert np.mean(windows) > 0.5 * RATED  # it is the limit that acts


def test_what_float32_cannot_hold_is_refused(tmp_path):
    long = FxLMS(2, [1.0], step_size=0.1, limiter=limiter(100_000))
    with pytest.raises(ValueError, match=r"window of 100000 samples is too long for float32.*at most"):
        export_c(long, tmp_path / "anc.c", dtype="float32")
    with pytest.raises(ValueError, match="path must be finite in float32"):
        export_c(FxLMS(2, [1e39], step_size=0.1), tmp_path / "anc.c", dtype="float32")
    assert list(tmp_path.iterdir()) == []
    assert export_c(long, tmp_path / "anc.c").n_bytes > 3 * 8 * 100_000


# Bad input.


@pytest.mark.parametrize(("dtype", "large"), [("float64", 1e200), ("float32", 1e30)])
@pytest.mark.parametrize("name", ["FxLMS", "MOV, everything", "FxLMS, 2x2x2"])
def test_a_bad_error_is_refused_and_a_bad_reference_counts_as_zero(name, dtype, large, tmp_path):
    """Python's controller, which is told nothing of the bad errors and zero for the bad references, goes on alike."""
    controller = CONTROLLERS[name]()
    x, e = (signal[: controller.n_references, :900].copy() for signal in noises())
    e[-1, [300, 301, 450, 550, 650]] = [np.nan, np.inf, -np.inf, large, np.nan]
    x[-1, [400, 401, 500, 600, 650]] = [np.nan, np.inf, -np.inf, large, np.nan]
    out = CoreProgram(controller, tmp_path, dtype).run(x, e)
    calls = (lambda a: a) if controller.multichannel else (lambda a: a[0])
    expected, refused = np.empty((controller.n_loudspeakers, 900)), np.zeros(900, int)
    for n in range(900):
        bad_reference, bad_error = not abs(x[-1, n]) < large, not abs(e[-1, n]) < large
        expected[:, n] = controller.control_signal(calls(0.0 * x[:, 0] if bad_reference else x[:, n]))
        if bad_reference or bad_error:
            refused[n] = 1 if bad_reference else 2
        else:
            controller.update(calls(e[:, n]))
    assert np.count_nonzero(refused) == 9
    np.testing.assert_array_equal(out.status, refused)
    np.testing.assert_allclose(out.y, expected, rtol=0, atol=0 if dtype == "float64" else 2e-2)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_a_controller_that_diverges_stays_finite_and_says_so(dtype, tmp_path):
    rng = np.random.default_rng(1)
    x, sign = rng.standard_normal((2, 20_000))
    e = sign * np.logspace(0, 30 if dtype == "float32" else 200, x.size)
    out = CoreProgram(FxLMS(L, S_HAT, step_size=1.0), tmp_path, dtype).run(x, e)
    assert np.isfinite(out.y).all()
    assert np.abs(out.y).max() > 1e5
    assert {0, 2} < set(out.status)


@pytest.mark.parametrize(
    "name",
    [
        *("FxLMS", "MOV, everything", "rescaling, 2x2x2", "two-gradient, 2x2x2", "diagonal KF-OPC, 2x2x2"),
        *("fast array", "finite memory"),
    ],
)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_sanitizers_find_nothing(name, dtype, tmp_path):
    options = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    probe = tmp_path / "probe.c"
    probe.write_text("int main(void) { return 0; }\n")
    built = subprocess.run([c_compiler(), *options, str(probe), "-o", str(tmp_path / "probe")], capture_output=True)
    if built.returncode != 0 or subprocess.run([str(tmp_path / "probe")], capture_output=True).returncode != 0:
        pytest.skip("the compiler has no address and undefined-behaviour sanitizers")
    trained, result = trained_and_run(name)
    x, e = (np.atleast_2d(signal[..., :5000]).copy() for signal in (result.reference, result.error))
    x[0, 1000], x[0, 2000], e[0, 3000], e[0, 3100] = np.nan, np.inf, np.nan, -np.inf
    out = CoreProgram(trained, tmp_path, dtype, options).run(x, e)
    np.testing.assert_array_equal(np.flatnonzero(out.status), [1000, 2000, 3000, 3100])


# The files.


def test_the_core_stands_in_the_source_as_it_is(tmp_path):
    text = export_c(plain("FxLMS"), tmp_path / "anc.c").path.read_text()
    for name in ("anc.h", "vectors.h", "signals.h", *SHARED, "lms.c"):
        for line in (FOLDER / name).read_text(encoding="utf-8").splitlines():
            if not line.startswith(("#include", "extern ANC_PUBLIC", "    anc_clipping,")):
                assert line in text


def test_only_the_calls_are_visible_and_only_the_mathematics_library_is_needed(tmp_path):
    if shutil.which("nm") is None:
        pytest.skip("needs nm, which lists a file's symbols")
    for name in ("MOV, everything", "rescaling, 2x2x2", "diagonal KF", "finite memory"):
        path = export_c(CONTROLLERS[name](), tmp_path / "anc.c").path
        succeeds(c_compiler(), *STRICT, "-c", path, "-o", tmp_path / "anc.o")
        symbols = subprocess.run(["nm", str(tmp_path / "anc.o")], capture_output=True, text=True, check=True).stdout
        needed = {line.split()[-1] for line in symbols.splitlines() if " U " in line}
        assert needed <= {"sqrt", "memcpy", "memmove", "memset", "strcmp"}
        public = {line.split()[-1] for line in symbols.splitlines() if line.split()[-2] in "TDBRC"}
        assert public == {"anc_init", "anc_control_signal", "anc_update", "anc_self_test"}


def test_two_controllers_of_other_names_link_into_one_program(tmp_path):
    export_c(CONTROLLERS["FxLMS, limited"](), tmp_path / "left.c")
    export_c(CONTROLLERS["MOV, 2x2x2"](), tmp_path / "other.c", name="right_2", dtype="float32")
    main = tmp_path / "main.c"
    main.write_text(
        '#include "left.h"\n#include "other.h"\nstatic left_state a;\nstatic right_2_state b;\n'
        "int main(void) { return left_self_test(&a) || right_2_self_test(&b) || LEFT_ADAPTED || LEFT_TAPS != RIGHT_2_TAPS; }\n"
    )
    sources = (main, tmp_path / "left.c", tmp_path / "other.c")
    succeeds(c_compiler(), *STRICT, "-I", tmp_path, *sources, "-lm", "-o", tmp_path / "main")
    succeeds(tmp_path / "main")


@pytest.mark.parametrize("name", ["FxLMS", "MOV, 2x2x2"])
def test_the_header_can_be_included_from_cpp(name, tmp_path):
    export_c(CONTROLLERS[name](), tmp_path / "anc.c")
    main = tmp_path / "main.cpp"
    main.write_text('#include "anc.h"\nint main() { static anc_state s; return anc_self_test(&s); }\n')
    succeeds(c_compiler(), *STRICT, "-c", tmp_path / "anc.c", "-o", tmp_path / "anc.o")
    options = ("-Wall", "-Wextra", "-Wpedantic", "-Werror", "-I", tmp_path)
    succeeds(compiler("c++", "g++"), *options, main, tmp_path / "anc.o", "-lm", "-o", tmp_path / "main")
    succeeds(tmp_path / "main")


def test_fast_math_is_refused_by_the_file_itself(tmp_path):
    path = export_c(plain("FxLMS"), tmp_path / "anc.c").path
    command = [c_compiler(), "-std=c99", "-ffast-math", "-c", str(path), "-o", str(tmp_path / "anc.o")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode != 0
    assert "compile it without -ffast-math" in done.stderr


def test_the_header_and_the_repr_state_the_size(tmp_path):
    exported = export_c(plain("FxLMS"), tmp_path / "anc.c", dtype="float32")
    assert f"{exported.n_bytes:,} bytes" in exported.header_path.read_text()
    assert f"state of {exported.n_bytes:,} bytes>" in repr(exported)
    assert exported.operations is exported.most_operations is None


def test_a_name_cannot_end_the_comment_that_it_stands_in(tmp_path):
    controller = plain("FxLMS")
    controller.name = "mine */ int broken;"
    CoreProgram(controller, tmp_path)


def test_every_file_of_the_core_joins(tmp_path):
    """No two files have the same name for two things."""
    for path in FOLDER.glob("*.c"):
        if path.name in SHARED or "const anc_algorithm" not in path.read_text(encoding="utf-8"):
            continue
        source = tmp_path / path.name
        text = joined([*SHARED[:-1], path.name, SHARED[-1]])
        source.write_text(f"#define ANC_PUBLIC static\n{text}\nint used;\n")
        succeeds(c_compiler(), "-std=c99", "-Wno-unused", "-c", source, "-o", tmp_path / "joined.o")


# What is refused.


class Own(FxLMS):
    """An FxLMS with calls of its own."""

    def update(self, error):
        super().update(0.5 * error)


@pytest.mark.parametrize("make", [lambda: Own(4, S_HAT, step_size=0.1), lambda: MonitoredController(plain("FxLMS"))])
def test_calls_in_python_are_not_exported(make, tmp_path):
    with pytest.raises(TypeError, match=r"Own|MonitoredController.*cannot be exported"):
        export_c(make(), tmp_path / "anc.c")
    assert list(tmp_path.iterdir()) == []
