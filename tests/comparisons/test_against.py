"""The comparison with an earlier version: what counts as moved, its cases, and what it refuses. It runs no version."""

from __future__ import annotations

import inspect
import io
import json
import subprocess
import sys
import tarfile
from pathlib import Path

import numpy as np
import pytest

import kfopc_filterpy
from comparisons.__main__ import main
from comparisons.against import command, driver
from kfopc_filterpy import controllers
from kfopc_filterpy.controllers import Controller


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ([1.0, -2.0], [1.0, -2.0], 0.0),
        ([1.0, -4.0], [1.0, -3.0], 0.25),
        ([0.0, 0.0], [0.0, 0.0], 0.0),
        ([0.0, 0.0], [0.0, 1e-30], np.inf),
        ([1.0, np.nan], [1.0, np.nan], 0.0),
        ([1.0, np.nan], [np.nan, 1.0], np.inf),
        ([1.0, np.nan], [1.0, 1.0], np.inf),
        ([1.0, np.inf], [1.0, np.inf], 0.0),
        ([1.0, np.inf], [1.0, -np.inf], np.inf),
        ([1.0, 2.0], [1.0], np.inf),
        ([[1.0, 2.0]], [1.0, 2.0], np.inf),
        ([], [], 0.0),
        (np.nan, np.nan, 0.0),
        (2.0, 3.0, 0.5),
    ],
)
def test_the_difference_is_relative_to_the_largest_value(old: object, new: object, expected: float) -> None:
    assert command.relative_difference(old, new) == expected


def test_a_case_is_judged_by_the_array_that_moved_most() -> None:
    old = {"error": np.array([1.0, 2.0, 4.0]), "weights": np.ones(2)}
    row = command.compared("a", old, old | {"error": np.array([1.0, 2.0, 4.0 + 4e-8]), "weights": np.ones(2) + 1e-9})
    assert (row.samples, row.where, row.status) == (3, "error", command.MOVED)
    assert row.difference == pytest.approx(1e-8)
    within = command.compared("a", old, old | {"weights": np.ones(2) + 0.9e-9})
    assert (within.where, within.status) == ("weights", command.OK)


def test_a_case_moves_if_it_fails_or_is_in_one_version_only() -> None:
    old, failed = {"error": np.ones(3)}, {"failed": np.array("ValueError: no")}
    for row, where in [
        (command.compared("a", old, None), "only in the old version"),
        (command.compared("a", None, old), "only in the new version"),
        (command.compared("a", old, failed), "new: ValueError: no"),
        (command.compared("a", failed, failed), "old: ValueError: no; new: ValueError: no"),
        (command.compared("a", old, old | {"x": np.ones(1)}), "x only in one version"),
    ]:
        assert (row.where, row.difference, row.status) == (where, np.inf, command.MOVED)


def test_a_known_move_is_named_with_its_reason_as_far_as_it_may_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "KNOWN", {"tone: *": (1e-6, "sums in another order")})
    assert command.Row("tone: MOV", 10, 1e-7, "error").status == command.IS_KNOWN
    assert "sums in another order" in str(command.Row("tone: MOV", 10, 1e-7, "error"))
    assert command.Row("tone: MOV", 10, 1e-5, "error").status == command.MOVED
    assert command.Row("band noise: MOV", 10, 1e-7, "error").status == command.MOVED


def version(folder: Path, cases: dict[str, dict[str, object]]) -> command.Version:
    """A version whose results are there."""
    folder.mkdir()
    for index, result in enumerate(cases.values()):
        np.savez(folder / f"{index}.npz", **result)  # type: ignore[arg-type]
    text = {"package": "", "cases": list(cases), "skipped": {"room": "no data"}}
    (folder / driver.LIST).write_text(json.dumps(text), encoding="utf-8")
    return command.Version(folder, sys.executable, folder)


def test_the_table_and_the_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "run_cases", lambda versions, only: None)
    old = version(tmp_path / "old", {"a": {"error": np.ones(8)}, "b": {"error": np.ones(4)}})
    new = version(tmp_path / "new", {"b": {"error": np.ones(4)}, "a": {"error": np.ones(8)}})
    wrong = version(tmp_path / "wrong", {"b": {"failed": "ValueError: no"}, "a": {"error": np.ones(8)}})
    assert command.compare(old, new, "") == 0
    assert "2 cases, largest relative difference 0.0e+00, 0 MOVED" in capsys.readouterr().out
    assert command.compare(old, wrong, "") == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:4] for line in lines[1:3]] == [["b", "0", "inf", "MOVED"], ["a", "8", "0.0e+00", "ok"]]
    assert lines[-1].endswith("new: ValueError: no")
    assert "skipped: room: no data" in lines


def test_a_process_that_dies_fails_its_case_and_the_others_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = tmp_path / "driver.py"
    script.write_text(
        "import json, os, sys, pathlib\n"
        "folder = pathlib.Path(sys.argv[2])\n"
        "text = {'package': os.environ['PYTHONPATH'] + '/p.py', 'cases': ['a', 'b', 'c'], 'skipped': {}}\n"
        f"(folder / '{driver.LIST}').write_text(json.dumps(text))\n"
        "import numpy as np\n"
        "for i in range(3):\n"
        "    if not (folder / f'{i}.npz').exists():\n"
        "        if i == 1: os.abort()\n"
        "        np.savez(folder / f'{i}.npz', error=np.ones(2))\n",
        encoding="utf-8",
    )
    monkeypatch.setattr(command, "DRIVER", script)
    one = command.Version(tmp_path, sys.executable, tmp_path)
    command.run_cases([one], "")
    results, _ = command.read_results(tmp_path)
    assert str(results["b"]["failed"]).startswith("the process ended with -6")
    assert [sorted(result) for result in results.values()] == [["error"], ["failed"], ["error"]]


def test_a_driver_that_runs_another_package_is_refused(tmp_path: Path) -> None:
    one = command.Version(tmp_path, sys.executable, tmp_path)
    one.require_own_package(str(tmp_path / "kfopc_filterpy" / "__init__.py"))
    with pytest.raises(command.AgainstError, match="not that of"):
        one.require_own_package("/elsewhere/kfopc_filterpy/__init__.py")


# Arguments.


def test_a_revision_that_does_not_exist_gives_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["against", "no-such-revision"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = captured.err.splitlines()
    assert line.startswith("there is no revision no-such-revision in ")


def test_wrong_arguments(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, message in [
        (["against", "--rounds", "0"], "--rounds must be 1 or more, got 0"),
        (["against", "--nothing"], "unrecognized arguments: --nothing"),
        (["tonal", "against"], "against runs alone"),
    ]:
        with pytest.raises(SystemExit) as error:
            main(arguments)
        assert error.value.code == 2
        assert message in capsys.readouterr().err


def test_help_names_the_default_revision(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["against", "--help"])
    assert f"(default: {command.BEFORE_CORE[:7]})" in capsys.readouterr().out
    assert len(command.BEFORE_CORE) == 40


def test_a_revision_is_checked_out_once_if_it_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w") as archive:
        archive.add(__file__, "kfopc_filterpy/__init__.py")
    answers = {"rev-parse": b"1234\n", "archive": content.getvalue()}
    asked: list[str] = []

    def git(*arguments: str) -> bytes:
        asked.append(arguments[0])
        return answers[arguments[0]]

    monkeypatch.setattr(command, "git", git)
    for _ in range(2):
        with command.earlier_tree("tag", tmp_path) as tree:
            assert tree == tmp_path.resolve() / "1234"
            assert (tree / "kfopc_filterpy" / "__init__.py").is_file()
    assert asked == ["rev-parse", "archive", "rev-parse"]
    with command.earlier_tree("tag", None) as temporary:
        assert (temporary / "kfopc_filterpy" / "__init__.py").is_file()
    assert not temporary.exists()
    with command.earlier_tree(str(tree), None) as same:  # a folder that has the package
        assert same == tree


# Cases.


def test_every_controller_of_the_package_is_in_a_case() -> None:
    """Those that others make or wrap are named by what makes them."""
    text = inspect.getsource(driver)
    made_by_functions = {"CoreController", "DirectKalman", "PowerBudgetController"}
    for namespace in (kfopc_filterpy, controllers):
        for name in namespace.__all__:
            value = getattr(namespace, name)
            is_controller = isinstance(value, type) and hasattr(value, "control_signal") and hasattr(value, "update")
            if (is_controller and value is not Controller) or name.startswith(("kf_", "fx_")):
                assert name in made_by_functions or f"{name}" in text, name


def test_cases_can_be_listed_without_data_and_those_skipped_say_why(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("KFOPC_DATA", str(tmp_path))
    cases, skipped = driver.all_cases()
    assert set(skipped) == {"compressor, duct", "motor, duct", "room"}
    assert all("is missing" in reason for reason in skipped.values())
    assert {"band noise: KF-OPC", "2 x 2 x 2: FxLMS", "blocks: KF-PB", "filter: KFOPC"} <= set(cases)


def test_the_loop_that_python_runs_is_the_one_of_simulate() -> None:
    """The same FxLMS with the same noise; up to the change of the secondary path."""
    scene = driver.one_channel(driver.noises()["band noise"][: driver.STEPPED_SAMPLES])
    make = driver.SINGLE["FxLMS"]
    one, other = driver.simulated(make, scene), driver.called(make, scene, blocks=False)
    half = driver.STEPPED_SAMPLES // 2
    np.testing.assert_allclose(other["control_signal"][0, :half], one["control_signal"][:half], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(other["error"][0, :half], one["error"][:half], rtol=1e-9, atol=1e-12)


def test_the_driver_writes_its_cases_and_keeps_those_that_are_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def failing() -> dict[str, object]:
        raise ValueError("no solution")

    cases = {"tone: A": failing, "tone: B": failing, "tone: C": lambda: {"error": np.ones(3)}, "motor: D": failing}
    monkeypatch.setattr(driver, "all_cases", lambda: (cases, {"room": "no data"}))
    np.savez(tmp_path / "0.npz", failed="earlier")
    driver.write_cases(tmp_path, "TONE")
    results, skipped = command.read_results(tmp_path)
    assert skipped == {"room": "no data"}
    assert list(results) == ["tone: A", "tone: B", "tone: C"]
    assert [str(results[f"tone: {name}"]["failed"]) for name in "AB"] == ["earlier", "ValueError: no solution"]
    np.testing.assert_array_equal(results["tone: C"]["error"], 1.0)


def test_the_default_revision_is_a_commit_of_this_repository() -> None:
    if subprocess.run(["git", "rev-parse", "HEAD"], cwd=command.ROOT, capture_output=True, check=False).returncode:
        pytest.skip("not a clone")
    kind = command.git("cat-file", "-t", command.BEFORE_CORE).strip()
    if not kind:
        pytest.skip("a clone without that commit")
    assert kind == b"commit"
