"""Checkpoints: a run continues to the bit; what is refused, and by which name; and a save is all or nothing."""

from __future__ import annotations

import copy
import hashlib
import io
import os
import pickle
import re
import subprocess
import sys
import threading
from collections import Counter, deque
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filterpy.common import inv_diagonal
from helpers.checkpoints import Measurements, Room, assert_same_contents, forged, sealed
from helpers.controllers import ALL, FILTERS, OWN, OwnController
from helpers.loop import S_HAT
from helpers.simulation import Playing

from kfopc_filterpy import KFOPC, LimitedController, OutputLimiter, fx_lms, kf_opc
from kfopc_filterpy.checkpoint import Checkpointed, content_of
from kfopc_filterpy.controllers import CoreController, FeedbackNeutralizer

ROOT = Path(__file__).resolve().parents[1]


def with_another_variance() -> Any:
    """Return a filter into whose P a user has written, which takes effect at the next step."""
    kf = FILTERS["random walk"]()
    kf.P[0, 0] *= 4.0
    return kf


MAKERS = ALL | FILTERS | {"random walk, P written": with_another_variance}
ANEW = 150  # samples from the interruption on


def run_for(made: Any) -> Any:
    return Measurements() if isinstance(made, KFOPC) else Room(made)


def saved(made: Any, path: Path, *classes: type) -> Any:
    """Save an object and load it."""
    made.save(path)
    return type(made).load(path, classes=classes)


# What is saved or copied continues.


@pytest.mark.parametrize("samples", [0, 61, 150])
@pytest.mark.parametrize("name", MAKERS)
def test_what_is_saved_or_copied_continues_to_the_bit(name: str, samples: int, tmp_path: Path) -> None:
    made = MAKERS[name]()
    run = run_for(made)
    run.run(made, samples)
    interrupted = samples == 61 and isinstance(run, Room)  # between the control signal and its error
    if interrupted:
        run.play(made)
    by_pickle = pickle.loads(pickle.dumps(made))
    twins = [saved(made, tmp_path / "run.npz", *OWN), copy.copy(made), copy.deepcopy(made), by_pickle]
    runs = [run.copy() for _ in twins]
    for twin in twins:
        assert type(twin) is type(made)
        assert_same_contents(twin, made)
    if interrupted:
        for each, twin in zip([*runs, run], [*twins, made], strict=True):
            each.hear(twin)
    went_on = [one.run(twin, ANEW) for one, twin in zip(runs, twins, strict=True)]
    expected = run.run(made, ANEW)  # what the others did has not reached it
    for twin, got in zip(twins, went_on, strict=True):
        np.testing.assert_array_equal(got, expected)
        assert_same_contents(twin, made)


def leaves(kind: type) -> set[type]:
    """Return the package's classes under this one from which no other is derived."""
    derived = [one for one in kind.__subclasses__() if one.__module__.startswith("kfopc_filterpy.")]
    return set().union(*map(leaves, derived)) if derived else {kind}


def test_every_controller_of_the_package_is_among_them() -> None:
    wanted = {kind for kind in leaves(Checkpointed) if kind.__module__.startswith("kfopc_filterpy.controllers.")}
    assert len(wanted) >= 8
    assert {type(make()) for make in ALL.values()} >= wanted


class Mine(CoreController):
    """A user's subclass, which keeps whatever it is given."""

    def __init__(self, *kept: Any) -> None:
        super().__init__("FxLMS", "fxlms", 4, S_HAT, settings={"step_size": 0.01})
        self.kept = kept


def test_every_kind_of_value_comes_back_as_it_was(tmp_path: Path) -> None:
    base, record = np.arange(24.0).reshape(4, 6), np.zeros(2, [("a", np.int8), ("b", np.float64)])
    kept: tuple[Any, ...] = (
        [0, -(10**40), True, None, 0.1, -0.0, np.nan, -np.inf, "ünï\n\ud800", 5e-324],
        [np.float32(0.1), np.int16(-3), np.bool_(True), np.complex128(1 + 2j), np.float64(0.1)],
        [base, base[1:, ::2], base.T, base[::-1], np.empty((3, 0)), np.array(3.0), record, base > 3, np.array(["a"])],
        [np.array([[None, 0.5]], dtype=object), np.linalg.pinv, inv_diagonal],
        (
            1,
            [2, deque([3, (4,)], maxlen=5)],
            deque(),
            {("a", 1): {"b": base, "b.c/\\": base + 1}, 2: 3},
            Counter("aba"),
        ),
    )
    loaded = saved(Mine(*kept), tmp_path / "run.npz").kept
    assert repr(loaded) == repr(kept)
    assert [type(one) for one in loaded[1]] == [type(one) for one in kept[1]]
    for mine, theirs in zip(loaded[2], kept[2], strict=True):
        assert (mine.dtype, mine.tobytes(), mine.flags.fnc) == (theirs.dtype, theirs.tobytes(), theirs.flags.fnc)
    assert loaded[4][3]["a", 1]["b"] is loaded[2][0]  # what is held twice is one thing
    assert loaded[4][1][1].maxlen == 5
    assert content_of(Mine(*loaded)) == content_of(Mine(*kept))


def test_a_file_is_an_archive_of_numpys_whose_comment_is_its_checksum(tmp_path: Path) -> None:
    kf = FILTERS["KFOPC"]()
    kf.save(tmp_path / "run.npz")
    content = (tmp_path / "run.npz").read_bytes()
    with np.load(tmp_path / "run.npz") as file:
        np.testing.assert_array_equal(file["KFOPC.P"], kf.P)
        assert file.zip.comment == content[-64:] == hashlib.sha256(content[:-64]).hexdigest().encode()


# Classes of a user.


def test_a_users_class_in_a_wrapper_is_asked_for_its_state_and_has_to_be_passed(tmp_path: Path) -> None:
    limited, path = LimitedController(OwnController(), OutputLimiter(1.0, fs=8000)), tmp_path / "run.npz"
    limited.controller.count = 7
    assert saved(limited, path, OwnController).count == 7
    with pytest.raises(ValueError, match=r"names helpers.controllers.OwnController: .*classes=\[OwnController\]"):
        LimitedController.load(path)


def test_a_users_subclass_is_loaded_by_its_own_load_or_if_it_is_passed(tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    assert saved(Mine(20), path).kept == (20,)
    assert type(CoreController.load(path, classes=[Mine])) is Mine
    with pytest.raises(ValueError, match=r"names test_checkpoint.Mine: .*classes=\[Mine\]"):
        CoreController.load(path)
    fx_lms(4, S_HAT, step_size=0.01).save(path)
    with pytest.raises(TypeError, match=r"has a CoreController, which is no Mine: call CoreController\.load"):
        Mine.load(path)


UNSAVED: dict[str, tuple[Any, str]] = {
    "a user's controller": (
        lambda: LimitedController(Playing(float), OutputLimiter(1.0, fs=8000)),
        "LimitedController.controller cannot be saved: a Playing is neither data nor of a class with the methods state",
    ),
    "an amplifier": (
        lambda: FeedbackNeutralizer(Mine(), [0.0, 0.1], amplifier=lambda y: y),
        r"FeedbackNeutralizer._sound._amplifiers\[0\] cannot be saved: a function is",
    ),
    "a lock": (lambda: Mine(threading.Lock()), r"Mine.kept\[0\] cannot be saved: a lock is"),
    "a set": (lambda: Mine(1, {1, 2}), r"Mine.kept\[1\] cannot be saved: a set is"),
    "bytes": (lambda: Mine(b"bytes"), r"Mine.kept\[0\] cannot be saved: a bytes is"),
    "a masked array": (lambda: Mine(np.ma.masked_array([1.0], [True])), "a MaskedArray is neither"),
    "pointers": (lambda: Mine(np.zeros(2, [("a", "O")])), "a ndarray is neither"),
    "a method": (lambda: Mine({"key": [Mine().update]}), r"Mine.kept\[0\].* cannot be saved: a method is"),
    "a class": (lambda: Mine(Mine), "a type is neither"),
}


@pytest.mark.parametrize("case", UNSAVED)
def test_what_cannot_be_saved_is_named_and_nothing_is_written(case: str, tmp_path: Path) -> None:
    make, message = UNSAVED[case]
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
    kf_opc(4, [0.0, 1.0], rated_power=0.1, fs=8000, state_noise=1e-6, measurement_noise=0.1).save(path)
    return path


def test_a_damaged_byte_is_found_wherever_it_is_and_so_is_a_cut_or_an_addition(file: Path) -> None:
    content, rng = file.read_bytes(), np.random.default_rng(0)
    edges = {*range(100), *range(len(content) - 100, len(content))}
    for at in {*edges, *range(100, len(content), 53)}:
        damaged = bytearray(content)
        damaged[at] ^= int(rng.integers(1, 256))
        for wrong in (damaged, content[:at]):
            file.write_bytes(wrong)
            with pytest.raises(ValueError, match=r"run\.npz is damaged, cut short or not a file that `save` wrote"):
                CoreController.load(file)
    file.write_bytes(content + b"\n")
    with pytest.raises(ValueError, match="damaged"):
        CoreController.load(file)


def test_a_missing_and_another_file_are_refused(file: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"missing\.npz does not exist or is not a file; the current folder"):
        KFOPC.load(tmp_path / "missing.npz")
    np.savez(file, x=np.zeros(100))
    with pytest.raises(ValueError, match=r"run\.npz is damaged, cut short or not a file"):
        KFOPC.load(file)
    with pytest.raises(FileNotFoundError, match=r"the folder .*nowhere does not exist: make it first"):
        Mine().save(tmp_path / "nowhere" / "run.npz")


def test_a_file_that_would_unpack_to_far_more_than_it_has_is_refused(tmp_path: Path) -> None:
    archived = io.BytesIO()
    np.savez_compressed(archived, header=np.zeros(10_000_000))
    with pytest.raises(ValueError, match=r"x\.npz is not continued .*it would unpack to more than it has"):
        CoreController.load(sealed(tmp_path / "x.npz", archived.getvalue()))


def test_another_version_is_refused_by_its_number(file: Path) -> None:
    path = forged(file, lambda header: header | {"version": "0.9"})
    with pytest.raises(ValueError, match=r"not continued by this version .* by version 0\.9, and this is 1\.0"):
        CoreController.load(path)


def block_of(header: Any) -> Any:
    """Return the attributes of the block in a header."""
    (block,) = (one for one in header["objects"] if one["class"].endswith(".Block"))
    return block["parts"][0]


CHANGES = ["one more field", "another order", "another place", "less memory", "another plan"]


@pytest.mark.parametrize("change", CHANGES)
def test_a_block_of_another_core_is_refused(change: str, file: Path) -> None:
    def moved(header: Any) -> Any:
        fields = block_of(header)["layout"]["dict"]
        if change == "one more field":
            fields.append(["new", [0, 0, 0, 1, 1, 1, 1]])
        elif change == "another order":
            fields[0][0], fields[1][0] = fields[1][0], fields[0][0]
        elif change == "another place":
            fields[-1][1][2] += 64
        elif change == "another plan":
            block_of(header)["shape"]["dict"].append(["sensors", 2])
        return header

    arrays = {"KalmanInCore._block.memory": np.zeros(64, np.uint8)} if change == "less memory" else {}
    CoreController.load(forged(file, lambda header: header))
    message = "the core lays out the fields of kalman in another way than when it was saved"
    if change == "another plan":
        message = r"not continued by this version .* 'sensors'"
    with pytest.raises(ValueError, match=message):
        CoreController.load(forged(file, moved, **arrays))


class Trap:
    """An object that leaves a trace if it is unpickled."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.trace),)


NOT_CLASSES = ["os.system", "subprocess.Popen", "builtins.eval", "numpy.linalg.inv", "pickle.Unpickler"]
INSIDE = ["core.building.subprocess", "core.library.load", "checkpoint.Path", "nothing.A", ".os.system"]


@pytest.mark.parametrize("named", NOT_CLASSES + [f"kfopc_filterpy.{name}" for name in INSIDE])
def test_nothing_but_classes_of_the_package_can_be_named(named: str, file: Path) -> None:
    first = {"class": named, "items": ["true"], "parts": [{"args": "true"}]}
    with pytest.raises(
        ValueError,
        match=rf"forged\.npz is not continued by this version .*(it names {re.escape(named)}:|No module named)",
    ):
        CoreController.load(forged(file, lambda header: header | {"objects": [first]}))


def test_no_pickle_is_read(file: Path, tmp_path: Path) -> None:
    trap = np.array([Trap(tmp_path / "trace")], dtype=object)
    for name in ("KalmanInCore._block.memory", "another"):
        with pytest.raises(ValueError, match="Object arrays cannot be loaded when allow_pickle=False"):
            CoreController.load(forged(file, lambda header: header, **{name: trap}))
    pickled = io.BytesIO()
    pickle.dump(Trap(tmp_path / "trace"), pickled)
    with pytest.raises(ValueError, match="is not continued"):
        CoreController.load(sealed(file, pickled.getvalue()))
    assert not (tmp_path / "trace").exists()


@pytest.mark.parametrize("header", [[], {}, {"version": "1.0"}, {"version": "1.0", "objects": [{}]}, None, 1])
def test_a_header_that_save_did_not_write_is_refused(header: Any, file: Path) -> None:
    with pytest.raises(ValueError, match="is not continued by this version"):
        CoreController.load(forged(file, lambda _: header))


# All or nothing.


def test_a_file_gets_the_usual_permissions_and_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "plain").write_bytes(b"")
    link = tmp_path / "latest.npz"
    link.symlink_to(tmp_path / "run.npz")
    Mine().save(link)
    assert link.is_symlink()
    assert (tmp_path / "run.npz").stat().st_mode == (tmp_path / "plain").stat().st_mode
    assert_same_contents(Mine.load(link), Mine())
    (tmp_path / "run.npz").chmod(0o600)
    Mine().save(link)
    assert (tmp_path / "run.npz").stat().st_mode & 0o777 == 0o600


# A process forks children that save and kill themselves, each one line of the writing later than the one before.
KILLED = """
import os, signal, sys
from pathlib import Path
from kfopc_filterpy import KFOPC, _writing


def kill_at(line):
    left = [line]

    def trace(frame, event, argument):
        left[0] -= frame.f_code.co_filename == _writing.__file__ and event == "line"
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
    command = [sys.executable, "-c", KILLED, str(tmp_path / "run.npz")]
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    old, new, unfinished = map(int, done.stdout.split())
    assert old > 8  # the file that was there before stayed
    assert new > 0
    assert unfinished > 3  # killed while a file was being written
