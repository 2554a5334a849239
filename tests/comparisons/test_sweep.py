"""A sweep's grid, tables, folder, figure and command line, with scenarios that take no time."""

from __future__ import annotations

import csv
import json
import math
import shutil
from contextlib import chdir

import numpy as np
import pytest
from scipy import stats

from comparisons.__main__ import main
from comparisons.sweep.command import parsed_values
from comparisons.sweep.grid import AXES, built_in_grid, own_grid
from comparisons.sweep.results import cell_rows, mean_and_interval, sweep_figure
from comparisons.sweep.run import run_sweep
from comparisons.sweep.scenario import ScenarioError
from comparisons.sweep.store import keep, kept

CALLS: list[tuple] = []


def plane(scenario):
    CALLS.append((scenario["slope"], scenario["kind"], scenario["seed"]))
    noise = np.random.default_rng(scenario["seed"]).standard_normal()
    return {"height": 2.0 * scenario["slope"] + noise, "count": 3}


def moody(scenario):
    if scenario["seed"] == 2 or scenario["mood"] == "bad":
        return {"height": None, "diverged": True}
    if scenario["mood"] == "broken":
        raise ArithmeticError("out of mood")
    return {"height": 1.0}


def swept(folder, grid=None, scenario=plane, **options):
    grid = {"slope": [1.0, 2.0, 3.0], "kind": ["a", "b"]} if grid is None else grid
    return run_sweep(grid, folder, scenario=scenario, **({"seeds": 4, "jobs": 1, "quiet": True} | options))


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """A sweep of 24 runs, and its folder."""
    folder = tmp_path_factory.mktemp("sweep")
    return swept(folder), folder


@pytest.fixture
def done(first, tmp_path):
    """The sweep, and a copy of its folder."""
    return first[0], shutil.copytree(first[1], tmp_path / "done")


def read_csv(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


# The grid.


def test_every_combination_has_a_run_for_each_seed():
    grid = own_grid({"a": [1, 2], "b": "x", "c": (None, True, 0.5)}, [5, 0])
    runs = grid.runs()
    assert len(runs) == 2 * 1 * 3 * 2
    assert [(run["a"], run["c"], run["seed"]) for run in runs[:5]] == [
        (1, None, 5),
        (1, None, 0),
        (1, True, 5),
        (1, True, 0),
        (1, 0.5, 5),
    ]
    assert runs[3] == {"a": 1, "b": "x", "c": True, "seed": 0}
    assert grid.swept == ["a", "c"]


def test_axes_not_named_have_their_default():
    grid = built_in_grid({"rated_power_db": [-20, -10.0], "algorithm": "kf-pb"}, 2)
    assert list(grid.axes) == list(AXES)
    assert grid.axes["rated_power_db"] == (-20.0, -10.0)
    assert grid.axes["algorithm"] == ("KF-PB",)  # the name as the studies write it
    assert grid.axes["n_taps"] == (128,)
    assert grid.seeds == (1, 2)


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ({"colour": "red"}, "no axis called colour; there are path, noise"),
        ({"algorithm": "KF-XYZ"}, "algorithm must be one of KF-ANC, KF-OPC, .*got 'KF-XYZ'"),
        ({"algorithm": ["KF-OPC", "leaky FxLMS"]}, r'leaky FxLMS has two settings.*give setting "tuned"'),
        ({"path_delay": "late"}, "path_delay must be one of a number, got 'late'"),
        ({"algorithm": []}, "algorithm must have at least one value"),
        ({"n_taps": 0}, "n_taps must be at least 1, got 0"),
        ({"duration_s": [1.0, 0.0]}, "duration_s must be"),
        ({"setting": "best"}, "setting must be one of default, tuned, a number, got 'best'"),
        ({"rated_power_db": math.nan}, "rated_power_db must be"),
        ({"rated_power_db": [-10, -10.0]}, "rated_power_db must have at least one value, and none twice"),
    ],
)
def test_grid_refuses_what_is_no_axis_or_value(axes, message):
    with pytest.raises(ValueError, match=message):
        built_in_grid(axes, 1)


@pytest.mark.parametrize(
    ("axes", "seeds", "error", "message"),
    [
        ({"a": 1}, 0, ValueError, "seeds must be at least 1"),
        ({"a": 1}, [1, 1], ValueError, "seeds must have at least one value, and none twice"),
        ({"a": 1}, [-1], ValueError, "seeds must be at least 0"),
        ({}, 1, ValueError, "grid must have at least one axis"),
        ({"seed": [1]}, 1, ValueError, 'none called "seed"'),
        ({"a": [math.inf]}, 1, ValueError, "a must be finite"),
        ({"a": [object()]}, 1, TypeError, "a must hold numbers, strings, booleans or None, got object"),
    ],
)
def test_own_axes_and_seeds_refused(axes, seeds, error, message):
    with pytest.raises(error, match=message):
        own_grid(axes, seeds)


# Means and intervals.


def test_interval_is_that_of_scipy():
    values = np.random.default_rng(1).normal(3.0, 2.0, 9)
    mean, low, high, count = mean_and_interval(values)
    expected = stats.t.interval(0.95, 8, loc=np.mean(values), scale=stats.sem(values))
    assert (mean, count) == (pytest.approx(np.mean(values)), 9)
    np.testing.assert_allclose((low, high), expected, rtol=1e-12)  # the same formula, other order of operations


def test_no_interval_for_one_seed_and_nothing_for_none():
    np.testing.assert_equal(mean_and_interval([5.0]), (5.0, math.nan, math.nan, 1))
    np.testing.assert_equal(mean_and_interval([math.nan]), (math.nan, math.nan, math.nan, 0))


def test_divergence_is_counted_and_drops_no_cell(tmp_path):
    sweep = swept(tmp_path, {"mood": ["good", "bad"]}, moody, seeds=3)
    good, bad = sweep.cells
    assert (good["runs"], good["diverged"], good["height_n"], good["height_mean"]) == (3, 1, 2, 1.0)
    assert (bad["runs"], bad["diverged"], bad["height_n"]) == (3, 3, 0)
    assert math.isnan(bad["height_mean"])
    rows = read_csv(tmp_path / "cells.csv")
    assert [row["height_mean"] for row in rows] == ["1.0", ""]
    assert [row["diverged"] for row in read_csv(tmp_path / "runs.csv")] == ["False", "True", "False"] + 3 * ["True"]


# Tables.


def test_tables_hold_every_digit(done):
    sweep, folder = done
    rows = read_csv(folder / "runs.csv")
    assert [float(row["height"]) for row in rows] == [run["height"] for run in sweep.runs]
    assert [row["kind"] for row in rows[:8]] == 4 * ["a"] + 4 * ["b"]
    assert list(rows[0]) == ["slope", "kind", "seed", "height", "count", "diverged"]


def test_parquet_holds_what_csv_holds(tmp_path):
    """A column of names and numbers becomes one of strings."""
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow, the extra parquet, is not installed")
    sweep = swept(tmp_path, {"mood": ["good", "bad"], "level": [1, "loud"]}, moody, seeds=3, format="parquet")
    assert [path.name for path in sweep.files[:2]] == ["cells.parquet", "runs.parquet"]
    cells = parquet.read_table(tmp_path / "cells.parquet").to_pylist()
    assert [cell["level"] for cell in cells] == ["1", "loud", "1", "loud"]
    assert [cell["height_mean"] for cell in cells] == [1.0, 1.0, None, None]
    assert not list(tmp_path.glob(".*"))  # no partial file left


# The folder.


@pytest.mark.parametrize("cut", [0, 1, 20])
def test_what_is_done_is_not_done_again_and_a_torn_line_harms_no_other(done, cut):
    first, folder = done
    runs = folder / "runs.jsonl"
    whole = runs.read_bytes()
    kept = whole[: len(whole) - cut]  # the kernel wrote a part of the last line
    runs.write_bytes(kept)
    CALLS.clear()
    again = swept(folder)
    assert len(CALLS) == (1 if cut > 1 else 0)  # without its newline alone, the line is whole
    assert (again.runs, again.cells) == (first.runs, first.cells)
    assert runs.read_bytes().startswith(kept)  # nothing is rewritten


def test_bytes_that_are_no_text_are_done_again(done):
    first, folder = done
    lines = (folder / "runs.jsonl").read_bytes().splitlines(keepends=True)
    lines[3] = b"\0\xff" * 20 + b"\n"  # what a power cut may leave of a block
    (folder / "runs.jsonl").write_bytes(b"".join(lines))
    CALLS.clear()
    for calls in (1, 1):  # and then no more
        assert swept(folder).cells == first.cells
        assert len(CALLS) == calls


@pytest.mark.parametrize(
    ("grid", "options", "message"),
    [
        ({"slope": [1.0, 2.0], "kind": ["a", "b"]}, {}, r"axis slope is .* there, but \[1\.0, 2\.0\] here"),
        ({"slope": [1.0, 2.0, 3.0]}, {}, "axis kind is .* there, but null here"),
        ({"kind": ["a", "b"], "slope": [1.0, 2.0, 3.0]}, {}, "its axes have another order"),
        (None, {"seeds": 5}, r"seeds is \[1, 2, 3, 4\] there"),
        (None, {"scenario": moody}, "scenario is .*plane.*moody"),
    ],
)
def test_folder_of_another_sweep_is_refused(done, grid, options, message):
    kept = (done[1] / "runs.jsonl").read_bytes()
    with pytest.raises(ValueError, match=f"holds another sweep .{message}.*choose another output folder"):
        swept(done[1], grid, **options)
    assert (done[1] / "runs.jsonl").read_bytes() == kept


def test_folder_of_other_code_is_refused(done):
    description = json.loads((done[1] / "sweep.json").read_text())
    (done[1] / "sweep.json").write_text(json.dumps(description | {"SHA-256 of the code": "0" * 64}))
    with pytest.raises(ValueError, match="SHA-256 of the code is"):
        swept(done[1])


@pytest.mark.parametrize(("name", "text"), [("sweep.json", ""), ("sweep.json", "[1, 2]"), ("runs.jsonl", "")])
def test_folder_without_a_description_is_refused(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=r"has no readable sweep\.json: choose another output folder"):
        swept(tmp_path)


def test_numbers_survive_the_folder_exactly(tmp_path):
    figures = {"third": 1 / 3, "tiny": 5e-324, "none": math.nan, "endless": math.inf, "diverged": False}
    keep(tmp_path, {1: figures})
    read = kept(tmp_path)[1]
    assert (read["third"], read["tiny"], read["diverged"]) == (1 / 3, 5e-324, False)
    assert math.isnan(read["none"])
    assert math.isnan(read["endless"])  # no finite figure


# A scenario of one's own.


def test_exception_names_the_scenario_and_keeps_what_was_done(tmp_path):
    with pytest.raises(ScenarioError, match="scenario mood=broken, seed=1: ArithmeticError: out of mood"):
        swept(tmp_path, {"mood": ["good", "broken"]}, moody, seeds=[1, 3])
    assert len((tmp_path / "runs.jsonl").read_text().splitlines()) == 2


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (3.0, "dict of figures by name"),
        ({1: 2.0}, "dict of figures by name"),
        ({"a": "b"}, "figure 'a' .* must be a number"),
        ({"mood": 1.0}, "figure 'mood' has the name of an axis"),
    ],
)
def test_what_a_scenario_returns_is_checked(returned, message, tmp_path):
    with pytest.raises(ScenarioError, match=message):
        swept(tmp_path, {"mood": ["good"]}, lambda scenario: returned)


def test_arguments_that_do_not_fit_are_refused(tmp_path):
    with pytest.raises(TypeError, match="scenario must be a function"):
        swept(tmp_path, scenario="plane")
    with pytest.raises(ValueError, match="either jobs or scheduler"):
        swept(tmp_path, scheduler="tcp://127.0.0.1:1")
    with pytest.raises(ValueError, match="jobs must be at least 1"):
        swept(tmp_path, jobs=0)


# The figure.


def test_figure_shows_the_means_and_intervals():
    grid = own_grid({"slope": [3.0, 1.0], "kind": ["a", "b"], "level": [5]}, 3)
    figures = [
        {
            "height": run["slope"] * run["seed"] + (run["kind"] == "b"),
            "diverged": run["kind"] == "a" and run["seed"] > 3,
        }
        for run in grid.runs()
    ]
    (ax,) = sweep_figure(grid, cell_rows(grid, figures), ["height"]).axes
    lines, bars = zip(*[(c.lines[0], c.lines[2][0]) for c in ax.containers], strict=True)
    for line, own, kind in zip(lines, bars, ("a", "b"), strict=True):
        np.testing.assert_array_equal(line.get_xdata(), [1.0, 3.0])  # in order, whatever the grid's
        np.testing.assert_allclose(line.get_ydata(), np.array([2.0, 6.0]) + (kind == "b"))
        half = stats.t.ppf(0.975, 2) / np.sqrt(3)  # of seeds 1, 2, 3
        ends = np.array([segment[:, 1] for segment in own.get_segments()])
        np.testing.assert_allclose(ends[:, 1] - ends[:, 0], 2 * half * np.array([1.0, 3.0]))
    assert ax.get_legend_handles_labels()[1] == ["a", "b"]


# The command line.


@pytest.mark.parametrize("text", ["1,,2", "1:2", "1:2:1", "1:2:3:4", "a:b:3", "0:1:3:log", "1:inf:3"])
def test_lists_refused(text):
    with pytest.raises(ValueError, match="axis must be values separated by commas, or first:last:count"):
        parsed_values(text, "axis")


OWN_MODULE = """
def slope(scenario):
    if scenario["side"] == "wrong":
        raise ValueError("no such side")
    return {"height": scenario["a"] * scenario["seed"]}
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    (tmp_path / "own_sweep_module.py").write_text(OWN_MODULE)
    monkeypatch.syspath_prepend(str(tmp_path))
    with chdir(tmp_path):
        yield "own_sweep_module:slope"


def test_command_sweeps_a_function_of_ones_own(module, tmp_path, capsys):
    arguments = ["sweep", "--scenario", module, "--axis", "a=-1:1:3", "--seeds", "1,3", "--jobs", "1", "--quiet"]
    assert main([*arguments, "--axis", "side=left,right", "--output", "out"]) == 0
    assert "12 runs, 0 of them diverged, 6 cells" in capsys.readouterr().out
    rows = read_csv(tmp_path / "out" / "cells.csv")
    assert [float(row["height_mean"]) for row in rows] == [-2.0, -2.0, 0.0, 0.0, 2.0, 2.0]
    assert (tmp_path / "out" / "figures" / "a.svg").exists()
    assert main([*arguments, "--axis", "side=wrong", "--output", "failed"]) == 1
    said = capsys.readouterr().err
    assert "scenario a=-1, side=wrong, seed=1: ValueError: no such side\nFinished runs are kept in failed" in said


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--n-taps", "0"], "n_taps must be at least 1"),
        (["--n-taps", "64,"], "n_taps must be values separated by commas"),
        (["--axis", "a=1"], "no axis called a; there are path"),
        (["--scenario", "math", "--axis", "a=1"], "scenario must be a function"),
        (["--scenario", "math:no_such_function", "--axis", "a=1"], "'math' has no attribute 'no_such_function'"),
        (["--scenario", "no_such_module:f", "--axis", "a=1"], "No module named 'no_such_module'"),
        (["--scenario", "math:sqrt"], "grid must have at least one axis"),
        (["--scenario", "math:sqrt", "--axis", "a"], "--axis must be NAME=VALUES"),
        (["--scheduler", "tcp://127.0.0.1:1"], "not allowed with argument"),
    ],
)
def test_command_refuses(inside, capsys, arguments, message):
    with pytest.raises(SystemExit) as refused:
        main(["sweep", "--jobs", "1", "--quiet", *arguments])
    assert refused.value.code == 2
    assert message in capsys.readouterr().err
    assert not list(inside.iterdir())  # nothing was begun
