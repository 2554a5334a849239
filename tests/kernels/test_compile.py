"""How functions are compiled: kept on disk, anew after an edit; bodies by type; arrays that are borrowed or stacked."""

from __future__ import annotations

import gc
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from helpers.loop import S_HAT, noises, run
from numba.core.errors import NumbaError

from kfopc_filterpy import FxLMS, OutputLimiter, kf_opc, kf_pb
from kfopc_filterpy.controllers.step import adapt_entry, emit_entry, listen
from kfopc_filterpy.kernels.borrowing import borrowed
from kfopc_filterpy.kernels.compiling import CONFIG, by_type, compiled, inlined, part
from kfopc_filterpy.kernels.delay_lines import delay_line, newest
from kfopc_filterpy.kernels.holding import Held, for_states, state_at, store
from kfopc_filterpy.kernels.records import new_record

PACKAGE = Path(__file__).resolve().parents[2] / "kfopc_filterpy"
ANNOUNCED = "kfopc_filterpy: compiling, once; the first runs take some seconds longer\n"


# ---- What is compiled is kept on disk

STEPS = '''"""A choice by type, and its bodies, in a file of their own."""

from typing import NamedTuple

import numpy as np

from .compiling import by_type
from .vectors import dot


class Sum(NamedTuple):
    values: np.ndarray


class Energy(NamedTuple):
    values: np.ndarray


@by_type
def figure(state):
    """Return what the type of the state asks for."""
    return np.nan


@figure.register(Sum)
def figure_sum(state):
    """Return the sum."""
    return np.sum(state.values)


@figure.register(Energy)
def figure_energy(state):
    """Return the sum of squares."""
    return 1.0 * dot(state.values, state.values)
'''

LOOP = '''"""What Python calls."""

from .compiling import compiled
from .steps import figure


@compiled()
def figure_of(state):
    """Call `figure`."""
    return figure(state)
'''

PROGRAM = """
import numpy as np
from kfopc_filterpy.kernels.loop import figure_of
from kfopc_filterpy.kernels.steps import Energy, Sum

values = 3.0 * np.ones(2)
print(figure_of(Sum(values)), figure_of(Energy(values)), sum(figure_of.stats.cache_hits.values()))
"""


class Copy:
    """A copy of the package with two small modules more, to be edited and run in processes of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.package = folder, folder / PACKAGE.name
        shutil.copytree(PACKAGE, self.package, ignore=shutil.ignore_patterns("__pycache__"))
        (self.package / "kernels" / "steps.py").write_text(STEPS)
        (self.package / "kernels" / "loop.py").write_text(LOOP)

    def edit(self, path: str, old: str, new: str) -> None:
        text = (self.package / path).read_text()
        assert old in text
        (self.package / path).write_text(text.replace(old, new))

    def run(self, program: str = PROGRAM, **environment: str) -> tuple[list[str], str]:
        """The words that a process prints, and what it says on stderr."""
        kept = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "NUMBA_DISABLE_JIT")}
        done = subprocess.run(
            [sys.executable, "-c", program],
            cwd=self.folder,
            env=kept | {"PYTHONPATH": str(self.folder)} | environment,
            check=True,
            capture_output=True,
            text=True,
        )
        return done.stdout.split(), done.stderr

    def compiled_files(self) -> list[Path]:
        """Files of compiled code beside the sources."""
        return sorted(self.package.rglob("*.nb[ic]"))


@pytest.fixture
def package(tmp_path: Path) -> Copy:
    return Copy(tmp_path)


def test_processes_share_what_one_compiled_and_hear_of_it_once(package: Copy) -> None:
    """Bodies chosen by type among it."""
    assert package.run() == (["6.0", "18.0", "0"], ANNOUNCED)
    assert package.run() == (["6.0", "18.0", "2"], "")


@pytest.mark.parametrize(
    ("path", "old", "new", "result"),
    [
        ("kernels/vectors.py", "total += a[i] * b[i]", "total += 5.0 * a[i] * b[i]", "90.0"),
        ("kernels/steps.py", "return 1.0 * dot", "return 7.0 * dot", "126.0"),
    ],
    ids=["a kernel", "a body chosen by type"],
)
def test_an_edit_of_any_file_compiles_anew(package: Copy, path: str, old: str, new: str, result: str) -> None:
    """numba itself would look only at the file of the function that Python calls."""
    package.run()
    package.edit(path, old, new)
    assert package.run() == (["6.0", result, "0"], ANNOUNCED)
    package.edit(path, new, old)
    assert package.run() == (["6.0", "18.0", "2"], "")  # what was compiled for these sources is still there


def test_the_users_cache_folder_is_respected(package: Copy, tmp_path: Path) -> None:
    chosen = tmp_path / "chosen"
    for hits, said in (("0", ANNOUNCED), ("2", "")):
        assert package.run(NUMBA_CACHE_DIR=str(chosen)) == (["6.0", "18.0", hits], said)
    assert list(chosen.rglob("*.nbc"))
    assert package.compiled_files() == []
    before = sorted(chosen.rglob("*"))
    own = "from numba import config, njit\nimport kfopc_filterpy.kernels.loop\n"
    own += "print(config.CACHE_DIR)"  # for the user's own functions it is as it was
    assert package.run(own, NUMBA_CACHE_DIR=str(chosen))[0] == [str(chosen)]
    assert sorted(chosen.rglob("*")) == before


def test_where_nothing_can_be_written_it_runs_all_the_same(package: Copy) -> None:
    """Neither beside the sources nor in the user's folder, each of which is a file here."""
    shutil.rmtree(package.package / "__pycache__", ignore_errors=True)
    (package.package / "__pycache__").write_text("")
    (package.folder / "no folder").write_text("")
    unwritable = {"XDG_CACHE_HOME": str(package.folder / "no folder"), "PYTHONDONTWRITEBYTECODE": "1"}
    elsewhere = {"XDG_CACHE_HOME": str(package.folder / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    if sys.platform.startswith("linux"):
        assert package.run(**elsewhere) == (["6.0", "18.0", "0"], ANNOUNCED)
        assert package.run(**elsewhere) == (["6.0", "18.0", "2"], "")
    assert package.run(**unwritable, HOME=str(package.folder / "no folder"))[0][:2] == ["6.0", "18.0"]


# ---- Bodies chosen by type


class Plain(NamedTuple):
    """A state of no body of its own."""

    values: np.ndarray


class Doubled(NamedTuple):
    """Another."""

    values: np.ndarray
    factor: float


@by_type
def first_value(state, offset):
    """Return the first value and the offset."""
    return state.values[0] + offset


@first_value.register(Doubled)
def first_doubled(state, offset):
    """Return the first value times the factor, and the offset."""
    return state.factor * state.values[0] + offset


@compiled(cache=False)
def first_of(state, offset):
    """Call `first_value` from compiled code."""
    return first_value(state, offset)


@inlined
def first_of_inlined(state, offset):
    """Call it from a function that is inlined."""
    return first_value(state, offset)


@compiled(cache=False)
def first_within(state, offset):
    """Call that."""
    return first_of_inlined(state, offset=offset)


@pytest.mark.parametrize("call", [first_value, first_of, first_within])
def test_the_type_chooses_the_body_in_python_and_compiled(call: Any) -> None:
    values = np.array([2.0, 5.0])
    assert call(Plain(values), 1.0) == 3.0
    assert call(Doubled(values, 10.0), 1.0) == 21.0


@part()
def half_of(state):
    """A part of `halved`; what runs in Python is seen by the kind of its result."""
    return state.values.sum() / 2


@compiled(cache=False)
def halved(state):
    """Call it from compiled code."""
    return half_of(state)


def test_a_part_is_compiled_for_compiled_callers_and_stays_python_in_python() -> None:
    """A result of numpy's own type comes from Python only."""
    state = Plain(np.array([2.0, 5.0]))
    assert halved(state) == half_of(state) == 3.5
    assert type(half_of(state)) is np.float64
    assert type(halved(state)) is float


def test_a_body_can_be_added_after_others_were_compiled() -> None:
    class Late(NamedTuple):
        values: np.ndarray

    values = np.array([2.0])
    first_of(Plain(values), 0.0)

    @first_value.register(Late)
    def first_late(state, offset):
        return -state.values[0] - offset

    assert first_value(Late(values), 1.0) == first_of(Late(values), 1.0) == -3.0
    assert first_of(Plain(values), 1.0) == 3.0


def test_division_by_zero_is_numpys() -> None:
    """Inf or NaN, which callers look for, and no exception: in every kind of compiled function."""

    @inlined
    def ratio_inlined(a, b):
        return a / b

    @part()
    def ratio(a, b):
        return ratio_inlined(a, b)

    @compiled(cache=False)
    def called(a, b):
        return ratio(a, b)

    assert called(1.0, 0.0) == np.inf
    assert np.isnan(called(0.0, 0.0))


# ---- Arrays that are borrowed


class Inner(NamedTuple):
    """A part of a state."""

    numbers: np.ndarray
    nothing: None


class Outer(NamedTuple):
    """A state of arrays of several kinds."""

    values: np.ndarray
    single: np.ndarray
    square: np.ndarray
    inner: Inner
    factor: float


def outer() -> Outer:
    inner = Inner(new_record(total=0.0, count=0), None)
    return Outer(np.arange(4.0), np.ones(2, np.float32), np.arange(6.0).reshape(2, 3), inner, 3.0)


@compiled(cache=False)
def spend(state):
    """Read and write every array of a borrowed state."""
    state = borrowed(state)
    numbers = state.inner.numbers[0]
    for i in range(state.values.size):
        state.values[i] *= state.factor
        numbers.total += state.values[i]
    numbers.count += 1
    state.single[1] = 0.5
    state.square[1, 2] = state.square[0, 1]
    return numbers.total


@compiled(cache=False)
def spend_what_fails(state):
    """Leave in the middle."""
    state = borrowed(state)
    state.values[0] = -1.0
    if state.square.shape[0] == 2:
        raise ValueError("in the middle")
    return state.values[0]


def arrays_of(value: Any) -> Iterator[np.ndarray]:
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, tuple):
        for item in value:
            yield from arrays_of(item)


def test_what_is_borrowed_is_the_array_itself() -> None:
    state = outer()
    assert spend(state) == 18.0
    np.testing.assert_array_equal(state.values, [0.0, 3.0, 6.0, 9.0])
    np.testing.assert_array_equal(state.single, np.array([1.0, 0.5], np.float32))
    np.testing.assert_array_equal(state.square, [[0.0, 1.0, 2.0], [3.0, 4.0, 1.0]])
    assert state.inner.numbers.item() == (18.0, 1)
    assert borrowed(state) is state  # in Python there is nothing to do


def test_borrowed_arrays_keep_their_references() -> None:
    """What Python holds before a call of compiled code it holds after, no more, no less; also where the call fails."""
    state = outer()
    held = list(arrays_of(state))
    counts = [sys.getrefcount(array) for array in held]
    for _ in range(100):
        spend(state)
        with pytest.raises(ValueError, match="in the middle"):
            spend_what_fails(state)
    assert [sys.getrefcount(array) for array in held] == counts
    assert newest(delay_line(3), 2).size == 2  # a view, made in Python


@pytest.mark.parametrize("name", ["KF-PB", "KF-PB, no limiter"])
def test_runs_keep_the_references_of_a_controllers_arrays(name: str) -> None:
    made = made_for_8_khz(name)
    x, d, _ = noises(60)
    run(made, n=60)
    run(made, n=60, compiled=False)  # what is made once is there
    held = list(arrays_of(made._state))
    gc.collect()  # a reference from garbage must not go away meanwhile
    counts = [sys.getrefcount(array) for array in held]
    for _ in range(5):
        run(made, n=60)
        run(made, n=60, compiled=False)
        made.listen(x, d)
        with pytest.raises(ValueError, match="finite square"):
            made.update(1e200)
    gc.collect()
    assert [a is b for a, b in zip(arrays_of(made._state), held, strict=True)] == [True] * len(held)
    assert [sys.getrefcount(array) for array in held] == counts


def test_an_array_with_gaps_is_not_read_as_one_without() -> None:
    """A pointer and a shape say nothing of strides: such an array is refused, or read as it is."""

    @compiled(cache=False)
    def second(state):
        return borrowed(state).values[1]

    assert second(Plain(np.arange(6.0))) == 1.0
    try:
        read = second(Plain(np.arange(6.0)[::2]))
    except (NumbaError, ValueError):
        return
    assert read == 2.0


def made_for_8_khz(name: str) -> Any:
    """A controller with a limiter unless the name says otherwise, for the runs of `helpers.loop`."""
    kind, free, _ = name.partition(", no limiter")
    limiter = None if free else OutputLimiter(0.1, fs=8000.0, window_s=0.01)
    kalman: dict[str, Any] = {"state_noise": 1e-5, "measurement_noise": 1e-2, "rated_power": 0.2, "limiter": limiter}
    made: Any = (
        FxLMS(4, S_HAT, step_size=0.01, limiter=limiter)
        if kind == "FxLMS"
        else {"KF-OPC": kf_opc, "KF-PB": kf_pb}[kind](4, S_HAT, **kalman)
    )
    made.constraint.fs = 8000.0
    if kind == "KF-PB":
        made.estimator.budget.fs = 8000.0
    return made


# ---- States that are held


@for_states()
def spend_held(key):
    def spend_at(address, factor):
        return factor * spend(state_at(address, key))

    return spend_at


def test_a_held_state_is_the_state_itself() -> None:
    state = outer()
    assert spend_held(Held(state), 2.0) == 36.0
    assert state.inner.numbers.item() == (18.0, 1)
    np.testing.assert_array_equal(state.values, [0.0, 3.0, 6.0, 9.0])


def test_each_type_has_a_file_of_its_own_in_the_cache() -> None:
    """In a common one, processes that compile for two types at one time could exchange their code."""
    held = [Held(made_for_8_khz(name)._state) for name in ("KF-PB", "KF-PB, no limiter")]
    for entry in (emit_entry, adapt_entry, listen):
        names = {entry._make(one.key).__qualname__ for one in held}
        compiled_names = {entry.of(one).__qualname__ for one in held}
        assert len(names) == 1
        assert len(compiled_names) == 2
    assert len({emit_entry.of(one).native_name for one in held}) == 2


def test_what_holds_a_users_type_is_not_kept_on_disk() -> None:
    class Own(NamedTuple):
        values: np.ndarray

    state = made_for_8_khz("KF-PB")._state
    assert Held(state).ours
    assert not Held(state._replace(lines=state.lines._replace(limiter=Own(np.zeros(3))))).ours


def test_a_state_is_not_written_where_another_type_is_held() -> None:
    """Its memory may be too small."""
    held = Held(outer())
    key = held.key

    @compiled(cache=False)
    def overwrite(state, address):
        store(state, address, key)

    fitting = outer()._replace(factor=2.0)  # named, because its arrays are borrowed
    overwrite(fitting, held.address)
    assert spend_held(held, 1.0) == 24.0 / 2.0
    with pytest.raises(NumbaError, match="the address is for a state of the type"):
        overwrite(Plain(np.arange(6.0)), held.address)


def test_without_the_compiler_nothing_is_held(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CONFIG, "DISABLE_JIT", 1)
    with pytest.raises(RuntimeError, match="unset NUMBA_DISABLE_JIT"):
        Held(outer())


def test_held_arrays_are_given_back() -> None:
    state = outer()
    arrays = list(arrays_of(state))
    counts = [sys.getrefcount(array) for array in arrays]
    held = Held(state)
    for _ in range(100):
        spend_held(held, 1.0)
    del held
    assert [sys.getrefcount(array) for array in arrays] == counts


@pytest.mark.parametrize(
    "copied", [deepcopy, lambda made: pickle.loads(pickle.dumps(made))], ids=["deepcopy", "pickle"]
)
@pytest.mark.parametrize("name", ["FxLMS", "KF-OPC", "KF-PB"])
def test_a_copied_controller_steps_on_its_own(name: str, copied: Any) -> None:
    """What is held of the original must not be stepped by the copy, nor the other way round."""
    made = made_for_8_khz(name)
    run(made, n=60, compiled=False)
    copy, weights = copied(made), made.weights
    run(copy, n=60, compiled=False)
    assert np.any(copy.weights != weights)
    np.testing.assert_array_equal(made.weights, weights)
    run(made, n=60, compiled=False)
    np.testing.assert_array_equal(made.weights, copy.weights)
