"""A sweep's grid, tables, folder, figure and command line, with scenarios that take no time."""

from __future__ import annotations

import csv
import json
import math
from contextlib import chdir

import numpy as np
import pytest
from scipy import stats

from comparisons.__main__ import main
from comparisons.sweep.command import parsed_values
from comparisons.sweep.grid import AXES, built_in_grid, own_grid
from comparisons.sweep.jobs import as_figures
from comparisons.sweep.results import cell_rows, mean_and_interval, sweep_figure, write_table
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


def test_an_algorithm_of_two_settings_has_to_be_tuned():
    with pytest.raises(ValueError, match=r'leaky FxLMS has two settings.*give setting "tuned"'):
        built_in_grid({"algorithm": ["KF-OPC", "leaky FxLMS"]}, 1)


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ({"colour": "red"}, "no axis called colour; there are path, noise"),
        ({"algorithm": "KF-XYZ"}, "algorithm must be one of KF-ANC, KF-OPC, .*got 'KF-XYZ'"),
        ({"algorithm": 3}, "algorithm must be one of"),
        ({"path_delay": "late"}, "path_delay must be one of a number, got 'late'"),
        ({"algorithm": []}, "algorithm must have at least one value"),
        ({"n_taps": 0}, "n_taps must be at least 1, got 0"),
        ({"duration_s": [1.0, 0.0]}, "duration_s must be"),
        ({"setting": 0.0}, "setting must be"),
        ({"setting": "best"}, "setting must be one of default, tuned, a number, got 'best'"),
        ({"rated_power_db": math.nan}, "rated_power_db must be"),
        ({"rated_power_db": [-10, -10.0]}, "rated_power_db must have at least one value, and none twice"),
        ({"path": "pipe"}, "path must be one of band-pass, duct, measured duct, got 'pipe'"),
        ({"noise": "silence"}, "noise must be one of tone, "),
        ({"amplifier": "valve"}, "amplifier must be one of linear, hard clip, soft, got 'valve'"),
    ],
)
def test_grid_refuses_what_is_no_axis_or_value(axes, message):
    with pytest.raises(ValueError, match=message):
        built_in_grid(axes, 1)


@pytest.mark.parametrize(
    ("seeds", "error", "message"),
    [
        (0, ValueError, "seeds must be at least 1"),
        ([], ValueError, "seeds must have at least one value"),
        ([1, 1], ValueError, "seeds must have at least one value, and none twice"),
        ([-1], ValueError, "seeds must be at least 0"),
        (2.5, TypeError, "seeds must be a whole number"),
    ],
)
def test_seeds_refused(seeds, error, message):
    with pytest.raises(error, match=message):
        own_grid({"a": 1}, seeds)


@pytest.mark.parametrize(
    ("axes", "error", "message"),
    [
        ({}, ValueError, "grid must have at least one axis"),
        ({"seed": [1]}, ValueError, 'none called "seed"'),
        ({"a": []}, ValueError, "a must have at least one value"),
        ({"a": [math.inf]}, ValueError, "a must be finite"),
        ({"a": [object()]}, TypeError, "a must hold numbers, strings, booleans or None, got object"),
    ],
)
def test_own_axes_refused(axes, error, message):
    with pytest.raises(error, match=message):
        own_grid(axes, 1)


# Means and intervals.


def test_interval_is_that_of_scipy():
    values = np.random.default_rng(1).normal(3.0, 2.0, 9)
    mean, low, high, count = mean_and_interval(values)
    expected = stats.t.interval(0.95, 8, loc=np.mean(values), scale=stats.sem(values))
    assert (mean, count) == (pytest.approx(np.mean(values)), 9)
    np.testing.assert_allclose((low, high), expected, rtol=1e-12)  # the same formula, other order of operations


def test_no_interval_for_one_seed_and_nothing_for_none():
    assert mean_and_interval([5.0])[0] == 5.0
    assert np.isnan(mean_and_interval([5.0])[1:3]).all()
    assert mean_and_interval([5.0])[3] == 1
    assert np.isnan(mean_and_interval([math.nan])[:3]).all()
    assert mean_and_interval([])[3] == 0


def test_cells_are_means_over_seeds(tmp_path):
    sweep = swept(tmp_path)
    assert len(sweep.cells) == 6
    noise = [np.random.default_rng(seed).standard_normal() for seed in (1, 2, 3, 4)]
    for cell in sweep.cells:
        assert cell["height_mean"] == pytest.approx(2.0 * cell["slope"] + np.mean(noise), rel=1e-12)
        half = stats.t.ppf(0.975, 3) * np.std(noise, ddof=1) / 2
        assert cell["height_high"] - cell["height_mean"] == pytest.approx(half, rel=1e-9)
        assert (cell["runs"], cell["diverged"], cell["height_n"], cell["count_mean"]) == (4, 0, 4, 3.0)


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


def test_tables_hold_every_digit(tmp_path):
    sweep = swept(tmp_path)
    rows = read_csv(tmp_path / "runs.csv")
    assert len(rows) == 24
    assert [float(row["height"]) for row in rows] == [run["height"] for run in sweep.runs]
    assert [row["kind"] for row in rows[:8]] == 4 * ["a"] + 4 * ["b"]
    assert list(rows[0]) == ["slope", "kind", "seed", "height", "count", "diverged"]


def test_parquet_holds_what_csv_holds(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow, the extra parquet, is not installed")
    sweep = swept(tmp_path, {"mood": ["good", "bad"], "level": [1, 2.5]}, moody, seeds=3, format="parquet")
    assert [path.name for path in sweep.files[:2]] == ["cells.parquet", "runs.parquet"]
    cells = parquet.read_table(tmp_path / "cells.parquet").to_pylist()
    assert [cell["level"] for cell in cells] == [1.0, 2.5, 1.0, 2.5]
    assert [cell["height_mean"] for cell in cells] == [1.0, 1.0, None, None]
    assert not list(tmp_path.glob(".*"))  # no partial file left


def test_column_of_names_and_numbers_becomes_strings(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow, the extra parquet, is not installed")
    write_table([{"setting": "default"}, {"setting": 0.5}], tmp_path / "mixed", "parquet")
    assert parquet.read_table(tmp_path / "mixed.parquet").to_pylist() == [{"setting": "default"}, {"setting": "0.5"}]


# The folder.


def test_what_is_done_is_not_done_again(tmp_path):
    CALLS.clear()
    first = swept(tmp_path)
    assert len(CALLS) == 24
    again = swept(tmp_path)
    assert len(CALLS) == 24
    assert again.runs == first.runs
    assert again.cells == first.cells


@pytest.mark.parametrize("cut", [1, 2, 20, 60])
def test_torn_line_is_done_again_and_harms_no_other(tmp_path, cut):
    first = swept(tmp_path)
    runs = tmp_path / "runs.jsonl"
    whole = runs.read_bytes()
    runs.write_bytes(whole[:-cut])  # the kernel wrote a part of the last line
    CALLS.clear()
    again = swept(tmp_path)
    assert len(CALLS) == (0 if cut == 1 else 1)  # without its newline alone, the line is whole
    assert again.cells == first.cells
    assert runs.read_bytes().startswith(whole[:-cut])  # nothing is rewritten
    CALLS.clear()
    assert swept(tmp_path).cells == first.cells
    assert CALLS == []


def test_bytes_that_are_no_text_are_done_again(tmp_path):
    first = swept(tmp_path)
    lines = (tmp_path / "runs.jsonl").read_bytes().splitlines(keepends=True)
    lines[3] = b"\0\xff" * 20 + b"\n"  # what a power cut may leave of a block
    (tmp_path / "runs.jsonl").write_bytes(b"".join(lines))
    CALLS.clear()
    assert swept(tmp_path).cells == first.cells
    assert len(CALLS) == 1


@pytest.mark.parametrize(
    ("grid", "options", "message"),
    [
        (
            {"slope": [1.0, 2.0], "kind": ["a", "b"]},
            {},
            r"axis slope is \[1\.0, 2\.0, 3\.0\] there, but \[1\.0, 2\.0\] here",
        ),
        ({"slope": [1.0, 2.0, 3.0], "sort": ["a", "b"]}, {}, "axis sort is null there"),
        ({"slope": [1.0, 2.0, 3.0]}, {}, "axis kind is .* there, but null here"),
        ({"kind": ["a", "b"], "slope": [1.0, 2.0, 3.0]}, {}, "its axes have another order"),
        (None, {"seeds": 5}, r"seeds is \[1, 2, 3, 4\] there"),
        (None, {"scenario": moody}, "scenario is .*plane.*moody"),
    ],
)
def test_folder_of_another_sweep_is_refused(tmp_path, grid, options, message):
    swept(tmp_path)
    kept = (tmp_path / "runs.jsonl").read_bytes()
    with pytest.raises(ValueError, match=f"holds another sweep .{message}.*choose another output folder"):
        swept(tmp_path, grid, **options)
    assert (tmp_path / "runs.jsonl").read_bytes() == kept


def test_folder_of_other_code_is_refused(tmp_path):
    swept(tmp_path)
    description = json.loads((tmp_path / "sweep.json").read_text())
    description["SHA-256 of the code"] = "0" * 64
    (tmp_path / "sweep.json").write_text(json.dumps(description))
    with pytest.raises(ValueError, match="SHA-256 of the code is"):
        swept(tmp_path)


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
    ],
)
def test_what_a_scenario_returns_is_checked(returned, message):
    with pytest.raises(TypeError, match=message):
        as_figures(returned)


def test_figure_may_not_hide_an_axis(tmp_path):
    with pytest.raises(ScenarioError, match="figure 'mood' has the name of an axis"):
        swept(tmp_path, {"mood": ["good"]}, lambda scenario: {"mood": 1.0})


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


@pytest.mark.parametrize(
    "text", ["", "1,,2", "1:2", "1:2:1", "1:2:3:4", "a:b:3", "0:1:3:log", "-1:1:3:log", "1:inf:3", "1:2:3:log:1"]
)
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


def sweep_command(*arguments):
    return main(["sweep", *arguments, "--jobs", "1", "--quiet"])


def test_command_sweeps_a_function_of_ones_own(module, tmp_path, capsys):
    arguments = ["--scenario", module, "--axis", "a=-1:1:3", "--axis", "side=left,right", "--seeds", "1,3"]
    assert sweep_command(*arguments, "--output", "out") == 0
    printed = capsys.readouterr().out
    assert "12 runs, 0 of them diverged, 6 cells" in printed
    rows = read_csv(tmp_path / "out" / "cells.csv")
    assert [float(row["height_mean"]) for row in rows] == [-2.0, -2.0, 0.0, 0.0, 2.0, 2.0]
    assert (tmp_path / "out" / "figures" / "a.svg").exists()


def test_command_names_the_scenario_that_failed(module, capsys):
    assert sweep_command("--scenario", module, "--axis", "a=1", "--axis", "side=wrong", "--output", "out") == 1
    assert (
        "scenario a=1, side=wrong, seed=1: ValueError: no such side\nFinished runs are kept in out"
        in capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--algorithm", "KF-XYZ"], "algorithm must be one of"),
        (["--n-taps", "0"], "n_taps must be at least 1"),
        (["--n-taps", "64,"], "n_taps must be values separated by commas"),
        (["--seeds", "0"], "seeds must be at least 1"),
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
