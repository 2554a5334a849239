"""Checkpoints: what a file may be, what is refused, and that a save is all or nothing."""

from __future__ import annotations

import hashlib
import io
import os
import pickletools
import struct
import subprocess
import sys
import threading
import time
import tracemalloc
from collections import Counter, deque
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from filterpy.common import inv_diagonal
from helpers.checkpoints import assert_same_contents, forge, pickle_of, sealed
from helpers.naming import plain

import kfopc_filterpy
from kfopc_filterpy import KFOPC
from kfopc_filterpy.core.block import Algorithm

ROOT = Path(__file__).resolve().parents[1]
GENERATORS = ("MT19937", "PCG64", "PCG64DXSM", "Philox", "SFC64")


def new_filter(n: int = 3) -> KFOPC:
    kf = KFOPC(n, rated_power=0.5)
    kf.predict()
    kf.update(1.0, H=np.ones(n), reference=1.0)
    return kf


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    """The file of a filter."""
    path = tmp_path / "run.kfopc"
    new_filter().save(path)
    return path


# What a file holds.


def test_a_file_has_a_first_line_a_pickle_arrays_at_cache_lines_and_a_checksum(saved: Path) -> None:
    content = saved.read_bytes()
    first = content.partition(b"\n")[0].decode()
    series = ".".join(kfopc_filterpy.__version__.split(".")[:2])
    begins, _, size = first.rpartition(" ")
    assert begins == f"kfopc checkpoint 3 of kfopc_filterpy {series}:"
    assert hashlib.sha256(content[:-64]).hexdigest() == content[-64:].decode()
    arrays = len(first) + 1 + int(size)
    arrays += -arrays % 64
    assert new_filter().x.tobytes() in [content[at : at + 24] for at in range(arrays, len(content) - 64, 64)]
    pickletools.dis(pickle_of(saved), io.StringIO())  # a tool of Python's reads it, and calls nothing


def test_every_kind_of_value_comes_back_as_it_was(tmp_path: Path) -> None:
    kf = KFOPC(2)
    base = np.arange(24.0).reshape(4, 6)
    record = np.zeros(2, np.dtype([("a", np.int8), ("b", np.float64)], align=True))
    values = {
        "numbers": [0, -(10**40), True, False, None, 0.1, -0.0, np.inf, -np.inf, "text", "ünï\n", 5e-324, "x" * 300],
        "scalars": [np.float32(0.1), np.int16(-3), np.bool_(True), np.complex128(1 + 2j), record[0], np.str_("a")],
        "arrays": [base, base[1:, ::2], base.T, base[::-1], np.empty((3, 0)), np.array(3.0), record, base > 3],
        "more arrays": [np.broadcast_to(base[0], (5, 6)), np.asfortranarray(base), np.array(["a", "bcd"])],
        "objects": np.array([[None], [base]], dtype=object),
        "others": (1, [2, deque([3, (4,)], maxlen=5)], deque(), {("a", 1): {"b": base[0]}, 2: 3}, Counter("abca")),
        "long": [list(range(3000)), {str(n): n for n in range(3000)}, tuple(range(300))],
        "inverses": [np.linalg.pinv, np.linalg.inv, inv_diagonal],
        "generators": [np.random.Generator(getattr(np.random, name)(4)) for name in GENERATORS],
    }
    values["cycle"] = [values["others"]]
    values["cycle"].append(values["cycle"])
    vars(kf).update(values)
    kf.generators[0].standard_normal(3)
    kf.save(tmp_path / "filter.kfopc")
    loaded = KFOPC.load(tmp_path / "filter.kfopc")
    assert_same_contents(loaded, kf)
    for array in loaded.arrays:
        assert array.ctypes.data % 64 == 0 or not array.size
        assert array.flags.aligned
        assert array.flags.writeable
    assert loaded.arrays[6].dtype.isalignedstruct
    assert vars(loaded)["more arrays"][1].flags.f_contiguous
    assert loaded.others[1][1].maxlen == 5
    assert loaded.inverses == kf.inverses


def test_an_array_that_is_held_twice_is_one_and_a_view_is_an_array_of_its_own(tmp_path: Path) -> None:
    kf, base = KFOPC(2), np.zeros((4, 6))
    kf.whole, kf.again, kf.part = base, base, base[1:3]
    kf.save(tmp_path / "filter.kfopc")
    loaded = KFOPC.load(tmp_path / "filter.kfopc")
    assert loaded.again is loaded.whole
    loaded.whole[:] = 1.0  # an array of a file can be written into
    assert not np.any(loaded.part)
    assert not np.shares_memory(loaded.whole, loaded.x)


def test_memory_that_belongs_to_no_saved_array_is_not_written(tmp_path: Path) -> None:
    kf = KFOPC(2)
    secret = np.frombuffer(bytearray(b"a secret" * 8), dtype=np.float64)
    kf.column = secret.reshape(4, 2)[:, 1]
    kf.column[:] = 0.0
    kf.save(tmp_path / "filter.kfopc")
    assert b"secret" not in (tmp_path / "filter.kfopc").read_bytes()


class Inside(NamedTuple):
    """A user's state."""

    value: Any


class Odd:
    """An object that says itself how it is copied."""

    def __reduce__(self) -> Any:
        return print, ("executed",)


ITSELF: Any = ([],)  # a tuple that contains itself
ITSELF[0].append(ITSELF)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (lambda: None, r"KFOPC\.own cannot be saved.* <lambda>"),
        ({"key": [sys.stdout]}, r"KFOPC\.own cannot be saved.*File|TextIO"),
        ((1, threading.Lock()), r"KFOPC\.own cannot be saved.*lock"),
        (Inside(Odd()), r"KFOPC\.own cannot be saved"),
        (new_filter().predict, r"KFOPC\.own cannot be saved.*predict"),
        (np.ma.masked_array([1.0], [True]), r"KFOPC\.own cannot be saved"),
        (np.random.RandomState(1), r"KFOPC\.own cannot be saved"),
        ([].append, r"KFOPC\.own cannot be saved.*append"),
        (np.zeros(2, [("a", [("b", "f8")])]), r"KFOPC\.own cannot be saved.* an array of"),
        (np.zeros(2, [("a", "O")]), r"KFOPC\.own cannot be saved.* an array of"),
        (ITSELF, r"KFOPC\.own cannot be saved"),
        ({1, 2}, r"KFOPC\.own cannot be saved.*EMPTY_SET"),
        (b"bytes", r"KFOPC\.own cannot be saved.*BINBYTES"),
        ({np.int64(1): 2}, r"KFOPC\.own cannot be saved.* a key that is no number"),
        (Algorithm("fxlms"), r"KFOPC\.own cannot be saved.*Algorithm says itself how it is copied"),
    ],
    ids=lambda value: plain(value) if isinstance(value, str) else "",
)
def test_what_cannot_be_saved_is_named_and_nothing_is_written(value: Any, message: str, saved: Path) -> None:
    kf, before = new_filter(), saved.read_bytes()
    kf.own = value
    with pytest.raises(TypeError, match=message):
        kf.save(saved)
    assert saved.read_bytes() == before
    assert os.listdir(saved.parent) == ["run.kfopc"]


# What is refused.


def test_a_damaged_byte_is_found_wherever_it_is(saved: Path) -> None:
    content, rng = saved.read_bytes(), np.random.default_rng(0)
    for at in {*range(100), *range(100, len(content), 13), *range(len(content) - 70, len(content))}:
        damaged = bytearray(content)
        damaged[at] ^= int(rng.integers(1, 256))
        saved.write_bytes(damaged)
        with pytest.raises(ValueError, match="damaged"):
            KFOPC.load(saved)


def test_a_file_that_is_cut_short_or_longer_is_refused(saved: Path) -> None:
    content = saved.read_bytes()
    cuts = {*range(1, 100), *range(100, len(content), 31), *range(len(content) - 70, len(content))}
    for left in (*(content[:size] for size in cuts), content + b"\n"):
        saved.write_bytes(left)
        with pytest.raises(ValueError, match="damaged"):
            KFOPC.load(saved)


def test_a_missing_an_empty_and_another_file_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.kfopc"
    with pytest.raises(FileNotFoundError, match=r"there is no file .*run\.kfopc: look for it, or begin anew"):
        KFOPC.load(path)
    path.write_bytes(b"")
    with pytest.raises(ValueError, match=r"run\.kfopc is empty: nothing was saved in it"):
        KFOPC.load(path)
    np.save(tmp_path / "array.npy", np.zeros(100))
    with pytest.raises(ValueError, match=r"array\.npy is no checkpoint, or its first bytes are damaged"):
        KFOPC.load(tmp_path / "array.npy")
    with pytest.raises(IsADirectoryError):
        KFOPC.load(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"the folder .*nowhere does not exist: make it first"):
        new_filter().save(tmp_path / "nowhere" / "run.kfopc")


def test_another_class_is_refused_with_the_name_of_its_own(tmp_path: Path) -> None:
    KFOPC.random_walk(3, state_noise=0.0, measurement_noise=1.0).save(tmp_path / "run.kfopc")
    assert type(KFOPC.load(tmp_path / "run.kfopc")).__name__ == "RandomWalkKFOPC"  # is derived from it
    with pytest.raises(TypeError, match=r"has a RandomWalkKFOPC, which is no FxLMS: call RandomWalkKFOPC\.load"):
        kfopc_filterpy.FxLMS.load(tmp_path / "run.kfopc")


def test_another_format_is_refused_and_another_version_if_its_series_differs(saved: Path) -> None:
    content, old = saved.read_bytes()[:-64], saved.with_name("old.kfopc")
    series = ".".join(kfopc_filterpy.__version__.split(".")[:2])
    _, _, rest = content.partition(b": ")
    reads = (
        rf"and this version reads 'kfopc checkpoint 3 of kfopc_filterpy {series}' only: load the file with the version"
    )
    with pytest.raises(ValueError, match=rf"old.kfopc is a 'kfopc checkpoint 1', {reads}"):
        KFOPC.load(sealed(old, b'kfopc checkpoint 1 17\n{"package":"1.0"}\n'))
    for begins in ("checkpoint 2 of kfopc_filterpy " + series, "checkpoint 3 of kfopc_filterpy 1.9", "checkpoint 3"):
        with pytest.raises(ValueError, match=rf"is a 'kfopc {begins}', {reads}"):
            KFOPC.load(sealed(old, f"kfopc {begins}: ".encode() + rest))
    for begins in (b"\xff\xfe", b"", b"\n"):
        with pytest.raises(ValueError, match=reads):
            KFOPC.load(sealed(old, b"kfopc checkpoint " + begins + rest))
    assert_same_contents(KFOPC.load(sealed(old, content)), KFOPC.load(saved))


# Files with a right checksum that somebody else might have written.


def named(name: str) -> bytes:
    """Return the instructions that name a thing, as protocol 4 does it."""
    module, _, own = name.partition(":")
    return text(module) + text(own) + b"\x93"


def text(word: str) -> bytes:
    return b"X" + struct.pack("<I", len(word.encode())) + word.encode()


def called(name: str, *arguments: bytes) -> bytes:
    """Return the instructions that call a thing with arguments."""
    return named(name) + b"(" + b"".join(arguments) + b"tR"


def array(shape: bytes, kind: bytes, place: bytes) -> bytes:
    """Return the instructions that make an array of a place in the file."""
    return called(ARRAY, shape + b"\x85", kind, b"\x89", text("C"), place, b"\x89")


ARRAY, ONE, F8 = "numpy:ndarray", b"K\x01", text("<f8") + b"\x85"
GENERATOR = f"{np.random.Generator.__module__}:Generator"
FILTER = named("kfopc_filterpy.filters.kfopc:KFOPC") + b")\x81"
CLASS = "kfopc_filterpy.power.limiter"
HUGE = b"\x8a\x06" + (10**12).to_bytes(6, "little")
FORGED: dict[str, tuple[bytes, str]] = {
    "a process": (called("os:system", text("touch {trace}")), "names os.system, which is none of"),
    "a process, protocol 0": (b"cos\nsystem\n(S'touch {trace}'\ntR.", "the instruction GLOBAL"),
    "a process, inst": (b"(S'touch {trace}'\nios\nsystem\n.", "the instruction STRING"),
    "code": (called("builtins:eval", text("open('{trace}', 'w')")), "names builtins.eval"),
    "a dotted name": (called("kfopc_filterpy.checkpoint:os.system", text("touch {trace}")), "os.system, which is none"),
    "a library": (called("kfopc_filterpy.core.block:Algorithm", text("{trace}")), "says itself how it is copied"),
    "a function of the package": (called("kfopc_filterpy.core.library:load", text("double")), "none of"),
    "a module that is not there": (called("kfopc_filterpy.power.nothing:A"), "ModuleNotFoundError"),
    "a constructor": (called(f"{CLASS}:OutputLimiter", text("1")), "OutputLimiter has other fields"),
    "a call of a function that can be named": (called("numpy.linalg:inv", b"]"), "something is made of other parts"),
    "attributes of a class": (named(f"{CLASS}:OutputLimiter") + b"}" + text("a") + b"K\x01sb", "correct checksum"),
    "items of an object": (FILTER + b"K\x01a", "TypeError"),
    "a key that is an object": (b"}" + FILTER + b"K\x01s", "a key that is no number"),
    "a key with many parts": (b"}" + b")" + b"\x85" * 10**5 + b"K\x01s", "a key that is no number"),
    "too few fields": (named(f"{CLASS}:LimiterState") + b")\x81", "LimiterState has other fields"),
    "a huge array": (array(HUGE, F8, b"K\x00"), "buffer is too small"),
    "an array beyond the end": (array(ONE, F8, HUGE), "correct checksum"),
    "an array before the begin": (array(ONE, F8, b"J\xf8\xff\xff\xff"), "correct checksum"),
    "pointers": (array(ONE, text("|O") + b"\x85", b"K\x00"), "an array of object"),
    "hidden pointers": (array(ONE, text("a") + text("f8,O") + b"\x86", b"K\x00"), "an array of"),
    "a huge buffer": (b"\x96" + (2**60).to_bytes(8, "little") + b"abc.", "correct checksum"),
    "a huge memo": (b"Nr\xff\xff\xff\xff", "the instruction LONG_BINPUT"),
    "a place in the memo": (b"j\xff\xff\xff\xff", "IndexError"),
    "another generator": (
        called(GENERATOR, b"}" + text("bit_generator") + text("RandomState") + b"s"),
        "correct checksum",
    ),
    "a persistent name": (b"Pname\n.", "the instruction PERSID"),
    "nothing": (b"", "correct checksum"),
    "no pickle": (b"\xff\xff\xff", "correct checksum"),
}


@pytest.mark.parametrize("name", FORGED)
def test_a_file_that_save_did_not_write_is_refused_and_runs_nothing(name: str, saved: Path) -> None:
    program, message = FORGED[name]
    trace = str(saved.with_name("trace"))
    for word in ("touch {trace}", "open('{trace}', 'w')", "{trace}"):  # with the lengths that belong to them
        program = program.replace(text(word), text(word.format(trace=trace)))
    program = program.replace(b"{trace}", trace.encode())
    KFOPC.load(saved)
    before = set(sys.modules)
    as_a_field = FILTER + b"}" + text("own") + program.removesuffix(b".") + b"sb."
    for whole, says in ((program + b".", message), (as_a_field, "")):
        tracemalloc.start()
        with pytest.raises(ValueError, match=r"has a correct checksum, but|kfopc names ") as refused:
            KFOPC.load(forge(saved, b"\x80\x05" + whole))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert says in str(refused.value)
        assert peak < 50_000_000
    assert not os.path.exists(trace)
    assert {module for module in sys.modules if module not in before} <= {m for m in sys.modules if "kfopc" in m}


def test_deep_nesting_is_only_deep(saved: Path) -> None:
    lists = b"]" * 10**5 + b"a" * (10**5 - 1)
    loaded = KFOPC.load(forge(saved, FILTER + b"}" + text("deep") + lists + b"sb."))
    depth, level = 0, loaded.deep
    while level:
        depth, level = depth + 1, level[0]
    assert depth == 10**5 - 1


CALLS: list[str] = []


def watched(*arguments: Any) -> None:
    """A function that a user trusts."""
    CALLS.append("called")


HOOKS = ("__new__", "__getattribute__", "__setattr__", "__setitem__", "__call__", "__hash__", "__index__", "__iter__")
HOOKS += ("__len__", "__int__", "__float__", "append", "extend", "add")
# A class that a user trusts, with everything that Python's pickles would call.
Watched: Any = type("Watched", (KFOPC,), {"__module__": __name__, **dict.fromkeys(HOOKS, watched)})


@pytest.mark.parametrize(
    "program",
    [
        *(b"%b}" + text(name) + b"%fsbK\x01a" for name in ("append", "__setstate__")),
        *(b"%b" + end for end in (b"(K\x01e", b")R", b"K\x01K\x01s", b"(K\x01\x90", b"}b0")),
        *(b"%f" + end for end in (b")R", b")\x81", b"}b")),
        b"}%bK\x01s",
        called(ARRAY, b"%b\x85", b"]"),
        array(ONE, F8, b"%b"),
        called("collections:deque", b"%b"),
        called("collections:Counter", b"]%ba"),
        called(GENERATOR, b"}" + text("bit_generator") + text("PCG64") + b"s" + text("state") + b"%bs"),
        named(f"{CLASS}:LimiterState") + b"%b\x81",
        named("kfopc_filterpy.power.shared_constraint:SharedConstraint") + b"%b\x85\x81",
        b"%b" + text("a") + b"%b\x93",
    ],
)
def test_nothing_of_a_class_or_function_that_is_trusted_is_called(program: bytes, saved: Path) -> None:
    me = __name__
    CALLS.clear()
    program = program.replace(b"%b", named(f"{me}:Watched") + b")\x81").replace(b"%f", named(f"{me}:watched"))
    with pytest.raises(ValueError, match=r"correct checksum|kfopc names "):
        Watched.load(forge(saved, program + b"."), trusted=[watched])
    assert not CALLS


def test_attributes_are_set_without_setters(saved: Path) -> None:
    CALLS.clear()
    me = named(f"{__name__}:Watched") + b")\x81"
    state = b"}" + text("rated_power") + b"K\x01s" + b"}" + text("_constraint") + b"K\x02s" + b"\x86"
    loaded = Watched.load(forge(saved, me + state + b"b."))
    assert not CALLS
    assert object.__getattribute__(loaded, "__dict__") == {"rated_power": 1}
    assert object.__getattribute__(loaded, "_constraint") == 2


def test_a_file_is_read_in_its_own_size(tmp_path: Path) -> None:
    large = tmp_path / "large.kfopc"
    KFOPC(400).save(large)
    KFOPC.load(large)  # what is kept from now on
    tracemalloc.start()
    KFOPC.load(large)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1.01 * large.stat().st_size + 200_000


# All or nothing.


def test_a_file_gets_the_usual_permissions_and_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "plain").write_bytes(b"")
    link = tmp_path / "latest.kfopc"
    link.symlink_to(tmp_path / "run.kfopc")
    new_filter().save(link)
    assert link.is_symlink()
    assert (tmp_path / "run.kfopc").stat().st_mode == (tmp_path / "plain").stat().st_mode
    assert_same_contents(KFOPC.load(link), new_filter())


def test_what_killed_processes_left_is_removed_after_an_hour(tmp_path: Path) -> None:
    path = tmp_path / "run[1].kfopc"
    old, new, other = (
        tmp_path / f".{name}.part" for name in ("run[1].kfopc.0123", "run[1].kfopc.4567", "run1.kfopc.89")
    )
    for part in (old, new, other):
        part.write_bytes(b"half")
    for part in (old, other):
        os.utime(part, (time.time() - 4000.0,) * 2)
    new_filter().save(path)
    assert sorted(os.listdir(tmp_path)) == sorted([path.name, new.name, other.name])


# A process forks children that save and kill themselves, each one line of the module later than the one before.
KILLED = """
import os, signal, sys
from pathlib import Path
from kfopc_filterpy import KFOPC, _writing, checkpoint


def kill_at(line):
    left = [line]

    def trace(frame, event, argument):
        left[0] -= frame.f_code.co_filename in (checkpoint.__file__, _writing.__file__) and event == "line"
        if left[0] == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return trace

    sys.settrace(trace)


path, kf = Path(sys.argv[1]), KFOPC(4)
kf.save(path)
old = new = unfinished = 0
killed = True
while killed:
    before = KFOPC.load(path).x[0, 0]
    kf.x[:] = before + 1
    if (child := os.fork()) == 0:
        kill_at(old + new + 1)
        kf.save(path)
        os._exit(0)  # the save has fewer lines
    killed = os.WIFSIGNALED(os.waitpid(child, 0)[1])
    (found,) = set(KFOPC.load(path).x.flat)  # the file is whole: its checksum is right
    assert found == before + 1 or found == before and killed, (found, before)
    old, new = old + (killed and found == before), new + (killed and found > before)
    parts = list(path.parent.glob(".*.part"))
    unfinished += killed and len(parts) > 0
    for part in parts:
        part.unlink()
print(old, new, unfinished)
"""


def test_a_process_that_is_killed_at_any_line_leaves_a_whole_file(tmp_path: Path) -> None:
    command = [sys.executable, "-c", KILLED, str(tmp_path / "run.kfopc")]
    done = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    old, new, unfinished = map(int, done.stdout.split())
    assert old > 8  # the file that was there before stayed
    assert new > 0
    assert unfinished > 3  # killed while a file was being written


def test_a_second_process_continues_to_the_bit(tmp_path: Path) -> None:
    script = """
import sys, numpy as np
from kfopc_filterpy.controllers import DirectKalman
controller = DirectKalman.load(sys.argv[1])
x, d = np.random.default_rng(0).standard_normal((2, 300))
for n in range(117, 300):
    y = controller.control_signal(x[n])
    controller.update(d[n] - y)
controller.save(sys.argv[1])
"""
    path = tmp_path / "run.kfopc"
    controller = kfopc_filterpy.kf_opc(8, [0.0, 1.0], rated_power=0.1, state_noise=1e-6, measurement_noise=0.1)
    for n, (x, d) in enumerate(np.random.default_rng(0).standard_normal((2, 300)).T):
        if n == 117:
            controller.save(path)
        y = controller.control_signal(x)
        controller.update(d - y)
    subprocess.run([sys.executable, "-c", script, str(path)], env=os.environ | {"PYTHONPATH": str(ROOT)}, check=True)
    assert_same_contents(type(controller).load(path), controller)
