"""Refused steps change nothing, and plans of any kind are refused or stay within their bytes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.core import ALGORITHMS, c_compiler, known, program, ran
from hypothesis import example, given, settings
from hypothesis import strategies as st

from kfopc_filterpy import OutputLimiter
from kfopc_filterpy.core import building
from kfopc_filterpy.core.block import Algorithm, Block, Shape

SHAPES = {
    "one channel": Shape(1, 1, 1, 9, 5),
    "two references": Shape(1, 1, 2, 9, 5),
    "one channel with a guard and windows": Shape(1, 1, 1, 9, 5, 3, (6,), (7,)),
    "several channels": Shape(2, 3, 2, 9, 5),
    "several channels with guards and windows": Shape(2, 3, 2, 9, 5, 3, (0, 6, 4), (7, 5, 7)),
}
UNUSABLE = (np.nan, np.inf, -np.inf)
LOUD = (1e40, 1e70, 1e99, 1e101, -1e150, 1e300)


class Described(Block):
    """A block whose steps are called by their names."""

    def kept(self) -> dict[str, bytes]:
        """Return the bytes of all that a refused step must not change."""
        return {name: field.tobytes() for name, field in self.fields.items() if name not in self.scratch}

    def step(self, half: str, signal: np.ndarray) -> int:
        """Call control_signal or update of the algorithm."""
        if half == "update":
            self.error[:] = signal
            return self.update()
        self.reference[:] = signal
        return self.emit()


def made(name: str, shape: Shape) -> Described:
    """Return a fresh block with random paths; limiters, where it has some, act."""
    rng = np.random.default_rng(5)
    K, J, M = shape.microphones, shape.loudspeakers, shape.path_taps
    guard = 0.1 * rng.standard_normal(shape.guard_taps)
    path = 0.5 * rng.standard_normal((K, J, M))
    block = Described(Algorithm(name), shape, path=path, settings=ALGORITHMS[name], guard=guard)
    for j, window in enumerate(shape.limiter_windows):
        limiter = OutputLimiter(0.01, window_s=float(window), fs=1.0)
        laps = block.fields["laps"][0, j].reshape(-1)[: 3 * (window + 1)].reshape(3, window + 1)
        limiter.live_in(block.fields["limiter"][0, 0, j], laps)
    return block


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_refused_step_changes_nothing(name: str, shape: str) -> None:
    """And the controller goes on as one that never saw it."""
    try:
        disturbed, undisturbed = made(name, SHAPES[shape]), made(name, SHAPES[shape])
    except ValueError:
        assert shape != ("two references" if name == "observer" else "one channel"), f"{name} refuses {shape}"
        pytest.skip(f"{name} refuses this shape")
    rng, refusals = np.random.default_rng(6), set()
    for n in range(120):
        for half, channels in (("control_signal", disturbed.reference.size), ("update", disturbed.error.size)):
            if n > 5 and rng.random() < 0.5:
                bad, channel = rng.uniform(-1.0, 1.0, channels), rng.integers(channels)
                unusable = n < 100 or rng.random() < 0.5  # a loud sample may be taken, and after it others are refused
                bad[channel] = rng.choice(UNUSABLE if unusable else LOUD)
                before = disturbed.kept()
                answer = disturbed.step(half, bad)
                refusals.add((half, answer))
                if answer:
                    after = disturbed.kept()
                    assert [field for field in before if before[field] != after[field]] == [], (n, half, bad, answer)
                else:
                    assert np.all(np.isfinite(bad)), f"{half} took {bad}"
                    assert undisturbed.step(half, bad) == 0
            good = rng.uniform(-1.0, 1.0, channels)
            assert disturbed.step(half, good) == undisturbed.step(half, good)
            assert disturbed.kept() == undisturbed.kept(), (n, half)
            assert disturbed.control_signal.tobytes() == undisturbed.control_signal.tobytes()
    assert {half for half, answer in refusals if answer} == {"control_signal", "update"}
    assert disturbed.kept() != made(name, SHAPES[shape]).kept()


# Plans of any kind.

ANY_NUMBER = st.one_of(
    st.sampled_from(
        [0.0, -0.0, 1.0, -1.0, 1e-310, 1e-30, 1e30, 1e100, 1e155, 1.7e308, -1.7e308, np.nan, np.inf, -np.inf]
    ),
    st.floats(),
)
COUNT = st.integers(1, 4)
ODD_COUNT = st.one_of(COUNT, st.sampled_from([0, -1, 2**31 - 1, 2**31, 2**32 + 1, -(2**31)]))
TAPS = st.integers(1, 70)


@st.composite
def plans(draw: st.DrawFn, odd: bool) -> tuple[str, Shape, dict[str, Any]]:
    """Return an algorithm, a shape and the arguments of a block."""
    count = ODD_COUNT if odd and draw(st.integers(0, 4)) == 0 else COUNT
    name = draw(st.sampled_from(known()))
    K, J, references = draw(COUNT), draw(COUNT), draw(count)
    taps, path_taps, guard_taps = (
        draw(TAPS if count is COUNT else count),
        draw(TAPS),
        draw(st.sampled_from([0, 1, 5, 48])),
    )
    windows = [
        tuple(draw(st.lists(st.integers(least, 40), min_size=J, max_size=J))) if draw(st.booleans()) else ()
        for least in (0, 1)
    ]
    if odd and draw(st.integers(0, 4)) == 0:
        windows[draw(st.integers(0, 1))] = draw(st.tuples(st.sampled_from([-1, 0, 1, 2**28, 2**31 - 1])))
    shape = Shape(
        K, J, references, taps, path_taps, guard_taps + (50 if odd and draw(st.integers(0, 9)) == 0 else 0), *windows
    )
    rng = np.random.default_rng(draw(st.integers(0, 9)))
    path, guard = rng.standard_normal((K, J, path_taps)), rng.standard_normal(shape.guard_taps)
    values: dict[str, Any] = dict(ALGORITHMS[name])
    if odd:
        changed = draw(st.sampled_from(["", "path", "guard", *values]))
        if changed == "path":
            path.flat[draw(st.integers(0, path.size - 1))] = draw(ANY_NUMBER)
        elif changed == "guard" and guard.size:
            guard[-1] = draw(ANY_NUMBER)
        elif changed in values:
            values[changed] = draw(ANY_NUMBER)
    return name, shape, {"path": path, "guard": guard, "settings": values}


@given(plan=plans(odd=True), fill=st.booleans())
@example(plan=("fxlms", Shape(1, 1, 1, 2**32 + 8, 1), {"path": np.ones(1), "settings": {"step_size": 1.0}}), fill=False)
@example(plan=("fxlms", Shape(1, 1, 1, 8, 1), {"path": np.ones(1)}), fill=False)
@example(plan=("fxlms", Shape(1, 1, 1, 8, 1), {"settings": {"step_size": 1.0}}), fill=False)
@settings(max_examples=400)
def test_a_block_of_any_plan_is_refused_or_works(plan: tuple[str, Shape, dict[str, Any]], fill: bool) -> None:
    name, shape, arguments = plan
    try:
        block = Block(Algorithm(name), shape, **arguments)
    except ValueError:
        return
    assert block.fields["weights"].shape[1:] == (shape.loudspeakers, shape.references, shape.taps)
    for _ in range(3):
        block.reference[:], block.error[:] = 0.5, -0.5
        if not block.emit() and fill:
            block.update()
    assert block.fields["secondary_path"].ravel().tolist() == np.ravel(arguments["path"]).tolist()


@pytest.mark.parametrize(
    ("name", "real", "plans"),
    [
        ("any_plan", "double", [("1", "1000")]),
        *(
            pytest.param(name, real, plans, marks=pytest.mark.slow)
            for name, plans in (("same_bits", [()]), ("any_plan", [("1", "4000"), ("2", "4000")]))
            for real in building.REALS
        ),
    ],
)
def test_under_sanitizers(name: str, real: str, plans: list[tuple[str, ...]], tmp_path: Any) -> None:
    """Every access within its array, no undefined behaviour; any_plan also compares states around refused steps."""
    options = ("-O1", "-g", "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all")
    made = program(name, tmp_path, c_compiler(), *options, real=real)
    for arguments in plans:
        ran(made, *arguments, UBSAN_OPTIONS="print_stacktrace=1")
