"""Writers on a full disk, and interrupted: what was there stays, or all of the new is there."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import FS
from matplotlib.figure import Figure

from comparisons.bench import Sound, StudyReport, write_report
from kfopc_filterpy import _writing, fx_lms
from kfopc_filterpy.commands.paths import _write_path
from kfopc_filterpy.export import export_c
from kfopc_filterpy.plot import save_figure
from kfopc_filterpy.signals import write_wav


def report(title: str = "own") -> StudyReport:
    """Return a report whose sound tells its title."""
    sounds = [Sound(name, name, np.full(2000, float(len(title))), "", 0) for name in ("one", "two")]
    return StudyReport("own", title, "", FS, 1.0, {}, {}, sounds=sounds)


WRITERS: dict[str, Callable[[Path], object]] = {
    "S.csv": lambda folder: _write_path(str(folder / "S.csv"), np.ones(300), FS, "1"),
    "S.NPY": lambda folder: _write_path(str(folder / "S.NPY"), np.ones(300), FS, "1"),
    "error.wav": lambda folder: write_wav(folder / "error.wav", np.ones(500), FS),
    "figure.svg": lambda folder: save_figure(Figure(), folder / "figure"),
    "anc.c": lambda folder: export_c(fx_lms(8, [1.0], step_size=0.1), folder / "anc.c"),
    "run.npz": lambda folder: fx_lms(500, [1.0], step_size=0.1).save(folder / "run.npz"),
    "report.html": lambda folder: write_report([report()], folder),
}


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@contextmanager
def full_disk() -> Iterator[None]:
    """Let no file grow beyond 200 bytes, as a full disk would not."""
    resource = pytest.importorskip("resource", reason="Windows limits no file's size")
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))


@pytest.mark.parametrize("is_there", [True, False], ids=["replaced", "new"])
@pytest.mark.parametrize("name", WRITERS)
def test_on_a_full_disk_everything_stays_as_it_was(name, is_there, tmp_path):
    if is_there:
        WRITERS[name](tmp_path)
        assert name in contents(tmp_path)
    before = contents(tmp_path)
    with full_disk(), pytest.raises(OSError):  # noqa: PT011  the writers' libraries word it
        WRITERS[name](tmp_path)
    assert contents(tmp_path) == before
    WRITERS[name](tmp_path)
    assert name in contents(tmp_path)


def test_the_error_names_the_file_and_not_the_one_beside_it(tmp_path):
    with full_disk(), pytest.raises(OSError, match=r"File too large: '.*/error\.wav'$"):
        WRITERS["error.wav"](tmp_path)
    for path, message in ((tmp_path / "no" / "x.wav", "folder .*no does not exist"), (tmp_path, "name a file in it")):
        with pytest.raises(OSError, match=message):
            write_wav(path, np.ones(3), FS)


def test_files_that_belong_together_are_new_once_all_are_written_with_those_at_the_top_last(tmp_path, monkeypatch):
    def interrupted():
        with _writing.replacing_files(tmp_path) as new:
            (new / "page").write_text("new")
            raise KeyboardInterrupt

    (tmp_path / "page").write_text("old")
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert contents(tmp_path) == {"page": b"old"}
    moved = []
    monkeypatch.setattr(
        _writing.os, "replace", lambda source, to, move=os.replace: moved.append(to) or move(source, to)
    )
    with _writing.replacing_files(tmp_path) as new:
        (new / "audio" / "deep").mkdir(parents=True)
        for name in ("page", "audio/deep/sound", "audio/sound"):
            (new / name).write_text("new")
    assert [str(to.relative_to(tmp_path)) for to in moved] == ["audio/deep/sound", "audio/sound", "page"]
    assert contents(tmp_path) == dict.fromkeys(("page", "audio/deep/sound", "audio/sound"), b"new")


def test_what_a_killed_process_left_is_removed_after_an_hour(tmp_path):
    old, own, other = (tmp_path / f".{name}.part" for name in ("x[1].wav.old", "x[1].wav.own", "x1.wav.old"))
    for path in (old, own, other):
        path.write_text("")
    for path in (old, other):
        os.utime(path, (0, 0))
    write_wav(tmp_path / "x[1].wav", np.ones(3), FS)
    assert sorted(path.name for path in tmp_path.iterdir()) == [other.name, own.name, "x[1].wav"]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such files")
def test_what_is_no_file_stays_what_it_is(tmp_path: Path) -> None:
    pipe = tmp_path / "S.wav"
    os.mkfifo(pipe)
    with subprocess.Popen(["cat", str(pipe)], stdout=subprocess.PIPE) as reader:
        write_wav(pipe, np.ones(500), FS)
        got = reader.communicate()[0]
    assert pipe.is_fifo()
    write_wav(tmp_path / "file.wav", np.ones(500), FS)
    assert got == (tmp_path / "file.wav").read_bytes()
    os.mkfifo(tmp_path / "anc.c")
    with pytest.raises(FileExistsError, match=r"anc\.c is there and is no file"):  # which come together
        WRITERS["anc.c"](tmp_path)
    assert (tmp_path / "anc.c").is_fifo()
    assert not (tmp_path / "anc.h").exists()
    if Path("/dev/full").exists():
        link = tmp_path / "full.wav"
        link.symlink_to("/dev/full")
        with pytest.raises(OSError, match="No space"):
            write_wav(link, np.ones(500), FS)
        assert Path("/dev/full").is_char_device()


def test_a_name_may_be_as_long_as_the_system_lets_it(tmp_path: Path) -> None:
    name = 120 * "ä" + ".wav"  # 244 bytes
    write_wav(tmp_path / name, np.ones(500), FS)
    assert [path.name for path in tmp_path.iterdir()] == [name]
