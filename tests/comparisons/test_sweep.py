"""A sweep's tables, folder, figures and command line, with scenarios that take no time."""

from __future__ import annotations

import csv
import json
import math

import numpy as np
import pytest
from matplotlib.image import imread
from scipy import stats

from comparisons.__main__ import main
from comparisons.sweep.command import loaded_scenario, parsed_values, values_joined
from comparisons.sweep.figures import sweep_figures, swept_axis
from comparisons.sweep.grid import Grid, built_in_grid, own_grid
from comparisons.sweep.jobs import as_figures
from comparisons.sweep.run import ScenarioError, run_sweep
from comparisons.sweep.store import SweepFolder
from comparisons.sweep.table import cell_rows, mean_and_interval, write_table

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


# Means and intervals.


def test_interval_is_that_of_scipy():
    values = np.random.default_rng(1).normal(3.0, 2.0, 9)
    mean, low, high, count = mean_and_interval(values)
    expected = stats.t.interval(0.95, 8, loc=np.mean(values), scale=stats.sem(values))
    assert (mean, count) == (pytest.approx(np.mean(values)), 9)
    np.testing.assert_allclose((low, high), expected, rtol=1e-12)  # the same formula, other order of operations


def test_interval_by_hand():
    # Mean 3, standard deviation sqrt(2), t(0.975, 1) = tan(0.475 pi) for one degree of freedom.
    mean, low, high, count = mean_and_interval([2.0, 4.0, math.nan, math.inf])
    assert (mean, count) == (3.0, 2)
    assert high - mean == mean - low == pytest.approx(math.tan(0.475 * math.pi), rel=1e-12)


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
    assert sweep.diverged == 4
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


def test_format_that_is_none_is_refused(tmp_path):
    with pytest.raises(ValueError, match="format must be one of csv, parquet, got 'xlsx'"):
        swept(tmp_path / "new", format="xlsx")
    assert not (tmp_path / "new").exists()


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
        ({"slope": [1.0, 2.0], "kind": ["a", "b"]}, {}, r"its slope is \[1\.0, 2\.0, 3\.0\], not \[1\.0, 2\.0\]"),
        ({"slope": [1.0, 2.0, 3.0], "sort": ["a", "b"]}, {}, "its sort is null"),
        ({"slope": [1.0, 2.0, 3.0]}, {}, "its axes are slope, kind, not slope"),
        (None, {"seeds": 5}, r"its seeds is \[1, 2, 3, 4\], not"),
        (None, {"scenario": moody}, "its scenario is .*plane.*moody"),
    ],
)
def test_folder_of_another_sweep_is_refused(tmp_path, grid, options, message):
    swept(tmp_path)
    kept = (tmp_path / "runs.jsonl").read_bytes()
    with pytest.raises(ValueError, match=f"holds another sweep: {message}.*Choose another output folder"):
        swept(tmp_path, grid, **options)
    assert (tmp_path / "runs.jsonl").read_bytes() == kept


def test_folder_of_other_code_is_refused(tmp_path):
    swept(tmp_path)
    description = json.loads((tmp_path / "sweep.json").read_text())
    description["code"]["sha256"] = "0" * 64
    (tmp_path / "sweep.json").write_text(json.dumps(description))
    with pytest.raises(ValueError, match="made with other code"):
        swept(tmp_path)


@pytest.mark.parametrize("text", ["", "[1, 2]", "{"])
def test_description_that_is_none_is_refused(tmp_path, text):
    (tmp_path / "sweep.json").write_text(text)
    with pytest.raises(ValueError, match="not the description of a sweep"):
        swept(tmp_path)


def test_runs_without_description_are_refused(tmp_path):
    (tmp_path / "runs.jsonl").write_text("")
    with pytest.raises(ValueError, match=r"holds runs\.jsonl but no sweep\.json"):
        swept(tmp_path)


def test_numbers_survive_the_folder_exactly(tmp_path):
    store = SweepFolder(tmp_path, Grid({"a": (1,)}, (1, 2)), plane)
    figures = {"third": 1 / 3, "tiny": 5e-324, "none": math.nan, "endless": math.inf, "diverged": False}
    store.keep([(1, figures)])
    read = store.done()[1]
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
    [(3.0, "must return a dict"), ({1: 2.0}, "strings for names"), ({"a": "b"}, "figure 'a' .* must be a number")],
)
def test_what_a_scenario_returns_is_checked(returned, message):
    with pytest.raises(TypeError, match=message):
        as_figures(returned)


def test_figure_may_not_hide_an_axis(tmp_path):
    with pytest.raises(ScenarioError, match="figure 'mood' has the name of an axis"):
        swept(tmp_path, {"mood": ["good"]}, lambda scenario: {"mood": 1.0})


def test_no_function_is_refused(tmp_path):
    with pytest.raises(TypeError, match="scenario must be a function"):
        swept(tmp_path, scenario="plane")
    with pytest.raises(ValueError, match="either jobs or scheduler"):
        swept(tmp_path, scheduler="tcp://127.0.0.1:1")
    with pytest.raises(ValueError, match="jobs must be at least 1"):
        swept(tmp_path, jobs=0)


# Figures.


def test_figures_are_drawn_against_the_numbers_with_most_values():
    grid = built_in_grid(
        {
            "rated_power_db": [-10, 0],
            "n_taps": [16, 32, 64],
            "algorithm": ["KF-ANC", "KF-OPC", "FxLMS", "MOV-FxLMS", "KF-OPC repaired", "KF-PB"],
        },
        1,
    )
    assert swept_axis(grid) == "n_taps"
    assert swept_axis(grid, "rated_power_db") == "rated_power_db"
    assert swept_axis(built_in_grid({"noise": ["tone", "bursts"]}, 1)) == "noise"
    assert swept_axis(built_in_grid({}, 1)) == "algorithm"
    with pytest.raises(ValueError, match="no axis called depth"):
        swept_axis(grid, "depth")


def test_figures_show_the_means_and_intervals():
    grid = own_grid({"slope": [3.0, 1.0], "kind": ["a", "b"], "place": ["here", "there"]}, 3)
    done = {
        run.index: {"height": run.values["slope"] * run.seed + (run.values["kind"] == "b"), "diverged": False}
        for run in grid.runs()
    }
    cells = cell_rows(grid, done)
    figures = sweep_figures(grid, cells, ["height"], "slope")
    assert list(figures) == ["slope--place=here", "slope--place=there"]
    (ax,) = figures["slope--place=here"].axes
    lines, bars = zip(*[(c.lines[0], c.lines[2][0]) for c in ax.containers], strict=True)
    for line, own, kind in zip(lines, bars, ("a", "b"), strict=True):
        np.testing.assert_array_equal(line.get_xdata(), [1.0, 3.0])  # in order, whatever the grid's
        np.testing.assert_allclose(line.get_ydata(), np.array([2.0, 6.0]) + (kind == "b"))
        half = stats.t.ppf(0.975, 2) / np.sqrt(3)  # of seeds 1, 2, 3
        ends = np.array([segment[:, 1] for segment in own.get_segments()])
        np.testing.assert_allclose(ends[:, 1] - ends[:, 0], 2 * half * np.array([1.0, 3.0]))
    assert ax.get_legend_handles_labels()[1] == ["a", "b"]


def test_figures_keep_a_place_for_what_diverged_and_room_for_what_did_not():
    grid = built_in_grid({"setting": [1e-3, 1.0], "algorithm": ["KF-OPC", "FxLMS"]}, 2)
    done = {
        run.index: {"noise_reduction_db": 10.0, "output_power_db": 0.0, "diverged": run.values["setting"] == 1.0}
        for run in grid.runs()
    }
    done[0] |= {"noise_reduction_db": -300.0, "output_power_db": 300.0}
    figure = sweep_figures(grid, cell_rows(grid, done), ["noise_reduction_db", "output_power_db"], "setting")["setting"]
    reduction, power = figure.axes
    assert reduction.get_xscale() == "log"
    assert reduction.get_xlim()[0] < 1e-3 < 1.0 < reduction.get_xlim()[1]
    assert reduction.get_ylim()[0] == -20.0
    assert power.get_ylim()[1] == 40.0
    crosses = [line for line in reduction.lines if line.get_marker() == "x"]
    assert [list(line.get_xdata()) for line in crosses] == [[1.0], [1.0]]  # of either algorithm
    assert [text.get_text() for text in power.get_legend().get_texts()] == ["rated power"]
    figure.canvas.draw()  # no warning


def test_figures_are_written(tmp_path):
    sweep = swept(tmp_path, x="kind", figures=["height"])
    images = [path for path in sweep.files if path.suffix == ".png"]
    assert [path.name for path in images] == ["kind.png"]
    assert imread(images[0])[..., :3].std() > 0.05  # something is on it
    with pytest.raises(ValueError, match="no figure called depth; there are height, count"):
        swept(tmp_path, figures=["depth"])


# The command line.


def test_lists_of_negative_numbers_are_values():
    arguments = ["--rated-power-db", "-20,-10", "--path-delay", "-.5", "--quiet", "--seeds=3", "--axis", "a=-1"]
    assert values_joined(arguments) == [
        "--rated-power-db=-20,-10",
        "--path-delay=-.5",
        "--quiet",
        "--seeds=3",
        "--axis",
        "a=-1",
    ]


@pytest.mark.parametrize(
    "text", ["", "1,,2", "1:2", "1:2:1", "1:2:3:4", "a:b:3", "0:1:3:log", "1:inf:3", "1:2:3:log:1"]
)
def test_lists_refused(text):
    with pytest.raises(ValueError, match="axis must "):
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
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    return "own_sweep_module:slope"


def sweep_command(*arguments):
    return main(["sweep", *arguments, "--jobs", "1", "--quiet"])


def test_command_sweeps_a_function_of_ones_own(module, tmp_path, capsys):
    arguments = ["--scenario", module, "--axis", "a=-1:1:3", "--axis", "side=left,right", "--seeds", "1,3"]
    assert sweep_command(*arguments, "--output", "out") == 0
    printed = capsys.readouterr().out
    assert "12 runs, 6 cells" in printed
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
        (["--axis", "a=1"], "--axis needs --scenario"),
        (["--scenario", "math"], "--scenario must be MODULE:FUNCTION"),
        (["--scenario", "math:no_such_function", "--axis", "a=1"], "module math has no function no_such_function"),
        (["--scenario", "no_such_module:f", "--axis", "a=1"], "No module named 'no_such_module'"),
        (["--scenario", "math:sqrt"], "grid must have at least one axis"),
        (["--scenario", "math:sqrt", "--n-taps", "3"], "--n-taps is of the built-in scenario"),
        (["--scenario", "math:sqrt", "--axis", "a"], "--axis must be NAME=VALUES"),
        (["--scenario", "math:sqrt", "--axis", "a=1", "--axis", "a=2"], "--axis names a twice"),
        (["--figures", "beauty"], "no figure called beauty"),
        (["--x", "beauty"], "no axis called beauty"),
        (["--scheduler", "tcp://127.0.0.1:1"], "not allowed with argument"),
    ],
)
def test_command_refuses(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as refused:
        main(["sweep", "--jobs", "1", "--quiet", *arguments])
    assert refused.value.code == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())  # nothing was begun


def test_sweep_is_named_first(capsys):
    with pytest.raises(SystemExit):
        main(["tonal", "sweep"])
    assert "sweep runs alone, and is named first" in capsys.readouterr().err


def test_scenario_may_be_any_callable_of_a_module():
    assert loaded_scenario("math:sqrt", send_source=False) is math.sqrt
