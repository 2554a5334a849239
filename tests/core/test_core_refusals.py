"""Plans of any kind are refused or stay within their bytes, and a refused step changes nothing."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.core import ALGORITHMS, c_compiler, known, program, ran
from hypothesis import example, given, settings
from hypothesis import strategies as st

from kfopc_filterpy import OutputLimiter
from kfopc_filterpy.core import building
from kfopc_filterpy.core.block import Algorithm, Block, Shape, _plan_of
from kfopc_filterpy.core.calls import limit

ANY_NUMBER = st.one_of(
    st.sampled_from(
        [0.0, -0.0, 1.0, -1.0, 1e-310, 1e-30, 1e30, 1e100, 1e155, 1.7e308, -1.7e308, np.nan, np.inf, -np.inf]
    ),
    st.floats(),
)
COUNT = st.integers(1, 4)
ODD_COUNT = st.one_of(COUNT, st.sampled_from([0, -1, 2**31 - 1, 2**31, 2**32 + 1, -(2**31)]))
TAPS = st.integers(1, 70)
GUARDED = Shape(1, 2, 1, 8, 3, guard_taps=2)


def at_times(draw: st.DrawFn, one_in: int) -> bool:
    return draw(st.integers(1, one_in)) == 1


@st.composite
def plans(draw: st.DrawFn) -> tuple[str, Shape, dict[str, Any]]:
    """Return an algorithm, a shape and the arguments of a block, at times with something odd."""
    count = ODD_COUNT if at_times(draw, 5) else COUNT
    name, K, J, references = draw(st.sampled_from(known())), draw(COUNT), draw(COUNT), draw(count)
    taps, path_taps = draw(TAPS if count is COUNT else count), draw(TAPS)
    guard_taps = draw(st.sampled_from([0, 1, 5, 48])) + 50 * at_times(draw, 10)
    windows = [
        tuple(draw(st.lists(st.integers(least, 40), min_size=J, max_size=J))) if draw(st.booleans()) else ()
        for least in (0, 1)
    ]
    if at_times(draw, 5):
        windows[draw(st.integers(0, 1))] = draw(st.tuples(st.sampled_from([-1, 0, 1, 2**28, 2**31 - 1])))
    shape = Shape(K, J, references, taps, path_taps, guard_taps, *windows)
    rng = np.random.default_rng(draw(st.integers(0, 9)))
    path, guard = rng.standard_normal((K, J, path_taps)), rng.standard_normal(shape.guard_taps)
    values: dict[str, Any] = dict(ALGORITHMS[name])
    changed = draw(st.sampled_from(["", "path", "guard", *values]))
    if changed == "path":
        path.flat[draw(st.integers(0, path.size - 1))] = draw(ANY_NUMBER)
    elif changed == "guard" and guard.size:
        guard[-1] = draw(ANY_NUMBER)
    elif changed in values:
        values[changed] = draw(ANY_NUMBER)
    return name, shape, {"path": path, "guard": guard, "settings": values}


@given(plan=plans(), fill=st.booleans())
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


@pytest.mark.parametrize(
    ("shape", "name", "most"),
    [
        ({}, "guard_taps", 48),
        ({}, "taps", 33_554_316),  # (I + KJ) (4 (L + M) + 448) is at most 2^28
        ({"microphones": 2}, "taps", 22_369_505),
        ({"microphones": 16, "loudspeakers": 16}, "taps", 261_007),
        ({"microphones": 16, "loudspeakers": 16, "references": 16}, "taps", 16_320),  # KJI (4 L + 256)
        ({"scenarios": 2**11, "loudspeakers": 2, "references": 2}, "taps", 2**15),  # SJIL
        ({"scenarios": 2**20}, "microphones", 2**8),  # SK
        ({"microphones": 2**8}, "scenarios", 2**20),
        ({"scenarios": 2**19, "loudspeakers": 2}, "path_taps", 48),  # SJ (4 M + 64)
        ({"loudspeakers": 2, "limiter_windows": (1, 1)}, "power_windows", 44_739_242),  # 3 SJN
        ({"loudspeakers": 2, "power_windows": (0, 0)}, "limiter_windows", 44_739_242),
        ({"scenarios": 1, "microphones": 1, "modelled": 1}, "scenarios", 1),
        ({"references": 2, "modelled": 1}, "microphones", 2),
    ],
)
def test_the_largest_shape_is_taken_and_no_larger_or_empty_one(shape: dict[str, Any], name: str, most: int) -> None:
    plain = {"microphones": 1, "loudspeakers": 1, "references": 1, "taps": 8, "path_taps": 4} | shape
    least = 0 if name in ("guard_taps", "power_windows") else 1
    for number in (least - 1, least, most, most + 1):
        values = [(number, least), (least, number)] if name.endswith("windows") else [number]
        for value in values:
            assert bool(Algorithm("fxlms").shapes(Shape(**plain | {name: value}))) == (least <= number <= most)


def test_a_block_with_more_errors_than_an_int32_counts_is_refused() -> None:
    settings = {**ALGORITHMS["power_budget"], "block": 65_536.0}
    with pytest.raises(ValueError, match="a controller of this size cannot be made"):
        Block(Algorithm("power_budget"), Shape(5000, 1, 1, 1, 1), path=np.ones(5000), settings=settings)


def test_settings_are_in_the_order_of_the_c_file() -> None:
    for name in known():
        assert [one.name for one in Algorithm(name).settings] == list(ALGORITHMS[name])


def test_a_setting_without_an_upper_limit_may_be_large() -> None:
    limited = {"modified", "fading", "block", "averaging", "window", "memory", "spread"}

    def block(name: str, **changed: float) -> Block:
        return Block(Algorithm(name), Shape(1, 1, 1, 8, 1), path=np.ones(1), settings={**ALGORITHMS[name], **changed})

    for name, own in ALGORITHMS.items():
        for setting in own.keys() - limited:
            block(name, **{setting: 1e6})
    for name in ("mov", "mov_fixed"):
        with pytest.raises(ValueError, match="modified"):
            block(name, modified=2.0)


def opened(plan: Mapping[str, Any], size: int, *, begin: int = 0, shape: Shape = GUARDED) -> bool:
    """Return whether `anc_open` makes FxLMS of a plan's arrays in `size` bytes."""
    algorithm, view = Algorithm("fxlms"), (ctypes.c_void_p * 512)()  # more than a view has
    memory = np.full(size // 8 + 2, np.nan)
    arrays = {name: np.array(values, float) for name, values in plan.items()}
    described = algorithm.pointer, ctypes.byref(_plan_of(shape, arrays))
    return bool(algorithm.library.held.anc_open(*described, view, memory.ctypes.data + begin, size, True))


def test_a_host_in_c_gets_no_controller_for_a_plan_or_memory_that_is_not_whole() -> None:
    """NULL for what is needed, a number that is none at any place, too few bytes, or memory that begins within a real."""
    whole: dict[str, list[float]] = {"path": [0.0, 1.0, 0.5, 0.3, -0.2, 0.1], "guard": [1.0, 0.1], "settings": [0.01]}
    size = Block(
        Algorithm("fxlms"), GUARDED, path=np.ones(6), guard=np.ones(2), settings={"step_size": 1.0}
    ).memory.size
    assert opened(whole, size)
    for name, values in whole.items():
        assert not opened(whole | {name: []}, size), name
        for place in range(len(values)):
            for bad in (np.nan, np.inf, -np.inf):
                assert not opened(whole | {name: [*values[:place], bad, *values[place + 1 :]]}, size), (
                    name,
                    place,
                    bad,
                )
    assert not opened(whole, size - 1)
    for begin in range(1, 8):
        assert not opened(whole, size, begin=begin)
    assert not opened(whole, size, shape=replace(GUARDED, taps=0))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_limiter_in_c_answers_nan_to_what_is_not_finite_and_keeps_its_state(bad: float) -> None:
    limiter = OutputLimiter(0.1, fs=100.0, window_s=0.1)
    limiter.process(np.linspace(-2.0, 2.0, 25))
    before = [array.copy() for array in limiter.state]
    assert np.isnan(limit(limiter.state.numbers.ctypes.data, limiter.state.laps.ctypes.data, bad))
    for array, own in zip(limiter.state, before, strict=True):
        np.testing.assert_array_equal(array, own)
