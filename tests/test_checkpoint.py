"""Checkpoints: a run continues to the bit; what is refused, and by which name; and a save is all or nothing."""

from __future__ import annotations

import copy
import hashlib
import io
import json
import os
import pickle
import subprocess
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filterpy.common import inv_diagonal
from helpers.controllers import ALL, FILTERS, N_TAPS, OWN, OwnController
from helpers.loop import S_HAT
from helpers.rooms import Room

from kfopc_filterpy import KFOPC, FxLMS, LimitedController, OutputLimiter, kf_opc
from kfopc_filterpy.checkpoint import Checkpointed, content_of
from kfopc_filterpy.controllers import CoreController, FeedbackNeutralizer

ROOT = Path(__file__).resolve().parents[1]


class Measurements:
    """Measurements for a filter, one in seven of which is missing."""

    n = 0

    def run(self, kf: Any, samples: int) -> np.ndarray:
        """Return what the filter knows after each of some samples."""
        kept = []
        for n in range(self.n, self.n + samples):
            row, z = np.split(np.random.default_rng(n).standard_normal(N_TAPS + 1), [N_TAPS])
            kf.predict()
            kf.update(None if n % 7 == 6 else z, H=row, **{} if kf.rated_power is None else {"reference": row[0]})
            known = kf.x, kf.P, kf.K, kf.P_prior, kf.P_post, kf.S, kf.log_likelihood, kf.constraint_factor
            kept.append(np.concatenate([np.ravel(one) for one in known]))
        self.n += samples
        return np.array(kept)


def with_another_variance() -> Any:
    """Return a filter into whose P a user has written, which takes effect at the next step."""
    kf = FILTERS["random walk"]()
    kf.P[0, 0] *= 4.0
    return kf


MAKERS = ALL | FILTERS | {"random walk, P written": with_another_variance}


def saved(made: Any, path: Path, *classes: type) -> Any:
    """Save an object and load it."""
    made.save(path)
    return type(made).load(path, classes=classes)


@pytest.mark.parametrize("samples", [0, 61, 150])
@pytest.mark.parametrize("name", MAKERS)
def test_what_is_saved_or_copied_continues_to_the_bit(name: str, samples: int, tmp_path: Path) -> None:
    made = MAKERS[name]()
    run: Any = Measurements() if isinstance(made, KFOPC) else Room(made)
    run.run(made, samples)
    interrupted = samples == 61 and isinstance(run, Room)  # between the control signal and its error
    if interrupted:
        run.play(made)
    by_pickle = pickle.loads(pickle.dumps(made))
    twins = [saved(made, tmp_path / "run.npz", *OWN), copy.copy(made), copy.deepcopy(made), by_pickle, made]
    assert all(type(twin) is type(made) and content_of(twin) == content_of(made) for twin in twins)
    went_on = []
    for twin in twins:  # the original last: what the others did has not reached it
        own = copy.deepcopy(run)
        if interrupted:
            own.hear(twin)
        went_on.append((own.run(twin, 150).tolist(), content_of(twin)))
    assert all(one == went_on[-1] for one in went_on)


def test_another_process_continues_too(tmp_path: Path) -> None:
    controller = kf_opc(8, [0.0, 1.0], rated_power=0.1, state_noise=1e-6, measurement_noise=0.1)
    Room(controller).run(controller, 100)
    controller.save(tmp_path / "run.npz")
    program = "from sys import argv; from kfopc_filterpy.checkpoint import *; made = Checkpointed.load(argv[1]); "
    program += "made.control_signal(1.0), made.update(2.0), made.save(argv[1])"
    command = [sys.executable, "-c", program, str(tmp_path / "run.npz")]
    subprocess.run(command, env=os.environ | {"PYTHONPATH": str(ROOT)}, check=True)
    controller.control_signal(1.0), controller.update(2.0)
    assert (tmp_path / "run.npz").read_bytes() == content_of(controller)


def leaves(kind: type) -> set[type]:
    """Return the package's classes under this one from which no other is derived."""
    derived = [one for one in kind.__subclasses__() if one.__module__.startswith("kfopc_filterpy.")]
    return set().union(*map(leaves, derived)) if derived else {kind}


def test_every_controller_of_the_package_is_among_them() -> None:
    wanted = {kind for kind in leaves(Checkpointed) if kind.__module__.startswith("kfopc_filterpy.controllers.")}
    assert len(wanted) > 10
    assert {type(make()) for make in ALL.values()} >= wanted


class Mine(FxLMS):
    """A user's subclass, which keeps whatever it is given."""

    def __init__(self, *kept: Any) -> None:
        super().__init__(4, S_HAT, step_size=0.01)
        self.kept = kept


def test_every_kind_of_value_comes_back_as_it_was(tmp_path: Path) -> None:
    base, record = np.arange(24.0).reshape(4, 6), np.zeros(2, [("a", np.int8), ("b", np.float64)])
    kept: tuple[Any, ...] = (
        [0, -(10**40), True, None, 0.1, -0.0, np.nan, -np.inf, "ünï\n\ud800", 5e-324],
        [np.float32(0.1), np.int16(-3), np.bool_(True), np.complex128(1 + 2j), np.float64(0.1)],
        [base, base[1:, ::2], base.T, base[::-1], np.empty((3, 0)), np.array(3.0), record, base > 3, np.array(["a"])],
        [np.array([[None, 0.5]], dtype=object), np.linalg.pinv, inv_diagonal],
        (1, [2, deque([3, (4,)], maxlen=5)], deque(), {("a", 1): {"b": base}, 2: base + 1}, Counter("aba")),
    )
    loaded = saved(Mine(*kept), tmp_path / "run.npz").kept
    assert repr(loaded) == repr(kept)
    assert [type(one) for one in loaded[1]] == [type(one) for one in kept[1]]
    for mine, theirs in zip(loaded[2], kept[2], strict=True):
        assert (mine.dtype, mine.tobytes(), mine.flags.fnc) == (theirs.dtype, theirs.tobytes(), theirs.flags.fnc)
    assert loaded[4][3]["a", 1]["b"] is loaded[2][0]  # what is held twice is one thing
    assert loaded[4][1][1].maxlen == 5


def test_a_file_is_an_archive_of_numpys_whose_comment_is_its_checksum(tmp_path: Path) -> None:
    kf = FILTERS["KFOPC"]()
    kf.save(tmp_path / "run.npz")
    content = (tmp_path / "run.npz").read_bytes()
    with np.load(tmp_path / "run.npz") as file:
        np.testing.assert_array_equal(file["KFOPC.P"], kf.P)
        assert file.zip.comment == content[-64:] == hashlib.sha256(content[:-64]).hexdigest().encode()


def test_a_users_class_is_loaded_if_it_is_passed_or_by_its_own_load(tmp_path: Path) -> None:
    limited, path = LimitedController(OwnController(), OutputLimiter(1.0)), tmp_path / "run.npz"
    limited.controller.count = 7
    assert saved(limited, path, OwnController).count == 7
    with pytest.raises(ValueError, match=r"names helpers.controllers.OwnController: .*classes=\[OwnController\]"):
        LimitedController.load(path)
    assert saved(Mine(20), path).kept == (20,)
    assert type(FxLMS.load(path, classes=[Mine])) is Mine
    with pytest.raises(ValueError, match=r"names test_checkpoint.Mine: .*classes=\[Mine\]"):
        FxLMS.load(path)
    FxLMS(4, S_HAT, step_size=0.01).save(path)
    with pytest.raises(TypeError, match=r"has a FxLMS, which is no Mine: call FxLMS\.load"):
        Mine.load(path)


class Echo:
    """A controller of a user who did not read how it can be saved."""

    def control_signal(self, reference: float) -> float:
        return reference

    def update(self, error: float) -> None:
        pass


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: LimitedController(Echo(), OutputLimiter(1.0)), "LimitedController.controller .* a Echo is neither data nor"),
        (lambda: FeedbackNeutralizer(Mine(), [0.0, 0.1], amplifier=lambda y: y), r"._sound._amplifiers\[0\] .* a function"),
        (lambda: Mine(1, threading.Lock()), r"Mine.kept\[1\] cannot be saved: a lock is"),
        (lambda: Mine(1, {"key": [Mine().update]}), r"Mine.kept\[1\].* cannot be saved: a method is"),
        (lambda: Mine(np.zeros(2, [("a", "O")])), "a ndarray is neither"),
        (lambda: Mine(np.ma.masked_array([1.0], [True])), "a MaskedArray is neither"),
        (lambda: Mine(Mine), "a type is neither"),
    ],
)  # fmt: skip
def test_what_cannot_be_saved_is_named_and_nothing_is_written(make: Any, message: str, tmp_path: Path) -> None:
    (tmp_path / "run.npz").write_bytes(b"before")
    with pytest.raises(TypeError, match=message):
        make().save(tmp_path / "run.npz")
    assert (tmp_path / "run.npz").read_bytes() == b"before"
    assert os.listdir(tmp_path) == ["run.npz"]


# What is not loaded.


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A file of a controller."""
    path = tmp_path / "run.npz"
    kf_opc(4, [0.0, 1.0], rated_power=0.1, state_noise=1e-6, measurement_noise=0.1).save(path)
    return path


def test_a_damaged_byte_a_cut_and_an_addition_are_found_wherever_they_are(file: Path) -> None:
    content = file.read_bytes()
    for at in {*range(100), *range(100, len(content), 53), *range(len(content) - 100, len(content))}:
        for wrong in (
            content[:at] + bytes([content[at] ^ 16]) + content[at + 1 :],
            content[:at],
            content + content[:1],
        ):
            file.write_bytes(wrong)
            with pytest.raises(ValueError, match=r"run\.npz is damaged, cut short or not a file that `save` wrote"):
                CoreController.load(file)


def test_a_missing_and_another_file_are_refused(file: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"missing\.npz"):
        KFOPC.load(tmp_path / "missing.npz")
    np.savez(file, x=np.zeros(100))
    with pytest.raises(ValueError, match=r"run\.npz is damaged, cut short or not a file"):
        KFOPC.load(file)


def forged(path: Path, edited: Callable[[Any], Any] = lambda header: header, arrays: Any = None) -> Path:
    """Return a file with the right checksum, the header that `edited` makes of that of `path`, and other arrays."""
    with np.load(path) as file:
        held = dict(file) | (arrays or {})
    header, archived = edited(json.loads(held.pop("header").item())), io.BytesIO()
    np.savez(archived, header=np.array(json.dumps(header).encode()), **held)
    other, content = path.with_name("forged.npz"), archived.getvalue()
    other.write_bytes(content + hashlib.sha256(content).hexdigest().encode())
    return other


def with_block(edit: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return a function that edits the attributes of the block in a header."""

    def edited(header: Any) -> Any:
        (block,) = (one for one in header["objects"] if one["class"].endswith(".Block"))
        edit(block["parts"][0])
        return header

    return edited


def with_first(name: str) -> Callable[[Any], Any]:
    """Return a function that lets the first object in a header be of another class."""
    return lambda header: header | {"objects": [{"class": name, "items": ["true"], "parts": [{"args": "true"}]}]}


OTHER_LAYOUT = "the core lays out the fields of kalman in another way than when it was saved"
EDITS: list[tuple[Callable[[Any], Any], str]] = [
    (lambda header: header | {"version": "0.9"}, r"it was written by version 0\.9, and this is 1\.0"),
    (with_block(lambda own: own["layout"]["dict"].append(["new", [0, 0, 0, 1, 1, 1, 1]])), OTHER_LAYOUT),
    (with_block(lambda own: own["layout"]["dict"][-1].__setitem__(0, "renamed")), OTHER_LAYOUT),
    (with_block(lambda own: own["layout"]["dict"][-1][1].__setitem__(2, 64)), OTHER_LAYOUT),
    (with_block(lambda own: own["shape"]["dict"].append(["sensors", 2])), "'sensors'"),
    *((with_first(name), "it names") for name in ("os.system", "subprocess.Popen", "builtins.eval", "pickle.Unpickler")),
    *((with_first(f"kfopc_filterpy.{name}"), "") for name in ("core.library.load", "core.building.Path", "none.A", ".os.A")),
    *((lambda _, header=header: header, "") for header in ([], {}, {"version": "1.0"}, None, 1)),
]  # fmt: skip


@pytest.mark.parametrize(("edited", "message"), EDITS)
def test_what_this_version_does_not_write_is_refused(edited: Any, message: str, file: Path) -> None:
    assert isinstance(CoreController.load(forged(file)), CoreController)
    with pytest.raises(ValueError, match=rf"forged\.npz is not continued by this version of the package: .*{message}"):
        CoreController.load(forged(file, edited))


def test_less_memory_than_the_block_needs_is_refused(file: Path) -> None:
    with pytest.raises(ValueError, match=OTHER_LAYOUT):
        CoreController.load(forged(file, arrays={"DirectKalman._block.memory": np.zeros(64, np.uint8)}))


class Trap:
    """An object that leaves a trace if it is unpickled."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.trace),)


@pytest.mark.parametrize("name", ["DirectKalman._block.memory", "another"])
def test_no_pickle_is_read(name: str, file: Path, tmp_path: Path) -> None:
    trap = np.array([Trap(tmp_path / "trace")], dtype=object)
    with pytest.raises(ValueError, match="Object arrays cannot be loaded when allow_pickle=False"):
        CoreController.load(forged(file, arrays={name: trap}))
    assert not (tmp_path / "trace").exists()


# All or nothing.


def test_a_file_gets_the_usual_permissions_and_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "plain").write_bytes(b"")
    link = tmp_path / "latest.npz"
    link.symlink_to(tmp_path / "run.npz")
    Mine().save(link)
    assert link.is_symlink()
    assert (tmp_path / "run.npz").stat().st_mode == (tmp_path / "plain").stat().st_mode
    assert (tmp_path / "run.npz").read_bytes() == content_of(Mine())


def test_what_killed_processes_left_is_removed_after_an_hour(tmp_path: Path) -> None:
    path = tmp_path / "run[1].npz"
    old, new, other = (tmp_path / f".{name}.part" for name in ("run[1].npz.0123", "run[1].npz.4567", "run1.npz.89"))
    for part in (old, new, other):
        part.write_bytes(b"half")
    for part in (old, other):
        os.utime(part, (time.time() - 4000.0,) * 2)
    Mine().save(path)
    assert sorted(os.listdir(tmp_path)) == sorted([path.name, new.name, other.name])


# A process forks children that save and kill themselves, each one line of the writing later than the one before.
KILLED = """
import os, signal, sys
from pathlib import Path
from kfopc_filterpy import KFOPC, _writing

path, kf, left, found, unfinished = Path(sys.argv[1]), KFOPC(4), 0, [], 0


def trace(frame, event, argument):
    global left
    left -= frame.f_code.co_filename == _writing.__file__ and event == "line"
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return trace


kf.save(path)
killed = True
while killed:
    kf.x[:] = len(found) + 1
    if (child := os.fork()) == 0:
        left = len(found) + 1
        sys.settrace(trace)
        kf.save(path)
        os._exit(0)  # the save has fewer lines
    killed = os.WIFSIGNALED(os.waitpid(child, 0)[1])
    (x,) = set(KFOPC.load(path).x.flat)  # the file is whole: its checksum is right
    found.append(x == len(found) + 1)
    for part in path.parent.glob(".*.part"):
        part.unlink()
        unfinished += 1
print(found.count(False), found.count(True), unfinished)
"""


def test_a_process_that_is_killed_at_any_line_leaves_a_whole_file(tmp_path: Path) -> None:
    command = [sys.executable, "-c", KILLED, str(tmp_path / "run.npz")]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    old, new, unfinished = map(int, done.stdout.split())
    assert old > 8  # the file that was there before stayed
    assert new > 1  # at the last lines, and once without a kill
    assert unfinished > 3  # killed while a file was being written
