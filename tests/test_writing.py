"""Writers on a full disk, interrupted at any line, and beside each other: what was there stays, or all of the new is there."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import FS, ROOT, SCENE
from matplotlib.figure import Figure

from comparisons.bench import Sound, StudyReport, write_report
from kfopc_filterpy import _writing, fx_lms
from kfopc_filterpy.commands import main
from kfopc_filterpy.export import export_c
from kfopc_filterpy.plot import save_figure
from kfopc_filterpy.signals import write_wav


def report(title: str = "own") -> StudyReport:
    """Return a report whose sound tells its title."""
    sounds = [Sound(name, name, np.full(2000, float(len(title))), "", 0) for name in ("one", "two")]
    return StudyReport("own", title, "", FS, 1.0, {}, {}, sounds=sounds)


def convert(folder: Path, name: str) -> None:
    if main(["paths", "convert", str(folder / "S.wav"), "-o", str(folder / name)]):
        raise OSError


WRITERS: dict[str, Callable[[Path], object]] = {
    "S.wav, its own source": lambda folder: convert(folder, "S.wav"),
    "S.csv": lambda folder: convert(folder, "S.csv"),
    "S.NPY": lambda folder: convert(folder, "S.NPY"),
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
    write_wav(tmp_path / "S.wav", np.linspace(-1, 1, 300), FS)
    if is_there:
        WRITERS[name](tmp_path)
        assert name.split(",")[0] in contents(tmp_path)
    before = contents(tmp_path)
    with full_disk(), pytest.raises(OSError):  # noqa: PT011  the writers' libraries word it
        WRITERS[name](tmp_path)
    assert contents(tmp_path) == before
    WRITERS[name](tmp_path)
    assert name.split(",")[0] in contents(tmp_path)


def test_the_error_names_the_file_and_not_the_one_beside_it(tmp_path):
    with full_disk(), pytest.raises(OSError, match=r"File too large: '.*/error\.wav'$"):
        WRITERS["error.wav"](tmp_path)
    for path, message in ((tmp_path / "no" / "x.wav", "folder .*no does not exist"), (tmp_path, "name a file in it")):
        with pytest.raises(OSError, match=message):
            write_wav(path, np.ones(3), FS)


@contextmanager
def interrupt_at(line: int) -> Iterator[None]:
    """Raise KeyboardInterrupt at the n-th line of the module that writes.

    Not in the function that opens a folder: between the opening and the closing of a descriptor CPython lets no signal in.
    """
    lines = 0

    def trace(frame, event, argument):
        nonlocal lines
        code = frame.f_code
        if code.co_filename == _writing.__file__ and code.co_name != "_opened" and event == "line":
            lines += 1
            if lines == line:
                sys.settrace(None)
                raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        yield
    finally:
        sys.settrace(before)


def test_files_that_belong_together_are_all_old_or_all_new_at_whatever_line_their_writer_is_interrupted(tmp_path):
    """Each file states the number of taps: no mixture passes."""
    controllers = [fx_lms(taps, [1.0], step_size=0.1) for taps in (8, 9)]
    whole = []
    for controller in controllers:
        export_c(controller, tmp_path / "anc.c")
        whole.append(contents(tmp_path))
    assert all(whole[0][name] != whole[1][name] for name in ("anc.c", "anc.h"))
    seen, line, interrupted = [0, 0], 0, True
    while interrupted:
        line += 1
        folder = tmp_path / str(line)
        folder.mkdir()
        export_c(controllers[0], folder / "anc.c")
        try:
            with interrupt_at(line):
                export_c(controllers[1], folder / "anc.c")
            interrupted = False
        except KeyboardInterrupt:
            pass
        left = {name: content for name, content in contents(folder).items() if name[0] != "."}
        assert left in whole, line
        seen[whole.index(left)] += 1
    assert min(seen) >= 1
    assert seen[0] > 30


WRITE = """
import sys
sys.path[:0] = sys.argv[1:3]
from test_writing import report, write_report
for _ in range(12):
    write_report([report(sys.argv[4])], sys.argv[3])
"""


def test_processes_that_write_one_folder_do_not_fail_and_do_not_mix(tmp_path):
    titles = ("old", "newer", "newest")
    command = [sys.executable, "-c", WRITE, str(ROOT), str(ROOT / "tests"), str(tmp_path / "out")]
    writing = [subprocess.Popen([*command, title], stderr=subprocess.PIPE, text=True) for title in titles]
    errors = [one.communicate()[1] for one in writing]
    assert [one.returncode for one in writing] == [0, 0, 0], errors
    left = contents(tmp_path / "out")
    for title in titles:
        write_report([report(title)], tmp_path / title)
    assert left in [contents(tmp_path / title) for title in titles]


INTERRUPTED = """
import signal, sys
from kfopc_filterpy import __main__, _writing

def move(*paths, left=[int(sys.argv.pop(1))], move=_writing._move):
    move(*paths)
    left[0] -= 1
    if left[0] == 0:
        signal.raise_signal(signal.SIGINT)

_writing._move = move
sys.exit(__main__.main())
"""


@pytest.mark.parametrize("renames", [1, 3], ids=["the old page is aside", "new files are in their places"])
def test_an_interrupted_verdict_leaves_the_folder_as_it_was(renames, tmp_path):
    noise = np.random.default_rng(0).standard_normal(5 * FS // 2)
    for name, samples in {"noise": noise, "P": np.eye(64)[26], "S": np.eye(64)[12]}.items():
        write_wav(tmp_path / f"{name}.wav", samples, FS)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "verdict.html").write_text("an older page")
    before = contents(tmp_path)
    command = [sys.executable, "-c", INTERRUPTED, str(renames)]
    command += ["verdict", *SCENE, "--rated-power", "4", "--taps", "16", "-o", "out", "--quiet"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 130, done
    assert done.stderr.endswith("kfopc: interrupted; each file is as it was, or was written whole\n")
    assert contents(tmp_path) == before


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
