"""The benchmark: its tasks, its scores against closed forms, peers against our own filters, and commands that fail."""

from __future__ import annotations

import json
import os
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.pages import ROOT
from helpers.results import single_result

from comparisons.bench import Algorithm, Runs, algorithms, make_controller
from comparisons.bench.registry import registered
from comparisons.benchmark import study, tasks
from comparisons.benchmark.blocks import MOST_SAID, CommandController, EntryFailed
from comparisons.benchmark.entries import peers, rivals
from comparisons.benchmark.tasks import FOLDER, LeftOut, Task, read_task
from kfopc_filterpy import fx_nlms

PAGE = (ROOT / "docs" / "benchmark.md").read_text(encoding="utf-8")
PRINTED = (ROOT / "docs" / "benchmark.txt").read_text(encoding="utf-8")
PYTHON = re.findall(r"^```python\n(.*?)^```", PAGE, re.M | re.S)
FILES = sorted(FOLDER.glob("*.toml"))


@pytest.fixture(scope="module")
def short() -> Task:
    """A quarter of a second of band noise."""
    task = read_task(FOLDER / "bandpass.toml")
    cut = [[signal[:2000] for signal in signals] for signals in (task.references, task.disturbances)]
    return replace(task, references=cut[0], disturbances=cut[1])


# ---- Tasks


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_task_has_the_delay_of_a_block_and_settles_after_its_change(file: Path) -> None:
    try:
        task = read_task(file)
    except LeftOut as error:
        pytest.skip(str(error))
    assert not task.secondary[..., : task.block].any()
    assert task.secondary[..., task.block].any() or task.secondary[..., task.block + 1 :].any()
    assert task.changed_at_s < task.references[0].shape[-1] / task.fs / 2  # the half that counts is after it


def test_the_page_shows_scores_of_the_tasks_as_they_are() -> None:
    shown = dict(re.findall(r"^(\S+) \[(\w{12})\]:", PRINTED, re.M))
    assert shown
    assert shown == {name: tasks.digest_of(FOLDER / f"{name}.toml") for name in shown}


def test_a_task_says_that_its_signals_are_no_longer_those_of_its_hash(tmp_path: Path) -> None:
    task = FOLDER / "bandpass.toml"
    text = task.read_text(encoding="utf-8")
    other = tmp_path / "other.toml"
    other.write_text(text + "\n# a comment\n", encoding="utf-8")
    assert tasks.digest_of(other) == tasks.digest_of(task)
    other.write_text(text.replace("1500.0", "1400.0"), encoding="utf-8")
    assert tasks.digest_of(other) != tasks.digest_of(task)
    with pytest.raises(ValueError, match=r"other.toml was made for other signals: their hash is [0-9a-f]{64}, not"):
        read_task(other)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("n_taps =", "taps =", "changed.toml has the unknown key taps; its keys are title, fs, duration_s, n_taps"),
        ("title", "change = 'loss'\ntitle", "change must be one of 'nothing', \"primary path's sign\""),
        ('model = "band"', 'model = "hiss"', r"\[noise\]: model must be one of 'band', 'compressor'"),
    ],
)
def test_a_misspelt_key_is_refused(tmp_path: Path, old: str, new: str, says: str) -> None:
    text = (FOLDER / "bandpass.toml").read_text(encoding="utf-8")
    assert text.count(old) == 1
    (tmp_path / "changed.toml").write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(ValueError, match=says):
        read_task(tmp_path / "changed.toml")


def test_a_task_takes_what_it_leaves_out_from_the_one_that_it_is_like() -> None:
    like, own = (read_task(FOLDER / f"event-{name}.toml") for name in ("primary-sign", "secondary-sign"))
    np.testing.assert_array_equal(like.references, own.references)
    at = round(like.changed_at_s * like.fs)
    np.testing.assert_array_equal(like.disturbances[0][:at], own.disturbances[0][:at])
    np.testing.assert_array_equal(like.disturbances[0][at:], -own.disturbances[0][at:])
    np.testing.assert_array_equal(own.plant.at(0.0).secondary, -own.plant_of(None).at(own.changed_at_s).secondary)
    assert (own.n_taps, own.other_packages) == (64, False)


def test_controllers_hear_a_fault_of_the_reference_and_settings_do_not() -> None:
    task, same = (read_task(FOLDER / f"event-{name}.toml") for name in ("reference-click", "primary-sign"))
    assert task.filtered_power == same.filtered_power  # by which step sizes are scaled

    class Listening:
        def __init__(self) -> None:
            self.heard: list[float] = []

        def control_signal(self, reference: float) -> float:
            self.heard.append(reference)
            return 0.0

        def update(self, error: float) -> None: ...

    one: Any = Listening()
    task.run(one, 1)
    at = round(task.changed_at_s * task.fs)
    assert max(map(abs, one.heard)) == one.heard[at] > 1e3 * np.max(np.abs(task.references[1]))
    np.testing.assert_array_equal(np.delete(one.heard, at), np.delete(task.references[1], at))


def test_a_task_without_its_data_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tasks, "measured_data", lambda: None)
    with pytest.raises(LeftOut, match="set KFOPC_DATA"):
        read_task(FOLDER / "measured-duct.toml")


# ---- Scores


def test_the_figures_of_a_made_up_run(short: Task) -> None:
    """The error is d, and from 0.5 s on a tenth of it; one second is three times as loud as d."""
    task = replace(short, changed_at_s=0.25)
    d, fs = np.ones(8 * 8000), task.fs
    e = np.where(np.arange(d.size) < 0.5 * fs, 1.0, 0.1)
    e[2 * 8000 : 3 * 8000] = 3.0
    y = np.full(d.size, np.sqrt(0.5))
    result = single_result(d.size, fs, error=e, disturbance=d, control_signal=y)
    one = study.score(task, "made up", result, bound_db=23.0)
    assert one.noise_reduction_db == pytest.approx(20.0)
    assert one.below_bound_db == pytest.approx(3.0)
    assert one.power == pytest.approx(0.5)
    assert one.loudest_second_db == pytest.approx(20 * np.log10(3.0))
    # 90 % of 20 dB are reached when 1 - 0.99 p of the window of 50 ms is 10^-1.8, p = 0.994: 397.7 samples
    assert one.time_s == pytest.approx(0.25 + 397 / fs)
    later = study.score(replace(task, changed_at_s=3.0), "made up", result, bound_db=23.0)
    assert later.loudest_second_db == pytest.approx(-20.0)  # before the change, nothing counts
    over = study.score(replace(task, rated_power=0.4), "made up", result, bound_db=23.0)
    assert not over.within_rating
    assert np.isnan(over.below_bound_db)


def test_the_place_is_that_in_the_table() -> None:
    names = {"best": 10.0, "KF-PB": 9.5, "worse": 9.0}
    scores = [study.Score(name, reduction, power=1.0) for name, reduction in names.items()]
    over, broken = study.Score("over", 20.0, power=2.0), study.Score("broken", failed="out of order")
    assert study.place([*scores, over, broken]) == "KF-PB has place 2 of 5, 0.50 dB behind best."
    assert study.place([*scores[1:], over]) == "KF-PB has place 1 of 3."
    assert study.place([scores[0], broken]) == ""


# ---- Entries


@pytest.mark.parametrize(
    ("theirs", "same", "tolerance"),
    [
        ("padasip RLS", "FxRLS", 1e-3),  # P ages otherwise in the silence before the first block
        ("pyroomacoustics RLS", "padasip RLS", 1e-6),
        ("padasip NLMS", "adafilt NLMS", 1e-9),
    ],
)
def test_filters_that_are_one_algorithm_agree(short: Task, theirs: str, same: str, tolerance: float) -> None:
    """In the modified structure and at one setting, over 2000 steps in forms that round differently."""
    found = {re.sub(r" \S+", "", name, count=1): own for name, own in peers().items()}  # without the version
    setting = 1e-4 if "RLS" in theirs else 0.25
    with registered(found):
        one, other = (short.run(make_controller(short, name, setting), 1).error for name in (theirs, same))
    assert np.linalg.norm(one - other) < tolerance * np.linalg.norm(other)


def test_every_entry_has_a_score_or_a_reason(short: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "timed", lambda run: (run(), 2.0))

    class Broken:
        def __init__(self, n_taps: int, secondary: Any, **_: Any) -> None:
            raise RuntimeError("out of order")

    broken = Algorithm(Broken, lambda task, mu, _: {}, "mu", "mu", (0.1,))
    entries = {**rivals(), "broken": broken, "command": "no-such-program"}
    outcome = study.run_task(Runs(), short, entries, only="[FKsbc]*")
    scores = {one.entry: one for one in outcome["scores"]}
    assert set(scores) == {name for name in (*entries, *algorithms()) if name[0] in "FKsbc"}
    failed = {name: one.failed for name, one in scores.items() if one.failed}
    assert failed == {
        "broken": "RuntimeError: out of order",
        "command": "cannot be started: [Errno 2] No such file or directory: 'no-such-program'",
    }
    within = [one for one in outcome["scores"] if one.within_rating]
    assert list(outcome["scores"][: len(within)]) == within
    assert all(one.below_bound_db > -0.5 for one in within)  # an adaptive filter may follow the noise a little
    assert scores["FxLMS"].cost == 1.0
    assert "failed: RuntimeError: out of order" in study.table(outcome)


# ---- Commands


def command(tmp_path: Path, text: str) -> str:
    file = tmp_path / "entry.py"
    file.write_text(f"import sys\nsys.path.append({str(ROOT)!r})\n{text}", encoding="utf-8")
    return f"{sys.executable} {file}"


def test_the_command_of_the_page_gives_the_run_of_the_object(short: Task, tmp_path: Path) -> None:
    """Its blocks hold what a run sample by sample holds, because the secondary path begins with a block of zeros."""
    (text,) = [text for text in PYTHON if "fx_nlms" in text]
    assert len(text.strip().splitlines()) <= 12
    with CommandController(short, command(tmp_path, text)) as entry:
        blocks = short.run(entry, 1)
    s, delay = short.known_secondary, short.block
    own = short.run(fx_nlms(short.n_taps, s, step_size=0.1, regularization=1.0), 1)
    np.testing.assert_allclose(blocks.error, own.error, atol=1e-9)
    np.testing.assert_allclose(blocks.control_signal[delay:], own.control_signal[:-delay], atol=1e-9)


def test_the_object_of_the_page_runs(short: Task, inside: Path, monkeypatch, capsys) -> None:
    (text,) = [text for text in PYTHON if "control_signal" in text]
    monkeypatch.setattr(study, "read_task", lambda path: replace(short, name=path.stem))
    exec(compile(text, "page", "exec"), {"__name__": "__main__"})
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("mine")]
    assert rows
    assert "failed" not in "".join(rows)
    written = json.loads((inside / "benchmark" / "benchmark.json").read_text(encoding="utf-8"))
    assert "mine" in [one["entry"] for one in written["tasks"]["bandpass"]["scores"]]


HEAD = "import sys\nread, write = sys.stdin.buffer.read, sys.stdout.buffer.write\nsys.stdin.buffer.readline()\n"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("raise SystemExit('no licence')", "answered 0 of 128 bytes in block 0 and ended with status 1: no licence"),
        ("raise SystemExit('ended first')", "answered 0 of 128 bytes in block 0 and ended with status 1: ended first"),
        (HEAD + "read(256), write(bytes(64))", "answered 64 of 128 bytes in block 0 and ended with status 0"),
        (HEAD + "read(256), write(b'\\xff' * 128), sys.stdout.flush(), read()", "answered NaN or Inf in block 0"),
        (HEAD + "read()", "took longer than 0.5 s for a run"),
        (
            HEAD + "while read(256): write(bytes(128)), sys.stdout.flush()\nwrite(b'more')",
            "answered more than it was asked for",
        ),
    ],
)
def test_a_command_that_fails_says_why(short: Task, tmp_path: Path, text: str, says: str) -> None:
    limit_s = 0.5 if "took" in says else 600.0
    entry = CommandController(short, command(tmp_path, text), limit_s)
    if "ended first" in says:
        entry._process.wait()
    with pytest.raises(EntryFailed, match=says), entry:
        short.run(entry)


def test_of_what_a_command_complains_the_end_is_told(short: Task, tmp_path: Path) -> None:
    text = "import sys\nraise SystemExit('x' * 1_000_000 + ' the end')"
    with (
        pytest.raises(EntryFailed, match="x the end") as told,
        CommandController(short, command(tmp_path, text)) as entry,
    ):
        short.run(entry)
    assert MOST_SAID < len(str(told.value)) < MOST_SAID + 200


def write_for_ever(descriptor: int) -> None:
    while True:
        os.write(descriptor, bytes(1 << 16))


@pytest.mark.skipif(os.name == "nt", reason="Windows has no groups of processes")
def test_what_a_command_has_started_ends_with_it(short: Task, tmp_path: Path) -> None:
    """A grandchild reads from a pipe, to which nobody can write any more once it has ended."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    start = f"import subprocess\nsubprocess.Popen(['cat', {str(pipe)!r}], stdout=sys.stderr)\n"
    with CommandController(short, command(tmp_path, start + HEAD), 600.0) as entry:
        held = os.open(pipe, os.O_WRONLY)  # waits for the grandchild
        with pytest.raises(EntryFailed):
            short.run(entry)
    with pytest.raises(BrokenPipeError):
        write_for_ever(held)
    os.close(held)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--tasks", "none"], "no task fits none; there are bandpass"),
        (["--entry", "name"], "--entry must be NAME=COMMAND"),
        (
            ["--only", "KF-BP", "--tasks", "bandpass"],
            "no task was run; the entries that --only can name are KF-ANC, KF-OPC",
        ),
    ],
)
def test_the_command_line_says_what_is_wrong(arguments: list[str], says: str, inside: Path, capsys) -> None:
    with pytest.raises(SystemExit):
        study.main(arguments)
    assert says in capsys.readouterr().err
