"""Checkpoints: what a file may be, what is refused, and that a save is all or nothing."""

from __future__ import annotations

import errno
import functools
import hashlib
import json
import os
import resource
import subprocess
import sys
import threading
import time
import tracemalloc
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from filterpy.common import inv_diagonal
from helpers.checkpoints import assert_same_contents, forge, sealed
from helpers.naming import plain

import kfopc_filterpy
from kfopc_filterpy import KFOPC, checkpoint

ROOT = Path(__file__).resolve().parents[1]


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


def test_a_file_has_a_line_for_the_format_a_line_of_json_and_a_checksum_that_other_tools_confirm(saved: Path) -> None:
    content = saved.read_bytes()
    first, second, _ = content.split(b"\n", 2)
    assert first == b"kfopc checkpoint 1 %d" % len(second)
    header = json.loads(second)
    assert header["package"] == kfopc_filterpy.__version__
    assert header["libraries"]["numpy"] == np.__version__
    assert hashlib.sha256(content[:-64]).hexdigest() == content[-64:].decode()
    # The weights are where the header says, as plain little-endian numbers.
    node = header["nodes"][header["nodes"][0]["attributes"]["x"]["node"]]
    begin = len(first) + len(second) + 2
    begin += -begin % 64 + node["at"]
    assert (node["dtype"], node["shape"]) == ("<f8", [3, 1])
    np.testing.assert_array_equal(np.frombuffer(content[begin : begin + 24]), new_filter().x[:, 0])


def test_every_kind_of_value_comes_back_as_it_was(tmp_path: Path) -> None:
    kf = KFOPC(2)
    base = np.arange(24.0).reshape(4, 6)
    record = np.zeros(2, np.dtype([("a", np.int8), ("b", np.float64)], align=True))
    values = {
        "numbers": [0, -(10**40), True, None, 0.1, -0.0, np.inf, -np.inf, "text", "ünï\n", 5e-324],
        "scalars": [np.float32(0.1), np.int16(-3), np.bool_(True), np.complex128(1 + 2j), record[0]],
        "arrays": [base, base[1:, ::2], base.T, base[::-1], np.empty((3, 0)), np.array(3.0), record, base > 3],
        "text": np.array(["a", "bcd"]),
        "objects": np.array([[None], [base]], dtype=object),
        "broadcast": np.broadcast_to(base[0], (5, 6)),
        "fortran": np.asfortranarray(base),
        "others": (1, [2, deque([3, (4,)], maxlen=5)], deque(), {("a", 1): {"b": base[0]}, 2: 3}),
        "inv": np.linalg.pinv,
        "inverses": [np.linalg.inv, inv_diagonal],
        "generator": np.random.Generator(np.random.Philox(3)),
    }
    values["cycle"] = [values["others"]]
    values["cycle"].append(values["cycle"])
    vars(kf).update(values)
    kf.generator.standard_normal(3)
    kf.save(tmp_path / "filter.kfopc")
    loaded = KFOPC.load(tmp_path / "filter.kfopc")
    assert_same_contents(loaded, kf)
    assert repr(loaded.numbers) == repr(kf.numbers)
    assert [type(one) for one in loaded.scalars] == [type(one) for one in kf.scalars]
    for mine, theirs in zip(loaded.arrays, kf.arrays, strict=True):
        np.testing.assert_array_equal(mine, theirs)
        assert (mine.dtype, mine.strides) == (theirs.dtype, theirs.strides)
    assert loaded.arrays[6].dtype.isalignedstruct
    np.testing.assert_array_equal(loaded.broadcast, kf.broadcast)
    np.testing.assert_array_equal(loaded.text, kf.text)
    np.testing.assert_array_equal(loaded.objects[1, 0], base)
    assert loaded.fortran.flags.f_contiguous
    assert loaded.others[1][1].maxlen == 5
    assert loaded.others[2] is not kf.others[2]
    assert loaded.inv is np.linalg.pinv
    assert loaded.inverses == [np.linalg.inv, inv_diagonal]
    assert loaded.cycle[1] is loaded.cycle
    assert loaded.cycle[0] is loaded.others
    np.testing.assert_array_equal(loaded.generator.standard_normal(5), kf.generator.standard_normal(5))


def test_arrays_that_shared_memory_share_it_again(tmp_path: Path) -> None:
    kf, base = KFOPC(2), np.zeros((4, 6))
    kf.whole, kf.part, kf.even, kf.odd, kf.other = base, base[1:3], base[:, ::2], base[:, 1::2], np.zeros((4, 6))
    kf.save(tmp_path / "filter.kfopc")
    loaded = KFOPC.load(tmp_path / "filter.kfopc")
    loaded.part[0, 2:4] = 1.0, 2.0
    assert (loaded.whole[1, 2], loaded.even[1, 1], loaded.odd[1, 1]) == (1.0, 1.0, 2.0)
    assert not np.any(loaded.other)
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


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (lambda: None, r"KFOPC\.own cannot be saved: .*<lambda>"),
        ({"key": [sys.stdout]}, r"KFOPC\.own\['key'\]\[0\] cannot be saved: it is a"),
        ((1, threading.Lock()), r"KFOPC\.own\[1\] cannot be saved: it is a lock"),
        (Inside(Odd()), r"KFOPC\.own\.value cannot be saved: it is a Odd"),
        (new_filter().predict, r"KFOPC\.own cannot be saved: it is a method"),
        ([].append, r"KFOPC\.own cannot be saved: it is a builtin_function"),
        (np.ma.masked_array([1.0], [True]), r"it is a MaskedArray; make a plain numpy array"),
        (np.zeros(2, [("a", "O")]), r"KFOPC\.own cannot be saved: it is an array of object"),
        ({1, 2}, r"KFOPC\.own cannot be saved: it is a set"),
        (KFOPC, r"KFOPC\.own cannot be saved: it is a type"),
        (functools.partial(print), r"KFOPC\.own cannot be saved: it is a partial"),
        (["x"] * (2**24 // 4), r"take \d+ bytes, and at most 16777216 can be loaded"),
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


def test_a_tuple_that_contains_itself_is_refused(saved: Path) -> None:
    kf, inner = new_filter(), []
    kf.own = (inner,)
    inner.append(kf.own)
    with pytest.raises(TypeError, match="a tuple that contains itself"):
        kf.save(saved)


# What is refused.


def test_every_damaged_byte_is_found(saved: Path) -> None:
    content, rng = saved.read_bytes(), np.random.default_rng(0)
    for at in range(len(content)):
        damaged = bytearray(content)
        damaged[at] ^= int(rng.integers(1, 256))
        saved.write_bytes(damaged)
        with pytest.raises(ValueError, match="damaged"):
            KFOPC.load(saved)


def test_a_file_that_is_cut_short_or_longer_is_refused(saved: Path) -> None:
    content = saved.read_bytes()
    for size in {*range(1, 200), *range(200, len(content), 17), *range(len(content) - 200, len(content))}:
        saved.write_bytes(content[:size])
        with pytest.raises(ValueError, match="damaged"):
            KFOPC.load(saved)
    saved.write_bytes(content + b"\n")
    with pytest.raises(ValueError, match="damaged or cut short: its checksum differs; load an older file"):
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
    content = saved.read_bytes()[:-64]
    other = sealed(saved.with_name("other.kfopc"), content.replace(b"checkpoint 1 ", b"checkpoint 2 "))
    with pytest.raises(ValueError, match=r"has the format 2, and .* reads format 1: install the version"):
        KFOPC.load(other)
    for version in ("0.0.9", "1.1.0", "7.1", ""):
        old = forge(saved, lambda header, version=version: header.update(package=version))
        with pytest.raises(ValueError, match=rf"was written by kfopc_filterpy {version}, and this is "):
            KFOPC.load(old)
    series = ".".join(kfopc_filterpy.__version__.split(".")[:2])
    same = forge(saved, lambda header: header.update(package=f"{series}.99"))
    assert_same_contents(KFOPC.load(same), KFOPC.load(saved))


def first_array(header: dict[str, Any]) -> dict[str, Any]:
    return next(node for node in header["nodes"] if node["kind"] == "array" and len(node["shape"]) == 2)


def root(header: dict[str, Any]) -> dict[str, Any]:
    return header["nodes"][header["root"]["node"]]


def named_tuple(header: dict[str, Any]) -> dict[str, Any]:
    return next(node for node in header["nodes"] if node.get("fields"))


FORGED: dict[str, tuple[Any, str]] = {
    "a huge array": (
        lambda h: first_array(h).update(shape=[10**6, 10**6], strides=[8 * 10**6, 8]),
        r"claims an array of shape \(1000000, 1000000\), which is larger than the file",
    ),
    "a huge array without strides": (
        lambda h: first_array(h).update(shape=[10**6, 10**6], strides=[0, 0]),
        "larger than the file",
    ),
    "long strings": (lambda h: first_array(h).update(dtype="<U100000000"), "larger than the file"),
    "an array beyond the end": (lambda h: first_array(h).update(at=10**9), "correct checksum"),
    "an array before the begin": (lambda h: first_array(h).update(at=-800), "correct checksum"),
    "strides out of the data": (lambda h: first_array(h).update(strides=[10**6, 8]), "correct checksum"),
    "pointers": (lambda h: first_array(h).update(dtype="|O"), "correct checksum"),
    "a type that is none": (lambda h: first_array(h).update(dtype="__import__('os')"), "correct checksum"),
    "no nodes": (lambda h: h.pop("nodes"), "correct checksum"),
    "a node that is not there": (lambda h: h.update(root={"node": 10**6}), "correct checksum"),
    "an unknown kind": (lambda h: root(h).update(kind="code"), "correct checksum"),
    "other fields": (lambda h: named_tuple(h).update(fields=["a"]), "has other fields than"),
    "no tuple": (lambda h: named_tuple(h).update({"class": "kfopc_filterpy.power.limiter.OutputLimiter"}), "fields"),
    "no slot": (lambda h: root(h)["slots"].update(__class__=1), "KFOPC has no slot __class__"),
    "a tuple in itself": (
        lambda h: (
            h["nodes"].append({"kind": "tuple", "items": [{"node": len(h["nodes"])}]})
            or root(h)["attributes"].update(x={"node": len(h["nodes"]) - 1})
        ),
        "correct checksum",
    ),
    "a class of the standard library": (
        lambda h: root(h).update({"class": "antigravity.Fly"}),
        "names antigravity.Fly",
    ),
    "a process": (lambda h: named_tuple(h).update({"class": "subprocess.Popen"}), "names subprocess.Popen, which"),
    "a function as a class": (lambda h: root(h).update({"class": "numpy.linalg.inv"}), "which it is not"),
    "a function of the package": (lambda h: root(h).update({"class": "kfopc_filterpy.cli.main"}), "names kfopc"),
    "an import of the package": (
        lambda h: root(h).update({"class": "kfopc_filterpy.kernels.compiling.Path"}),
        "names kfopc_filterpy.kernels.compiling.Path",
    ),
    "a call": (
        lambda h: (
            h["nodes"].append({"kind": "function", "name": "os.system"})
            or root(h)["attributes"].update(inv={"node": len(h["nodes"]) - 1})
        ),
        "names os.system, which is none of",
    ),
}


@pytest.mark.parametrize("name", FORGED)
def test_a_file_that_save_did_not_write_is_refused_and_imports_nothing(name: str, saved: Path) -> None:
    change, message = FORGED[name]
    KFOPC.load(saved)
    before = set(sys.modules)
    with pytest.raises(ValueError, match=message):
        KFOPC.load(forge(saved, change))
    assert set(sys.modules) == before


def test_a_header_that_is_no_json_too_long_or_too_deep_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.kfopc"
    for text in (b"{", b"[]", b"[" * 10**6, b"\xff", b'"'):
        with pytest.raises(ValueError, match="correct checksum"):
            KFOPC.load(sealed(path, b"kfopc checkpoint 1 %d\n%s\n" % (len(text), text)))
    for size in (b"", b" x", b" -3", b" 1e3", b" %d" % 10**30, b" 3"):
        with pytest.raises(ValueError, match="correct checksum"):
            KFOPC.load(sealed(path, b"kfopc checkpoint 1%s\n{}" % size))
    with pytest.raises(ValueError, match="a header of 16777217 bytes"):
        KFOPC.load(sealed(path, b"kfopc checkpoint 1 %d\n" % (2**24 + 1) + b" " * (2**24 + 2)))


def peak_of(path: Path) -> int:
    """Return the most bytes that were in use while a file was read."""
    tracemalloc.start()
    try:
        with suppress(ValueError):
            KFOPC.load(path)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_a_file_is_read_in_its_own_size_and_json_in_thirty_five_times_its_size(tmp_path: Path) -> None:
    large = tmp_path / "large.kfopc"
    KFOPC(400).save(large)
    KFOPC.load(large)  # what is kept from now on
    assert peak_of(large) < 1.01 * large.stat().st_size + 200_000
    header = b'{"package":"%s","nodes":[%s]}' % (
        kfopc_filterpy.__version__.encode(),
        b",".join([b'{"":0}'] * 10**5),  # of all JSON, this takes the most memory per byte
    )
    nested = sealed(tmp_path / "nested.kfopc", b"kfopc checkpoint 1 %d\n%s\n" % (len(header), header))
    assert 10 * nested.stat().st_size < peak_of(nested) < 35 * nested.stat().st_size


# All or nothing.


def test_a_full_disk_leaves_the_old_file_and_nothing_else(saved: Path) -> None:
    before, (soft, hard) = saved.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before), hard))
    try:
        with pytest.raises(OSError, match="too large") as refused:
            new_filter(50).save(saved)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert refused.value.errno == errno.EFBIG
    assert saved.read_bytes() == before
    assert os.listdir(saved.parent) == ["run.kfopc"]


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


# A process forks children that save again and again, and kills them. The first kind of child kills itself before one of
# the lines of the functions that write; the second is killed by its parent after a random time.

KILLED = """
import os, random, signal, sys, time
import numpy as np
from kfopc_filterpy import KFOPC, checkpoint

path, kind = sys.argv[1], sys.argv[2]
WRITERS = {checkpoint._write.__code__, checkpoint._replacing.__wrapped__.__code__}


def saved():
    return int(KFOPC.load(path).x[0, 0])


def begin(kf, pipe, kill_at):
    lines = 0

    def trace(frame, event, argument):
        nonlocal lines
        if frame.f_code in WRITERS and event == "line":
            lines += 1
            if lines == kill_at:
                os.kill(os.getpid(), signal.SIGKILL)
        return trace

    sys.settrace(trace if kill_at else None)
    count = saved()
    while True:
        count += 1
        kf.x[:] = count
        kf.save(path)
        os.write(pipe, count.to_bytes(8, "little"))
        if kill_at:
            os._exit(0)  # the save has fewer lines


def run(kf, kill_at, delay):
    before = saved()
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reader)
        begin(kf, writer, kill_at)
    os.close(writer)
    if not kill_at:
        time.sleep(delay)
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    with os.fdopen(reader, "rb") as file:
        told = [int.from_bytes(word, "little") for word in iter(lambda: file.read(8), b"")]
    last = told[-1] if told else before
    now = saved()  # the file is whole: its checksum is right
    assert now in (last, last + 1), (now, last)
    assert np.all(KFOPC.load(path).x == now)
    return os.WIFSIGNALED(status), now - before, len(os.listdir(os.path.dirname(path))) > 1


kf = KFOPC(150 if kind == "times" else 4)
kf.x[:] = 0
kf.save(path)
begun = time.perf_counter()
for _ in range(5):
    kf.save(path)
longest = time.perf_counter() - begun  # that a child lives: five saves, however slow and busy the disk is
random.seed(1)
outcomes = []
for trial in range(1, 151):
    outcomes.append(run(kf, trial if kind == "lines" else 0, random.uniform(0.0, longest)))
    for name in os.listdir(os.path.dirname(path)):
        if name.endswith(".part"):
            os.remove(os.path.join(os.path.dirname(path), name))
    if kind == "lines" and not outcomes[-1][0]:
        break
killed = [one for one in outcomes if one[0]]
print(len(killed), sum(one[1] == 0 for one in killed), sum(one[1] > 0 for one in killed), sum(one[2] for one in killed))
"""


@pytest.mark.parametrize("kind", ["lines", "times"])
def test_a_process_that_is_killed_at_any_point_leaves_a_whole_file(kind: str, tmp_path: Path) -> None:
    folder = tmp_path / "saved"
    folder.mkdir()
    command = [sys.executable, "-c", KILLED, str(folder / "run.kfopc"), kind]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    killed, old, new, unfinished = map(int, done.stdout.split())
    assert killed > 15
    assert unfinished > 3  # killed while a file was being written
    assert new > 0
    if kind == "lines":
        assert old > 8  # and the file that was there before stayed


def test_a_second_process_continues_to_the_bit(tmp_path: Path) -> None:
    script = """
import sys, numpy as np
from kfopc_filterpy import KalmanController, kf_opc
path, begin, end = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
if begin == 0:
    controller = kf_opc(8, [0.0, 1.0], rated_power=0.1, state_noise=1e-6, measurement_noise=0.1)
else:
    controller = KalmanController.load(path)
x, d = np.random.default_rng(0).standard_normal((2, 300))
for n in range(begin, end):
    y = controller.control_signal(x[n])
    controller.update(d[n] - y)
controller.save(path)
print(y.hex(), controller.weights.tobytes().hex())
"""

    def run(begin: int, end: int) -> str:
        command = [sys.executable, "-c", script, str(tmp_path / "run.kfopc"), str(begin), str(end)]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout

    whole = run(0, 300)
    run(0, 117)
    assert run(117, 300) == whole


def test_the_names_that_a_file_may_hold_are_there() -> None:
    assert all(callable(thing) for thing in checkpoint._outside().values())
    assert checkpoint._class_of_package("kfopc_filterpy.power.limiter.LimiterState") is not None
    assert all(name.split(".")[1] in checkpoint.FOLDERS for name in checkpoint._modules())
