"""Prove what the core promises, with Frama-C and Gappa: `nox -s prove`, some minutes on two cores.

Every job must come to its end, with no alarm or with each goal that it names; one that does not is printed, and the exit
status is 1. Needs Debian's packages frama-c-base, why3, z3, cvc4 and gappa.
"""

from __future__ import annotations

import os
import re
import resource
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
CORE = HERE.parents[1] / "kfopc_filterpy" / "core"
MACHINE = ("-machdep", "gcc_x86_64")
MOST_S, MOST_BYTES = 300, 8 << 30  # of a job: CPU time and memory
EVA = shlex.split(
    "-eva -warn-special-float none -eva-ilevel 20 -eva-mlevel 99 -eva-widening-delay 9 -eva-no-alloc-returns-null "
    "-eva-warn-signed-converted-downcast"
)
# A controller's block is opened field by field, and its rows are followed one by one, so what finds them is followed exactly.
EXACTLY = {
    "main": 5,
    "advance": 100,
    **dict.fromkeys(("field", "anc_open"), 100),
    **dict.fromkeys(("values_accepted", "shape_accepted", "layout_signals", "start_signals", "set_loudest"), 1000),
}
COVARIANCE = {
    "pass": 500,
    "multiply": 200,
    "fade": 200,
    "start_covariance": 100,
    "lift": 100,
    "largest_variance": 100,
    "row_of": 10,
}
BUDGET = {
    "start_fourier": 1000,
    **dict.fromkeys(("transform_complex", "set_right", "path_of"), 100),
    **dict.fromkeys(("add_lags", "dot", "respond"), 30),
}
ANY_ANSWER = (  # of the processor, of which Eva knows nothing
    (
        "processor.c",
        '__asm__("cpuid" : "=a"(r[0]), "=b"(r[1]), "=c"(r[2]), "=d"(r[3]) : "a"(leaf), "c"(0));',
        "for (int i = 0; i < 4; i++) r[i] = Frama_C_unsigned_int_interval(0, ~0u);",
    ),
    (
        "processor.c",
        '__asm__("xgetbv" : "=a"(kept), "=d"(upper) : "c"(0));',
        "kept = upper = Frama_C_unsigned_int_interval(0, ~0u);",
    ),
    ("processor.c", '#include "anc.h"', '#include "anc.h"\n#include "__fc_builtin.h"'),
)
OWN_MEMORY = (  # so that no field is written beyond its end into the next one
    ("signals.c", '#include "signals.h"', '#include "signals.h"\n#include <stdlib.h>'),
    ("signals.c", "return at->memory ? at->memory + offset : NULL;", "return at->memory ? calloc(1, bytes) : NULL;"),
)
COMMON = ("controller.c", "signals.c", "constraint.c", "amplifier.c", "limiter.c")
ANY_SETTINGS = ", ".join(["any()"] * 8)  # at least as many as an algorithm takes
# Two microphones, two loudspeakers; windows of 3 and 4 samples; paths that are not exact. There are 12 weights, one group and
# a half of the covariance's rows, or with an internal model 24, three groups.
SHAPE: dict[str, Any] = {"scenarios": 1, "microphones": 2, "loudspeakers": 2, "references": 2, "modelled": 0}
SHAPE |= {"taps": 3, "path_taps": 3, "window": 3, "limiter": 4, "guard": 2}
SHAPES = {"two scenarios": SHAPE | {"scenarios": 2}, "internal model": SHAPE | {"modelled": 1}}


def frama_c(folder: Path, *arguments: object) -> str:
    """Return what Frama-C prints."""
    flags = f"-cpp-extra-args=-DLANES_OF_ONE -I{folder} -I{CORE} -I{HERE}"
    return printed("frama-c", flags, *MACHINE, *arguments)


def printed(*command: object, given: str | None = None) -> str:
    """Return what a command prints; it is ended if it takes too much CPU time or memory."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (MOST_S, MOST_S))
        resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))

    line = [str(part) for part in command]
    done = subprocess.run(line, input=given, capture_output=True, text=True, cwd=HERE, preexec_fn=limit)
    ended = f"Error: ended with status {done.returncode}\n" if done.returncode else ""
    return done.stdout + done.stderr + ended


def alarms(
    program: str,
    sources: tuple[str, ...],
    options: tuple[object, ...],
    says: str = "",
    changes: tuple[tuple[str, str, str], ...] = (),
    reached: tuple[str, ...] = (),
    **shape: Any,
) -> list[str]:
    """Return what Eva finds in a program of this folder with files of the core: alarms, or a line that is missing.

    A change is of a file: what is in it, and what takes its place. Every statement of the functions `reached` must be
    analysed: Eva has nothing to say of what it takes for unreachable.
    """
    with tempfile.TemporaryDirectory() as made:
        defined = "".join(f"#define {name.upper()} {value}\n" for name, value in shape.items())
        Path(made, "shape.h").write_text(defined)
        files = [HERE / program, *(CORE / name for name in sources)]
        for name in {name for name, *_ in changes}:
            text = (CORE / name).read_text()
            for right, wrong in (own for changed, *own in changes if changed == name):
                text = replaced(text, right, wrong)
            Path(made, name).write_text(text)
            files[sources.index(name) + 1] = Path(made, name)
        then = ("-then", "-metrics", "-metrics-eva-cover") if reached else ()
        text = frama_c(Path(made), *files, *EVA, *options, *then)
    # A precondition of memcpy, such as that nothing overlaps, is not counted as an alarm.
    clean = (
        "\n  0 alarms generated by the analysis" in text
        and "100% of the logical properties reached have been proven" in text
    )
    missed = [name for name in reached if not re.search(rf"^  {name}: .*\(100\.0%\)$", text, flags=re.M)]
    if clean and re.search(says, text):
        return [f"not reached to the last statement: {name}" for name in missed]
    return re.findall(r"\[eva:alarm\] .*\n.*", text) or [text[-500:]]


def replaced(text: str, right: str, wrong: str) -> str:
    """Return a text with one place changed."""
    assert text.count(right) == 1, right
    return text.replace(right, wrong)


def controller(
    algorithm: str,
    *sources: str,
    settings: str = ANY_SETTINGS,
    exactly: Mapping[str, int] = {},
    changes: tuple[tuple[str, str, str], ...] = (),
    reached: tuple[str, ...] = ("main",),
    options: tuple[object, ...] = (),
    **shape: Any,
) -> Callable[[], list[str]]:
    """Return a job: what Eva finds in a controller that runs for ever, if each field of its block is memory of its own.

    Its settings and its paths are any numbers, too.
    """
    followed = ",".join(f"{name}:{count}" for name, count in (EXACTLY | dict(exactly)).items())
    given = shlex.split("-eva-slevel 0 -eva-split-return full -eva-auto-loop-unroll 200 -eva-slevel-function")
    shape |= {"algorithm": f"anc_{algorithm}", "settings": settings}
    return lambda: alarms(
        "controller_runs.c",
        (*COMMON, *sources),
        (*given, followed, *options),
        changes=(*OWN_MEMORY, *changes),
        reached=reached,
        **shape,
    )


def woven(contracts: Path, folder: Path, right: str = "", wrong: str = "") -> list[Path]:
    """Write copies of the core's files with the blocks of a file of contracts in them, and return their paths.

    A fault, `wrong` in place of what is `right`, can be put into the last one.
    """
    _, *parts = re.split(r"^== (.*)\n", contracts.read_text(), flags=re.M)
    for name, blocks in zip(parts[::2], parts[1::2], strict=True):
        lines = (CORE / name).read_text().splitlines()
        for side, begin, block in re.findall(r"^([<>]) (.*)\n((?:(?![<>] ).*\n)+)", blocks, flags=re.M):
            (at,) = [n for n, line in enumerate(lines) if line.strip().startswith(begin)]
            lines[at + (side == ">") : at + (side == ">")] = block.rstrip().splitlines()
        text = "\n".join(lines) + "\n"
        if right and name == parts[-2]:
            text = replaced(text, right, wrong)
        (folder / name).write_text(text)
    for path in CORE.glob("*.h"):
        if path.name not in parts:
            (folder / path.name).write_text(path.read_text())
    return [folder / name for name in parts[::2]]


def goals(path: Path, folder: Path, *options: str, patience_s: int = 30) -> list[str]:
    """Return the goals of a file's contracts, over real numbers, that WP leaves open."""
    wp = ("-wp", "-wp-model", "Typed+real", "-wp-prover", "cvc4,z3", "-wp-timeout", patience_s, "-wp-par", 1)
    text = frama_c(folder, *wp, *options, path)
    proved = re.search(r"Proved goals: +(\d+) / (\d+)", text)
    if proved and proved[1] == proved[2] != "0":
        return []
    return re.findall(r"^\[wp\] \[(?:Failed|Timeout|Unknown)\] Goal .*", text, flags=re.M) or [text[-1500:]]


def theorem() -> list[str]:
    """Return the goals of the limiter's theorem that are open: no window exceeds its budget."""
    with tempfile.TemporaryDirectory() as made:
        path = woven(HERE / "limiter.acsl", Path(made))[-1]
        # `root` is exact, by assumption; `anc_limit` only finds the rows, and the position as a whole number.
        return goals(path, Path(made), "-wp-fct", PROVED)


PROVED = "larger,smaller,aim,start_lap,square_of,hear,shrunk,less,scaled,fit,record,restrain"
FAULTS = {  # a function, what is right in it, and what is not
    "no guarantee": ("fit", "if (square_of(c, y) > left) {", "if (0) {"),
    "clipped to the other sign": ("fit", "y = u < 0 ? -most : most;", "y = u > 0 ? -most : most;"),
    "no amplitude limit": ("fit", "smaller(c->limit, larger(-c->limit, wanted))", "wanted"),
    "energy not noted": ("record", "c->spent += square;", ""),
    "wrong sign of the lap": ("record", "r.out[i] = -c->spent;", "r.out[i] = c->spent;"),
    "last lap not summed": ("start_lap", "r.out[k] = rest;", ""),
}
FAULT_S = 10  # for a goal: a busy machine, too, proves what is right in this time


def faults() -> list[str]:
    """Return the faults that the theorem does not notice: a proof that cannot fail proves nothing.

    Each is noticed by a goal that is not proved within FAULT_S. So the right code has to be proved within that time.
    """
    wrong = []
    right = {f"no fault in {function}": (function, "", "") for function, *_ in FAULTS.values()}
    for name, (function, *change) in (right | FAULTS).items():
        with tempfile.TemporaryDirectory() as made:
            path = woven(HERE / "limiter.acsl", Path(made), *change)[-1]
            left = goals(path, Path(made), "-wp-fct", function, patience_s=FAULT_S)
        noticed = bool(left) and all(line.startswith("[wp] [") for line in left)  # else the code was not read
        as_it_should = not left if name in right else noticed
        if not as_it_should:
            wrong.append(f"{name}: {left}")
    return wrong


def rounding() -> list[str]:
    """Return the open goals of the lemma on rounded sums, for any number of terms."""
    with tempfile.TemporaryDirectory() as made:
        return goals(HERE / "rounding.c", Path(made))


def margin() -> list[str]:
    """Return what is wrong with the margin for rounding: windows that could exceed the rated power."""
    wrong = []
    for form, bits, wide, longest in (("ieee_64", 53, 200, 10**7), ("ieee_32", 24, 30, 83_000)):
        u = Fraction(1, 2**bits)
        text = (HERE / "clip.gappa").read_text().replace("FORMAT", form).replace("WIDE", str(wide))
        text = text.replace("ROUNDINGS", f"{3 * 2**10 + 1}b-{bits + 10}").replace("UNIT", f"1b-{bits}")
        said = printed("gappa", given=text)
        if "Results" in said or "Error" in said or "failed" in said:
            wrong.append(f"{form}: {said}")
        # peak * scale is at most 1 - 8 u, rounded twice; then the roundings that Gappa bounds, and that of the square.
        clipped = ((1 - 8 * u) * (1 + u) ** 2 * (1 + 3 * u + u / 2**9)) ** 2 * (1 + u)
        # A sum of N terms, 11 roundings of an energy and one of what is left, see `OutputLimiter`.
        window = (1 - 2 * (longest + 16) * u) * (1 + u) / ((1 - (longest - 1) * u) * (1 - 12 * u))
        wrong += [
            f"{form}: {name} is 1 + {float(most - 1):.3g}"
            for name, most in (("clipped", clipped), ("window", window))
            if most >= 1
        ]
    return wrong


CONTROLLERS = {  # their name in C, and their file
    "FxLMS": ("fxlms", "lms.c"),
    "FxNLMS": ("fxnlms", "lms.c"),
    "leaky FxLMS": ("leaky", "lms.c"),
    "optimal leaky FxLMS": ("optimal_leaky", "lms.c"),
    "MOV-FxLMS": ("mov", "lms.c"),
    "MOV-FxLMS with a fixed penalty": ("mov_fixed", "lms.c"),
    "two-gradient FxLMS": ("two_gradient", "lms.c"),
    "clipping FxLMS": ("clipping", "lms.c"),
    "re-scaling FxLMS": ("rescaling", "lms.c"),
    "diagonal KF": ("diagonal", "diagonal.c"),
    "signals alone": ("signals_alone",),
}
# What Eva must analyse to the last statement: a block's end, a fit, a surprise and the silence after it, clicks.
LEARNING = (
    *("control_signal_budget", "cut_clicks", "note", "end_block", "learn", "notice_surprise"),
    *("begin_block", "approach", "solve_all", "next_prices"),
)
# With 16 and 32 numbers in a transform, it takes every step; a block of 13 samples is longer than the lags that 16 hold.
BUDGETS: dict[str, dict[str, Any]] = {
    "2 microphones, 2 loudspeakers, 1 reference, 8 and 2 taps, blocks of 13": SHAPE
    | {"references": 1, "taps": 8, "path_taps": 2, "guard": 0}
    | {"settings": "any(), any(), 13, 20, any(), any(), Frama_C_double_interval(5e-324, 1000)"}
    | {"reached": (*LEARNING, "approach_posterior", "begin_data", "add_samples", "hear_row", "make_step")},
    "exact path, internal model, 1 channel, 3 and 3 taps, blocks of 13": SHAPE
    | {"microphones": 1, "loudspeakers": 1, "references": 1, "modelled": 1, "guard": 0}
    | {"settings": "any(), 13, 20, any(), any(), 0"}
    | {"reached": LEARNING},
}
EXACT = BUDGETS["exact path, internal model, 1 channel, 3 and 3 taps, blocks of 13"]
KALMAN_FAULTS = {  # a file, what is right in it, and what is not
    "a row too far": ("covariance.c", "row += 2 * length;", "row += 2 * length + PARTS;"),
    "a row too many": ("covariance.c", "c->padded = groups * PARTS;", "c->padded = groups * PARTS + 1;"),
    "a delay line that ends late": ("signals.c", "*l->at = l->length - l->taps;", "*l->at = l->length - l->taps + 1;"),
}
BUDGET_FAULTS = {
    "a spectrum too long": (
        "fourier.c",
        "scratch_row(f, 1)), (size_t)f->F);",
        "scratch_row(f, 1)), (size_t)f->F + 1);",
    ),
    "a sample too many transformed": ("fourier.c", "k < n && k < H; k++) {", "k <= n && k < H; k++) {"),
    "a lag too many": ("fourier.c", "add_scaled(to + first, 1, U, now);", "add_scaled(to + first, 1, U, now + 1);"),
    "a history moved too far": ("posterior.c", "(size_t)(f->history - f->B));", "(size_t)(f->history - f->B + 1));"),
    "an error too late": ("posterior.c", "at = f->B - 1 - f->heard[FILLED]", "at = f->B - f->heard[FILLED]"),
    "a click of no microphone": ("budget.c", "f->peak + s->I + k)", "f->peak + s->I + k + 1)"),
    "a block too long": ("budget.c", "if (p->heard[FILLED] == p->B)", "if (p->heard[FILLED] > p->B)"),
    "a book moved too far": ("budget.c", "times(f->T - 1, J)", "times(f->T, J)"),
    "a weight too many silenced": (
        "budget.c",
        "clear(f->s.weights, times(f->s.J * f->s.I, f->s.L));",
        "clear(f->s.weights, times(f->s.J * f->s.I, f->s.L + 1));",
    ),
}
TO_AN_ALARM = ("-eva-stop-at-nth-alarm", 1)


def kalman(**given: Any) -> Callable[[], list[str]]:
    """Return a job: the Kalman filter."""
    return controller("kalman", "kalman.c", "covariance.c", exactly=COVARIANCE, **given)


def power_budget(**given: Any) -> Callable[[], list[str]]:
    """Return a job: KF-PB."""
    return controller("power_budget", "fourier.c", "posterior.c", "budget.c", exactly=BUDGET, **given)


def noticed(job: Callable[[], list[str]]) -> Callable[[], list[str]]:
    """Return a job that is done if Eva notices the fault of another one."""
    return lambda: [] if any(line.startswith("[eva:alarm]") for line in job()) else ["no alarm"]


JOBS: dict[str, Callable[[], list[str]]] = {
    "limiter, window 16, any input, for ever": lambda: alarms(
        "limiter_runs.c", ("limiter.c",), ("-eva-slevel", 40), r"show_each_y: \[-8\. \.\. 8\.\] . \{NaN\}"
    ),
    "constraint, exponential, for ever": lambda: alarms(
        "constraint_runs.c", ("constraint.c",), ("-eva-slevel", 60), length=0
    ),
    "constraint, window 8, for ever": lambda: alarms(
        "constraint_runs.c", ("constraint.c",), ("-eva-slevel", 60), length=8
    ),
    "amplifiers, any input": lambda: alarms("amplifier_runs.c", ("amplifier.c",), ("-eva-slevel", 200)),
    "processor, any answer": lambda: alarms(
        "processor_runs.c", ("processor.c",), ("-eva-slevel", 20), r"show_each_level: \{1; 3; 4\}", ANY_ANSWER
    ),
    "limiter: no window exceeds its budget, over real numbers": theorem,
    "faults of the limiter are noticed": faults,
    "sums of any length, rounded": rounding,
    "margin for rounding": margin,
    "loop and blocks of samples, two scenarios, for ever": lambda: alarms(
        "loop_runs.c",
        ("loop.c", "amplifier.c"),
        ("-eva-slevel-function", "main:5,advance:10", "-eva-auto-loop-unroll", 200),
    ),
    **{
        f"{name}, {words}, for ever": controller(*files, **shape)
        for name, files in CONTROLLERS.items()
        for words, shape in SHAPES.items()
    },
    **{f"Kalman filter, {words}, for ever": kalman(**shape) for words, shape in SHAPES.items()},
    **{f"KF-PB, {words}, for ever": power_budget(**given) for words, given in BUDGETS.items()},
    **{
        f"fault of memory, {name}": noticed(kalman(changes=(fault,), options=TO_AN_ALARM, **SHAPES["internal model"]))
        for name, fault in KALMAN_FAULTS.items()
    },
    **{
        f"fault of memory, {name}": noticed(power_budget(changes=(fault,), options=TO_AN_ALARM, **EXACT))
        for name, fault in BUDGET_FAULTS.items()
    },
}


def main() -> int:
    """Run the jobs whose names contain an argument, or all."""
    with tempfile.TemporaryDirectory() as made:
        os.environ["WHY3CONFIG"] = str(Path(made, "why3.conf"))  # the provers of this machine
        printed("why3", "config", "detect")
        return run()


def run() -> int:
    """Run the jobs, and print what is proved."""
    chosen = {name: job for name, job in JOBS.items() if any(part in name for part in sys.argv[1:] or [""])}
    with ThreadPoolExecutor(min(2, os.cpu_count() or 1)) as pool:
        running = {name: pool.submit(job) for name, job in chosen.items()}
        failed = 0
        for name, future in running.items():
            found = future.result()
            failed += bool(found)
            print(name, "proved" if not found else "\n".join(["NOT PROVED", *found]), sep=": ", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
