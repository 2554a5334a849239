"""A sweep: rows that a run can go on from, failures as rows, and the built-in scenario equal to plain runs."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.studies import plain_run, smaller
from scipy import stats

from comparisons.__main__ import main
from comparisons.bench import algorithms
from comparisons.studies.cases import FS, SWITCH_ON_S, make_case, noises, plants
from comparisons.sweep import scenario, study
from comparisons.sweep.scenario import DEFAULTS, checked_axes, in_the_loop
from comparisons.sweep.study import means, rows_of, run_sweep
from kfopc_filterpy.paths import path_taps, perturbed_path
from kfopc_filterpy.verdict.runs import AllDivergedError

CALLS: list[int] = []
SMALL = {"duration_s": 0.5, "n_taps": 24}
AXES = {"slope": [1.0, 2.0, 3.0], "kind": ["a", "b"]}


def plane(values):
    CALLS.append(values["seed"])
    return {"height": values["slope"] * np.random.default_rng(values["seed"]).standard_normal(), "none": math.inf}


def moody(values):
    if values["mood"] == "broken":
        raise ArithmeticError("out of mood")
    return {"height": None} if values["mood"] == "bad" else {"height": 1, "diverged": values["seed"] == 2}


def built_in(file, axes, **options):
    return run_sweep(in_the_loop, SMALL | axes, file, **{"seeds": 2, "jobs": 1} | options)


# Rows.


@pytest.mark.parametrize("cut", [0, 1, 20])
def test_a_sweep_goes_on_where_it_ended_and_gives_equal_rows(tmp_path, cut):
    whole = run_sweep(plane, AXES, tmp_path / "whole", seeds=4, jobs=1)
    assert [(row["slope"], row["kind"], row["seed"]) for row in whole[:5]] == [
        *((1.0, "a", seed) for seed in (1, 2, 3, 4)),
        (1.0, "b", 1),
    ]
    lines = (tmp_path / "whole").read_bytes().splitlines(keepends=True)
    begun = b"".join(lines[:10])[: -cut or None]  # of the last line, the kernel wrote a part
    (tmp_path / "begun").write_bytes(begun)
    CALLS.clear()
    assert run_sweep(plane, AXES, tmp_path / "begun", seeds=4, jobs=1) == whole
    assert len(CALLS) == 24 - (10 if cut < 2 else 9)  # without its newline alone, the line is whole
    assert (tmp_path / "begun").read_bytes().startswith(begun)  # nothing is rewritten
    CALLS.clear()
    more = run_sweep(plane, AXES | {"slope": [2.0, 5.0]}, tmp_path / "begun", seeds=4, jobs=1)
    assert len(CALLS) == 8  # of slope 5: those of slope 2 are there
    assert more[:8] == whole[8:16]


def test_rows_of_other_code_or_another_scenario_are_left_alone(tmp_path):
    before = run_sweep(plane, {"slope": 1.0}, tmp_path / "rows", seeds=2, jobs=1)
    CALLS.clear()
    with smaller(study, code_of=lambda scenario: "other"):
        after = run_sweep(plane, {"slope": 1.0}, tmp_path / "rows", seeds=2, jobs=1)
    assert len(CALLS) == 2
    assert rows_of(tmp_path / "rows") == before + after
    assert study.code_of(plane) not in (study.code_of(moody), study.code_of(in_the_loop))


def test_a_run_that_fails_is_a_row_with_its_reason(tmp_path):
    rows = run_sweep(moody, {"mood": ["broken", "good", "bad"]}, tmp_path / "rows", seeds=3, jobs=1)
    assert [row.get("error") for row in rows] == ["ArithmeticError: out of mood"] * 3 + [None] * 6
    broken, good, bad = means(rows, ["mood"])
    assert (broken["runs"], broken["failed"], broken["height"]) == (3, 3, None)
    assert (good["failed"], good["diverged"], good["height"]) == (0, 1, (1.0, 0.0))
    assert (bad["failed"], bad["diverged"], bad["height"]) == (0, 0, None)


@pytest.mark.parametrize(
    ("returned", "message"),
    [(3.0, "AttributeError"), ({"a": "b"}, "TypeError"), ({"mood": 1.0}, "the figure 'mood' has the name of an axis")],
)
def test_what_a_scenario_returns_is_checked(returned, message, tmp_path):
    (row,) = run_sweep(lambda values: returned, {"mood": "good"}, tmp_path / "rows", seeds=1, jobs=1)
    assert message in row["error"]


@pytest.mark.parametrize(
    ("axes", "seeds", "message"),
    [
        ({"a": 1}, 0, "seed must have at least one value"),
        ({"a": 1}, [1, 1], "none twice"),
        ({"a": []}, 1, "a must have at least one value"),
        ({"seed": [1]}, 1, "no axis be called seed"),
    ],
)
def test_axes_and_seeds_refused(tmp_path, axes, seeds, message):
    with pytest.raises(ValueError, match=message):
        run_sweep(plane, axes, tmp_path / "rows", seeds=seeds)
    assert not list(tmp_path.iterdir())


def test_the_interval_is_that_of_scipy():
    values = np.random.default_rng(1).normal(3.0, 2.0, 9)
    ((mean, half),) = (cell["x"] for cell in means([{"x": value} for value in values], []))
    expected = stats.t.interval(0.95, 8, loc=np.mean(values), scale=stats.sem(values))
    np.testing.assert_allclose((mean - half, mean + half), expected, rtol=1e-12)  # the same in another order
    assert means([{"x": 5.0}], [])[0]["x"] == (5.0, None)


# Workers.


def test_results_do_not_depend_on_the_number_of_processes(tmp_path):
    axes = {"algorithm": ["KF-OPC", "KF-PB", "FxLMS"], "rated_power_db": [-20, -5]}
    one, two = (built_in(tmp_path / f"{jobs}", axes, jobs=jobs) for jobs in (1, 2))
    assert one == two
    assert not any("error" in row for row in one)


@pytest.mark.slow
def test_a_cluster_gives_the_rows_of_this_machine_and_goes_on_when_workers_die(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed", reason="Dask's distributed is not installed")
    (tmp_path / "own_fatal.py").write_text(
        "import os\ndef fatal(values):\n    if values['a'] == 3:\n        os.kill(os.getpid(), 9)\n    return {'b': 1.0}\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    axes = {"rated_power_db": [-20, -10, -5]}
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        there = built_in(tmp_path / "there", axes, scheduler=cluster.scheduler_address)
        fatal = __import__("own_fatal").fatal
        rows = run_sweep(fatal, {"a": [1, 2, 3]}, tmp_path / "rows", seeds=1, scheduler=cluster.scheduler_address)
    assert there == built_in(tmp_path / "here", axes)
    assert [row.get("b") for row in rows] == [1.0, 1.0, None]
    assert rows[2]["error"].startswith("KilledWorker: ")


# The built-in scenario.


def of_simulate(values):
    """The scenario as a user would write it."""
    values = DEFAULTS | values
    noise = noises()[values["noise"]](values["duration_s"] + SWITCH_ON_S, values["seed"])
    about = {name: values[name] for name in ("n_taps", "sensor_noise_db", "seed")}
    scene = make_case(plants()[values["path"]], noise, **about)
    rated = 10 ** (values["rated_power_db"] / 10)
    errors = {"gain_db": values["path_gain_db"], "delay_samples": values["path_delay"]}
    estimate = path_taps(perturbed_path(scene.secondary, fs=FS, phase_deg=values["path_phase_deg"], **errors))
    scene = replace(scene, secondary_estimate=estimate, rated_power=rated)
    return plain_run(scene, values["algorithm"], values["setting"])


@pytest.mark.parametrize("algorithm", ["KF-OPC", "FxRLS"])
def test_runs_are_those_of_simulate(algorithm):
    first = sorted(algorithms()[algorithm].first)
    values = SMALL | {
        "algorithm": algorithm,
        "rated_power_db": -6.0,
        "path": "band-pass",
        "noise": "tone",
        "path_gain_db": 2.0,
        "path_phase_deg": 20.0,
        "path_delay": 1,
        "sensor_noise_db": -30.0,
        "setting": first[len(first) // 2],
        "seed": 3,
    }
    figures, result = in_the_loop(values), of_simulate(values)
    assert figures["noise_reduction_db"] == result.noise_reduction_db
    assert figures["output_power_db"] == pytest.approx(10 * math.log10(result.output_power), abs=1e-12)
    assert figures["power_over_rated"] == pytest.approx(result.output_power / 10**-0.6, rel=1e-12)
    assert in_the_loop(values | {"setting": "default"}) == figures


def test_what_diverges_has_no_figures_of_merit():
    values = SMALL | {"path_phase_deg": 180.0, "noise": "tone", "seed": 1}  # an estimate of the wrong sign
    assert in_the_loop(values | {"algorithm": "KF-ANC"}) == {"setting_used": 1e-6, "diverged": True}
    assert not in_the_loop(values | {"algorithm": "KF-OPC"})["diverged"]  # the rated power does not let it

    def all_diverged(*arguments, **options):
        raise AllDivergedError("at every setting")

    with smaller(scenario, tune=all_diverged):
        assert in_the_loop(values | {"algorithm": "FxLMS", "setting": "tuned", "n_taps": 20}) == {"diverged": True}


def test_measured_paths_are_used_where_they_are_at_hand_and_asked_for_where_not(shared_data, monkeypatch):
    values = SMALL | {"path": "measured duct", "noise": "motor", "seed": 1}
    with smaller(), pytest.raises(ValueError, match="motor needs the measured data: set KFOPC_DATA"):
        in_the_loop(values)
    monkeypatch.setenv("KFOPC_DATA", str(shared_data))
    scenario.cases.measured_data.cache_clear()
    assert math.isfinite(in_the_loop(values)["noise_reduction_db"])


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ({"colour": ["red"]}, "no axis called colour; there are path, noise"),
        ({"algorithm": ["KF-XYZ"]}, "algorithm must be one of KF-ANC, KF-OPC, .*got 'KF-XYZ'"),
        ({"setting": ["best"]}, "setting must be a single number"),
        ({"rated_power_db": [math.nan]}, "rated_power_db must be finite"),
    ],
)
def test_axes_of_the_built_in_scenario_are_checked(axes, message):
    with pytest.raises((ValueError, TypeError), match=message):
        checked_axes(axes)


# The command.


def test_the_command_prints_means_and_goes_on(tmp_path, capsys):
    command = ["sweep", "rated_power_db=-20,-10", "--seeds", "2", "duration_s=0.5", "n_taps=24", "--quiet", "--output"]
    assert main([*command, str(tmp_path / "new" / "rows.jsonl")]) == 0
    printed = capsys.readouterr()
    head, low, high = (re.split(r"\s{2,}", line.strip()) for line in printed.out.splitlines()[:3])
    assert [head[0], low[0], high[0], printed.err] == ["rated_power_db", "-20", "-10", ""]
    assert all(" ± " in mean for mean in (*low[1:3], *high[1:3]))
    assert "4 rows in" in printed.out
    lines = (tmp_path / "new" / "rows.jsonl").read_text().splitlines()
    assert {json.loads(line)["rated_power_db"] for line in lines} == {-20, -10}
    assert main([*command, str(tmp_path / "new" / "rows.jsonl")]) == 0
    assert capsys.readouterr().out == printed.out


def test_the_command_runs_a_function_of_ones_own_and_says_what_failed(tmp_path, monkeypatch, capsys):
    (tmp_path / "own_sweep.py").write_text("def f(values):\n    return {'b': 1 / values['a']}\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    arguments = ["sweep", "--scenario", "own_sweep:f", "a=-1,0,1", "--seeds", "7", "--jobs", "1", "--quiet"]
    assert main([*arguments, "--output", str(tmp_path / "rows")]) == 1
    assert "failed: a=0, seed=1: ZeroDivisionError: division by zero" in capsys.readouterr().err
    assert [row["b"] for row in rows_of(tmp_path / "rows") if row["a"] == -1] == [-1.0] * 7


def test_an_interrupted_command_says_how_to_go_on(tmp_path, capsys):
    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    with smaller(study, run_sweep=interrupted):
        assert main(["sweep", "--output", str(tmp_path / "rows")]) == study.INTERRUPTED
    assert "interrupted; the same command goes on from" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["n_taps"], "n_taps must have at least one value"),
        (["--seeds", ","], "seed must have at least one value"),
        (["a=1"], "no axis called a; there are path"),
        (["--scenario", "math:no_such_function", "a=1"], "'math' has no attribute 'no_such_function'"),
        (["--jobs", "2", "--scheduler", "tcp://127.0.0.1:1"], "not allowed with argument"),
    ],
)
def test_the_command_refuses(inside, capsys, arguments, message):
    with pytest.raises(SystemExit) as refused:
        main(["sweep", "--quiet", *arguments])
    assert refused.value.code == 2
    assert message in capsys.readouterr().err
    assert not list(inside.iterdir())  # nothing was begun
