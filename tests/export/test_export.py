"""Controllers of the core exported as C: the bits of Python in float64, and close to it in float32."""

from __future__ import annotations

import re
import shutil
import subprocess
from copy import deepcopy
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from helpers.c99 import FAST, WARNINGS, Program
from helpers.channels import random_paths, through
from helpers.controllers import ALL, KALMAN, PATHS, SEVERAL, I, K, limiters
from helpers.core import c_compiler, tool
from helpers.core import ran as succeeds
from helpers.loop import FS, MU, S_HAT, S

from kfopc_filterpy import OutputLimiter, Plant, diagonal_kf, fx_lms, kf_anc, kf_opc, mov_fx_lms, simulate
from kfopc_filterpy.controllers import CoreController, with_internal_model
from kfopc_filterpy.core.building import core_sources
from kfopc_filterpy.export import Float32Controller, export_c

FOLDER = Path(__file__).parent
RATED, WINDOW = 0.05, 80  # of the limiters of one channel
TRAINING, SAMPLES = 3_000, 5_000
ONE, MANY = Plant(S, fs=FS), Plant(1.1 * PATHS, fs=FS)
PRIMARY = random_paths(K, I, 30, seed=3, delay=8)


def with_fixed_penalty():
    controller = mov_fx_lms(5, PATHS, step_size=MU, penalty_factor=[0.3, 0.1], n_references=I, limiter=limiters())
    controller.secondary_path_uncertainty = 0.2
    return controller


# Each algorithm with several channels and most of what it takes, and with one what they do not have.
NAMES = [f"{name} many" for name in SEVERAL] + ["hybrid, many", "guarded KF-ANC, many", "guarded FxLMS, many"]
NAMES += ["FxLMS plain", "FxLMS limiter", "MOV plain", "fxRLS plain", "KF-OPC plain", "KF-OPC limiter", "KF-PB plain"]
NAMES += ["KF-OPC, sliding plain", "KF-OPC known amplifier", "diagonal KF-OPC known amplifier"]
CONTROLLERS = {name: ALL[name] for name in NAMES} | {
    "MOV, fixed": with_fixed_penalty,
    "one tap": lambda: kf_opc(1, [0.9], rated_power=0.3, fs=FS, **KALMAN),
}


def limiter(window=WINDOW):
    return OutputLimiter(RATED, fs=FS, window_s=window / FS)


@cache
def noises(n=TRAINING + SAMPLES):
    """References, a tone in noise that gets louder, and disturbances, of several channels."""
    rng = np.random.default_rng(1)
    x = np.where(np.arange(n) % 7000 < 5000, 0.4, 1.0) * (
        0.5 * rng.standard_normal((I, n)) + np.sin(0.2 * np.arange(n))
    )
    return x, through(PRIMARY, x) + 0.05 * rng.standard_normal((K, n))


def ran(controller, part, n=TRAINING + SAMPLES, dtype="float64"):
    x, d = (signal[:, part] for signal in noises(n))
    x, d, plant = (x[: controller.n_references], d, MANY) if controller.multichannel else (x[0], d[0], ONE)
    result = simulate(controller if dtype == "float64" else Float32Controller(controller), x, plant, disturbance=d)
    assert result.diverged_at_s is None
    return result


@cache
def trained_and_run(name):
    """Return a controller as it was after training, and its run from there on."""
    controller = CONTROLLERS[name]()
    ran(controller, slice(TRAINING))
    trained = deepcopy(controller)
    return trained, ran(controller, slice(TRAINING, None))


def heard_by(controller, n):
    """Return references (I, n) and errors (K, n)."""
    counts = controller.n_references, controller.n_microphones
    return [signal[:count, :n].copy() for signal, count in zip(noises(), counts, strict=True)]


def sample(controller, signal):
    """Return a sample of all channels as a controller takes it."""
    return signal if controller.multichannel else signal[0]


def stepped(controller, x, e):
    """Return y (J, n) of the two calls per sample."""
    y = []
    for xn, en in zip(x.T, e.T, strict=True):
        y.append(np.atleast_1d(controller.control_signal(sample(controller, xn))))
        controller.update(sample(controller, en))
    return np.transpose(y)


# The result, sample by sample.


def test_every_algorithm_of_the_core_is_tested_here():
    defined = {
        name
        for path in core_sources()
        for name in re.findall(r"^const anc_algorithm anc_(\w+)", path.read_text(), re.M)
    }
    tested = {make().algorithm for make in CONTROLLERS.values()}
    assert tested == defined - {"signals_alone"}  # which has no exported controller


@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        *((name, "float64") for name in CONTROLLERS),
        *(
            pytest.param(name, "float32", marks=() if name.endswith("many") else pytest.mark.slow)
            for name in CONTROLLERS
        ),
    ],
)
def test_the_bits_are_those_of_python(name, dtype, tmp_path):
    trained, result = trained_and_run(name)
    if dtype == "float32":
        result = ran(trained, slice(TRAINING, None), dtype=dtype)
    program = Program(trained, tmp_path, dtype)
    out = program.run(result.reference, result.error)
    np.testing.assert_array_equal(out.y, np.atleast_2d(result.control_signal))
    assert np.abs(out.y).max() > 0.02
    assert out.self_tests == [0, 0]
    assert not out.status.any()
    assert out.n_bytes == program.exported.n_bytes


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("several", [False, True])
def test_a_feedback_controller_has_no_reference_argument(several, dtype, tmp_path):
    """The example runs the self-test first, which compares with the bits of Python."""
    path, n_references = (PATHS, K) if several else (S_HAT, 1)
    controller = with_internal_model(kf_opc(5, path, rated_power=0.3, fs=FS, n_references=n_references, **KALMAN))
    errors = 0.1 * noises()[1][:n_references, :200]
    controller.process(None, errors if several else errors[0])
    exported = export_c(controller, tmp_path / "out", dtype=dtype)
    number = "double" if dtype == "float64" else "float"
    declared = f"void anc_control_signal(anc_state *state, {number} control" if several else "(anc_state *state);"
    assert declared in exported.header_path.read_text()
    flags = re.search(r"(-std=c99 .*)", exported.header_path.read_text())[1].split()
    files = [tmp_path / "out" / file for file in ("main.c", "anc.c")]
    succeeds(*c_compiler(), *flags, *WARNINGS, *FAST, *files, "-lm", "-o", tmp_path / "main")
    succeeds(tmp_path / "main")


def test_in_a_long_run_of_float32_no_window_of_the_limiters_output_exceeds_the_rated_power(tmp_path):
    controller = CONTROLLERS["KF-OPC limiter"]()
    program = Program(controller, tmp_path, "float32", options=("-O1",))
    result = ran(controller, slice(None), 200_000)
    out = program.run(result.reference, result.error)
    energy = np.cumsum(np.concatenate([np.zeros(1), out.y[0]]).astype(np.longdouble) ** 2)
    windows = (energy[WINDOW:] - energy[:-WINDOW]) / WINDOW
    assert windows.max() <= RATED
    assert np.mean(windows) > 0.3 * RATED
    assert not out.status.any()


def test_the_self_test_finds_a_difference(tmp_path):
    program = Program(trained_and_run("KF-OPC plain")[0], tmp_path)
    source = program.exported.path.read_text()
    digit = source.index(".", source.index("expected[COMPARED]")) + 12  # one digit of the first output
    program.exported.path.write_text(source[:digit] + str(9 - int(source[digit])) + source[digit + 1 :])
    program.compile()
    assert program.run(np.zeros(1), np.zeros(1)).self_tests == [1, 1]


# The state that it starts from.


@pytest.mark.parametrize("name", ["FxLMS limiter", "kf_opc many"])
def test_an_export_between_the_two_calls_of_a_sample_continues_with_the_update(name, tmp_path):
    controller = CONTROLLERS[name]()
    x, e = heard_by(controller, 100)
    stepped(controller, x[:, :50], e[:, :50])
    controller.control_signal(sample(controller, x[:, 50]))
    out = Program(controller, tmp_path, first=1).run(x[:, 50:], e[:, 50:])
    controller.update(sample(controller, e[:, 50]))
    np.testing.assert_array_equal(out.y[:, 1:], stepped(controller, x[:, 51:], e[:, 51:]))


def test_an_export_changes_nothing_in_the_controller(tmp_path):
    controller, untouched = (CONTROLLERS["kf_opc many"]() for _ in range(2))
    for one in (controller, untouched):
        ran(one, slice(200))
    first = export_c(controller, tmp_path / "first.c", name="anc")
    second = export_c(controller, tmp_path / "second.c", name="anc")
    assert first.path.read_text().replace("first.h", "second.h") == second.path.read_text()
    results = [ran(one, slice(200, 400)).control_signal for one in (controller, untouched)]
    np.testing.assert_array_equal(*results)


# What a precision cannot hold.


def test_what_float32_cannot_hold_is_refused(tmp_path):
    long = fx_lms(2, [1.0], step_size=0.1, limiter=limiter(window=100_000))
    with pytest.raises(ValueError, match=r"window of 100000 samples is too long for float32.*at most"):
        export_c(long, tmp_path / "anc.c", dtype="float32")
    with pytest.raises(ValueError, match="path must be finite in float32"):
        export_c(fx_lms(2, [1e39], step_size=0.1), tmp_path / "anc.c", dtype="float32")
    with pytest.raises(ValueError, match="initial_variance must be finite in float32"):
        export_c(kf_anc(2, [1.0], **KALMAN | {"initial_variance": 1e39}), tmp_path / "anc.c", dtype="float32")
    with pytest.raises(ValueError, match="a setting or a path of diagonal is out of its range"):
        export_c(diagonal_kf(2, [1.0], **KALMAN | {"initial_variance": 1e30}), tmp_path / "anc.c", dtype="float32")
    assert list(tmp_path.iterdir()) == []
    assert export_c(long, tmp_path / "anc.c").n_bytes > 3 * 8 * 100_000


@pytest.mark.parametrize("ratio", [1e4, 1e7])
def test_a_large_initial_variance_is_no_harm_in_float32(ratio, tmp_path):
    """The rounding of P(0|0) alone is 6e-8 of 10^4 or 10^7 measurement noises.

    It is harm from 10^8 on, where float64 starts 30 times as loud as with 10^4, too.
    """
    noise = {"state_noise": 1e-8, "measurement_noise": 1e-3, "initial_variance": 1e-3 * ratio}
    controller = kf_opc(16, S_HAT, rated_power=0.5, fs=FS, **noise)
    program = Program(controller, tmp_path, "float32", path=S)
    x, d = (signal[0] for signal in noises())
    out = program.run(x, d)
    errors = d - np.convolve(out.y[0], S)[: d.size], ran(controller, slice(None)).error
    power, of_python = (np.mean(error[TRAINING:] ** 2) for error in errors)
    print(f"{ratio:g}: {power:.5f}, Python {of_python:.5f}")
    assert power < 1.01 * of_python
    assert not out.status.any()


# Bad input.


@pytest.mark.parametrize(
    ("name", "dtype", "large"),
    [("FxLMS plain", "float64", 1e200), ("MOVFxLMS many", "float32", 1e30), ("kf_opc many", "float64", 1e200)],
)
def test_a_bad_error_is_refused_and_a_bad_reference_counts_as_zero(name, dtype, large, tmp_path):
    """Python's controller, which gets zeros for the bad values and does not adapt to them, goes on alike."""
    controller = CONTROLLERS[name]()
    x, e = heard_by(controller, 900)
    e[-1, [300, 301, 450, 550, 650]] = [np.nan, np.inf, -np.inf, large, np.nan]
    x[-1, [400, 401, 500, 600, 650]] = [np.nan, np.inf, -np.inf, large, np.nan]
    out = Program(controller, tmp_path, dtype).run(x, e)
    bad_references, bad_errors = ~(np.abs(x) < large).all(axis=0), ~(np.abs(e) < large).all(axis=0)
    refused = np.where(bad_references, 1, np.where(bad_errors, 2, 0))
    x[:, bad_references], e[:, bad_errors] = 0.0, 0.0
    expected = controller.process(sample(controller, x), sample(controller, e), adapt=refused == 0)
    assert np.count_nonzero(refused) == 9
    np.testing.assert_array_equal(out.status, refused)
    np.testing.assert_allclose(out.y, np.atleast_2d(expected), rtol=0, atol=0 if dtype == "float64" else 2e-2)


@pytest.mark.parametrize(("dtype", "variance", "loud"), [("float64", 1e260, 1e24), ("float32", 1e27, 1e5)])
def test_a_covariance_that_is_too_large_for_a_reference_is_refused(dtype, variance, loud, tmp_path):
    controller = kf_anc(2, [1.0], state_noise=0.0, measurement_noise=1.0, initial_variance=variance)
    x, e = (signal[:1, :200].copy() for signal in noises())
    x[:, :100], e[:, :102] = 0.0, 0.0
    x[:, 100] = loud  # its square is finite, but not as many times as the variance says
    out = Program(controller, tmp_path, dtype).run(x, e)
    np.testing.assert_array_equal(np.flatnonzero(out.status), [100, 101])
    assert set(out.status) == {0, 5}
    assert np.isfinite(out.y).all()


@pytest.mark.parametrize(("dtype", "large", "limited"), [("float64", 1e304, True), ("float32", 1e34, False)])
def test_a_control_signal_that_overflows_is_silent_and_its_update_is_refused(dtype, large, limited, tmp_path):
    controller = kf_anc(2, [1.0], limiter=limiter() if limited else None, **KALMAN)
    controller._by_channel("weights")[0] = large
    out = Program(controller, tmp_path, dtype).run(np.array([1e-3 / large, 5e5, 0.0, 1e-3 / large]), np.ones(4))
    np.testing.assert_array_equal(out.status, [0, 3, 0, 0])
    np.testing.assert_allclose(out.y[0], [1e-3, 0.0, 0.0, 1e-3], rtol=1e-6)


@pytest.mark.parametrize(("name", "dtype"), [("kf_opc many", "float64"), ("KF-PB plain", "float32")])
def test_sanitizers_find_nothing(name, dtype, tmp_path):
    options = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    probe = tmp_path / "probe.c"
    probe.write_text("int main(void) { return 0; }\n")
    built = subprocess.run([*c_compiler(), *options, str(probe), "-o", str(tmp_path / "probe")], capture_output=True)
    if built.returncode != 0 or subprocess.run([str(tmp_path / "probe")], capture_output=True).returncode != 0:
        pytest.skip("the compiler has no address and undefined-behaviour sanitizers")
    controller = CONTROLLERS[name]()
    x, e = heard_by(controller, 4000)
    x[0, 1000], x[0, 2000], e[0, 3000], e[0, 3100] = np.nan, np.inf, np.nan, -np.inf
    out = Program(controller, tmp_path, dtype, (*FAST, *options)).run(x, e)
    np.testing.assert_array_equal(np.flatnonzero(out.status), [1000, 2000, 3000, 3100])


# What a stranger trips over: states and files that are not as they should be.


@pytest.mark.parametrize("name", ["KF-OPC limiter", "kf_pb many"])
def test_a_state_that_is_not_initialised_or_has_no_place_is_safe(name, tmp_path):
    """States of zeros, of rubbish and of another export begin like one that was initialised; no state is silence."""
    controller = CONTROLLERS[name]()
    ran(controller, slice(TRAINING))
    export_c(ALL["FxLMS plain"](), tmp_path / "other.c")
    exported = export_c(controller, tmp_path / "anc.c")
    sources = [FOLDER / "any_state.c", exported.path, tmp_path / "other.c"]
    arrays = ["-DARRAYS"] if controller.multichannel else []
    succeeds(*c_compiler(), "-std=c99", *FAST, *arrays, "-I", tmp_path, *sources, "-lm", "-o", tmp_path / "main")
    succeeds(tmp_path / "main")


def test_complex_h_may_come_first_and_the_source_refuses_to_be_cpp(tmp_path):
    """<complex.h> defines I, of which the core has a member."""
    path = export_c(ALL["KF-OPC plain"](), tmp_path / "anc.c").path
    succeeds(*c_compiler(), "-std=c99", *WARNINGS, "-include", "complex.h", "-fsyntax-only", path)
    succeeds(*c_compiler(), "-std=c99", *WARNINGS, "-include", "complex.h", "-fsyntax-only", path.with_suffix(".h"))
    done = subprocess.run([tool("c++", "g++"), "-x", "c++", "-fsyntax-only", path], capture_output=True, text=True)
    assert done.returncode != 0
    assert "compile this file as C99; C++ can include its header" in done.stderr


# The folder.


@pytest.mark.parametrize(
    ("name", "dtype", "command"), [("KF-OPC limiter", "float64", "gcc"), ("kf_pb many", "float32", "clang")]
)
def test_the_example_in_a_folder_runs(name, dtype, command, tmp_path):
    folder = tmp_path / "firmware"
    exported = export_c(CONTROLLERS[name](), folder, name="left", dtype=dtype)
    assert {path.name for path in folder.iterdir()} == {"left.c", "left.h", "main.c", "README.md"}
    assert exported.path == folder / "left.c"
    stated = re.search(r"`cc (-std=c99 .*) main.c left.c -lm -o main", (folder / "README.md").read_text())
    flags = (*stated[1].replace("-O3", "-O0").split(), *WARNINGS)
    succeeds(tool(command), *flags, folder / "main.c", exported.path, "-lm", "-o", folder / "main")
    done = subprocess.run([str(folder / "main")], capture_output=True, text=True)
    assert done.returncode == 0
    assert re.fullmatch(r"100 samples, largest y \S+, 0 updates refused\n", done.stdout)


# The files.


def test_only_the_calls_are_visible_and_only_the_mathematics_library_is_needed(tmp_path):
    if shutil.which("nm") is None:
        pytest.skip("needs nm, which lists a file's symbols")
    for name in ("MOVFxLMS many", "kf_opc many"):
        path = export_c(CONTROLLERS[name](), tmp_path / "anc.c").path
        succeeds(*c_compiler(), "-std=c99", "-O1", *WARNINGS, "-c", path, "-o", tmp_path / "anc.o")
        symbols = subprocess.run(["nm", str(tmp_path / "anc.o")], capture_output=True, text=True, check=True).stdout
        needed = {line.split()[-1] for line in symbols.splitlines() if " U " in line}
        assert needed <= {"sqrt", "memcpy", "memmove", "memset", "strcmp"}
        public = {line.split()[-1] for line in symbols.splitlines() if line.split()[-2] in "TDBRC"}
        assert public == {"anc_init", "anc_control_signal", "anc_update", "anc_self_test"}


def test_two_controllers_of_other_names_link_into_one_program_also_of_cpp(tmp_path):
    export_c(CONTROLLERS["KF-OPC limiter"](), tmp_path / "left.c")
    export_c(CONTROLLERS["MOVFxLMS many"](), tmp_path / "other.c", name="right_2", dtype="float32")
    main = tmp_path / "main.cpp"
    main.write_text(
        '#include "left.h"\n#include "other.h"\nstatic left_state a;\nstatic right_2_state b;\n'
        "int main() { return left_self_test(&a) || right_2_self_test(&b) || LEFT_ADAPTED || LEFT_TAPS == RIGHT_2_TAPS; }\n"
    )
    objects = [tmp_path / "left.o", tmp_path / "other.o"]
    for path in objects:
        succeeds(*c_compiler(), "-std=c99", *FAST, *WARNINGS, "-c", path.with_suffix(".c"), "-o", path)
    options = ("-Wall", "-Wextra", "-Wpedantic", "-Werror", "-I", tmp_path)
    succeeds(tool("c++", "g++"), *options, main, *objects, "-lm", "-o", tmp_path / "main")
    succeeds(tmp_path / "main")


STRICT = (
    "-Wall -Wextra -Wpedantic -Wconversion -Wundef -Wcast-qual -Wcast-align -Wstrict-prototypes -Wmissing-prototypes"
)
REFUSED = "compile it without -ffast-math, and not for the x87"
DIFFERENT = "the self-test failed: this compiler, or one of its flags, changes the arithmetic"
# What strangers compile with, and what they are told. A processor without fused operations gives the bits in any case.
FLAGS = [
    *((cc, flags, "") for cc in ("gcc", "clang") for flags in ("", f"-std=c99 -O2 {STRICT} -Werror", "-std=c11 -Os", "-Og -g")),
    *((cc, "-O3 -march=native", DIFFERENT) for cc in ("gcc", "clang")),
    *((cc, "-std=gnu17 -O3 -march=native -ffp-contract=off", "") for cc in ("gcc", "clang")),
    ("gcc", "-std=c99 -O3 -march=native", ""),  # in which gcc contracts nothing
    ("gcc", "-O2 -flto -fPIC -fvisibility=hidden", ""),
    ("gcc", "-O2 -D_FORTIFY_SOURCE=2 -fstack-protector-strong -funsigned-char -fshort-enums", ""),
    ("gcc", "-O3 -funroll-loops -frounding-math -fwrapv", ""),
    ("clang", "-O2 -fstrict-aliasing -ftrapping-math -fno-signed-zeros", ""),
    ("gcc", "-O2 -m32 -msse2 -mfpmath=sse", ""),
    ("gcc", "-O2 -m32 -mfpmath=387", REFUSED),
    *(("gcc", f"-O2 {flag}", REFUSED) for flag in ("-ffast-math", "-funsafe-math-optimizations", "-freciprocal-math", "-mfpmath=387")),
    *((cc, flag, REFUSED) for cc in ("gcc", "clang") for flag in ("-Ofast", "-O2 -ffinite-math-only")),
]  # fmt: skip


@pytest.fixture(scope="module")
def a_strangers(tmp_path_factory):
    return export_c(ALL["KF-OPC limiter"](), tmp_path_factory.mktemp("anc")).path


@pytest.mark.parametrize(
    ("command", "flags", "told"),
    [pytest.param(*one, marks=() if one[1] in ("-O3 -march=native", "-Ofast") else pytest.mark.slow) for one in FLAGS],
)
def test_with_any_flags_the_bits_are_those_of_python_or_it_is_told(command, flags, told, a_strangers, tmp_path):
    options, main = [tool(command), *flags.split()], tmp_path / "main"
    (tmp_path / "c.c").write_text("#include <math.h>\nint main(void) { return 0; }\n")
    if subprocess.run([*options, tmp_path / "c.c", "-o", main], capture_output=True).returncode:
        pytest.skip("the compiler does not know these flags, or has no C library for them")
    made = subprocess.run(
        [*options, a_strangers.with_name("main.c"), a_strangers, "-lm", "-o", main], capture_output=True, text=True
    )
    if told == REFUSED:
        assert made.returncode != 0
        assert REFUSED in made.stderr
        return
    assert (made.returncode, made.stderr) == (0, "")
    said = subprocess.run([str(main)], capture_output=True, text=True).stdout
    assert said.startswith("100 samples, ") or said == f"{told}\n" != "\n"


def test_a_name_cannot_end_the_comment_that_it_stands_in(tmp_path):
    controller = ALL["FxLMS plain"]()
    controller.name = "mine */ int broken;"
    succeeds(*c_compiler(), "-std=c99", *WARNINGS, "-fsyntax-only", export_c(controller, tmp_path / "anc.c").path)


# What is refused.


class Own(CoreController):
    """An FxLMS with calls of its own."""

    def update(self, error):
        super().update(0.5 * error)


NOT_EXPORTED = {
    "a number": (lambda: 3.0, "float .* is not in the core"),
    "wrapper": (ALL["FeedbackNeutralizer"], r"FeedbackNeutralizer\) is not in the core"),
    "own calls": (
        lambda: Own("FxLMS", "fxlms", 4, S_HAT, settings={"step_size": 0.1}),
        r"FxLMS \(Own\) has calls of its own",
    ),
    "estimator": (ALL["KFOPC"], r"KF-OPC \(KalmanController\) has calls of its own"),
}


@pytest.mark.parametrize("case", NOT_EXPORTED)
def test_a_controller_that_is_not_exported_is_refused_by_name(case, tmp_path):
    make, reason = NOT_EXPORTED[case]
    controller = make()
    with pytest.raises(TypeError, match=rf"{reason} and cannot be exported: export_c takes the controllers whose"):
        export_c(controller, tmp_path / "anc.c")
    assert not list(tmp_path.glob("anc*"))


BAD_ARGUMENTS = {
    "path": ({"path": "anc.txt"}, ValueError, "must end in .c"),
    "stem": ({"path": "my anc.c"}, ValueError, "C identifier"),
    "name": ({"name": "_anc"}, ValueError, "C identifier"),
    "example's name": ({"path": "folder", "name": "main"}, ValueError, "whose main.c is the example"),
    "dtype": ({"dtype": "float16"}, ValueError, "'float64' or 'float32', got float16"),
    "no dtype": ({"dtype": "double precision"}, TypeError, "'float64' or 'float32', got 'double precision'"),
}


@pytest.mark.parametrize("case", BAD_ARGUMENTS)
def test_bad_arguments_are_refused_before_a_file_is_written(case, tmp_path):
    arguments, error, reason = BAD_ARGUMENTS[case]
    arguments = {"path": "anc.c"} | arguments
    with pytest.raises(error, match=reason):
        export_c(ALL["KF-OPC plain"](), tmp_path / arguments.pop("path"), **arguments)
    assert list(tmp_path.iterdir()) == []
