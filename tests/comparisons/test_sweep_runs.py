"""The built-in scenario of a sweep: equal to plain runs, and the same whatever it shares with."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from helpers.studies import plain_run, smaller

from comparisons.__main__ import main
from comparisons.bench import AllDivergedError, Runs, Scene, algorithms, tune
from comparisons.studies.cases import FS, SWITCH_ON_S, make_case, measured_data, noises, paths
from comparisons.sweep import scenario as sweep_scenario
from comparisons.sweep.grid import built_in_grid
from comparisons.sweep.jobs import do_job, plan
from comparisons.sweep.run import run_sweep
from comparisons.sweep.scenario import ScenarioError, group_of, most_together, run_group, scene_of
from kfopc_filterpy import (
    HardClipAmplifier,
    SoftSaturationAmplifier,
    noise_reduction_db,
    output_power,
    power_constrained_wiener,
)
from kfopc_filterpy.paths import path_taps, perturbed_path

SMALL = {"duration_s": 0.5, "n_taps": 24}


def swept(folder, grid, **options):
    return run_sweep(SMALL | grid, folder, **({"seeds": 2, "jobs": 1, "quiet": True} | options))


def scenario_of(axes):
    (scenario,) = built_in_grid(SMALL | axes, 1).runs()
    return scenario


def middle(algorithm):
    settings = sorted(algorithms()[algorithm].first)
    return settings[len(settings) // 2]


def of_simulate(values, seed):
    """The scenario as a user would write it."""
    noise = noises()[values["noise"]](values["duration_s"] + SWITCH_ON_S, seed)
    about = {name: values[name] for name in ("n_taps", "sensor_noise_db")}
    scene = make_case(paths()[values["path"]], noise, seed=seed, **about)
    rated = 10 ** (values["rated_power_db"] / 10)
    errors = {"gain_db": values["path_gain_db"], "delay_samples": values["path_delay"]}
    estimate = path_taps(perturbed_path(scene.secondary, fs=FS, phase_deg=values["path_phase_deg"], **errors))
    limit = math.sqrt(2 * rated) * 10 ** (values["amplifier_limit_db"] / 20)
    amplifiers = {"linear": None, "hard clip": HardClipAmplifier(limit), "soft": SoftSaturationAmplifier(limit)}
    scene = replace(scene, secondary_estimate=estimate, rated_power=rated)
    return plain_run(scene, values["algorithm"], values["setting"], amplifier=amplifiers[values["amplifier"]])


@pytest.mark.parametrize(
    ("algorithm", "amplifier"),
    [
        *(("KF-OPC", amplifier) for amplifier in ("linear", "hard clip", "soft")),
        *((name, "hard clip") for name in ("KF-ANC", "KF-PB", "diagonal KF-OPC", "FxLMS", "MOV-FxLMS")),
    ],
)
def test_runs_are_those_of_simulate(tmp_path, algorithm, amplifier):
    grid = {
        "algorithm": algorithm,
        "amplifier": amplifier,
        "amplifier_limit_db": -2.0,
        "rated_power_db": [-12.0, -3.0],
        "path": "band-pass",
        "noise": "tone",
        "path_gain_db": 2.0,
        "path_phase_deg": 20.0,
        "path_delay": 1,
        "sensor_noise_db": -30.0,
        "setting": middle(algorithm),
    }
    sweep = swept(tmp_path, grid)
    assert len(sweep.runs) == 4
    for run in sweep.runs:
        result = of_simulate(run, run["seed"])
        # Sharing gains changes the order of sums only; over 8000 samples that grows to less than 1e-8 of the figures.
        expected = noise_reduction_db(result.error, result.disturbance)
        assert run["noise_reduction_db"] == pytest.approx(expected, rel=1e-6, abs=1e-6)
        power = output_power(result.control_signal)
        assert run["output_power_db"] == pytest.approx(10 * math.log10(power), abs=1e-5)
        assert run["power_over_rated"] == pytest.approx(power / 10 ** (run["rated_power_db"] / 10), rel=1e-6)


def test_where_every_setting_diverges_the_run_counts_as_diverged():
    def diverged(*arguments, **options):
        raise AllDivergedError("at every setting")

    scenario = scenario_of({"algorithm": "FxLMS", "setting": "tuned", "n_taps": 20})  # of no other test: it is kept
    with smaller(sweep_scenario, tune=diverged):
        (figures,) = run_group([scenario], 1)
    assert figures["diverged"]
    assert math.isnan(figures["setting_used"])


def test_a_bad_setting_is_an_error_and_no_divergence(tmp_path):
    with pytest.raises(ScenarioError, match="forgetting must be"):
        swept(tmp_path, {"algorithm": "FxRLS", "setting": 1.5}, seeds=1)


def test_a_filter_that_refuses_to_go_on_counts_as_diverged():
    def refuse(*arguments, **options):
        error = ValueError("P is not positive definite")
        error.add_note("in sample 3 of the run")
        raise error

    with smaller(Scene, run=refuse):
        (figures,) = run_group([scenario_of({"algorithm": "FxRLS"})], 1)
    assert figures["diverged"]
    assert math.isnan(figures["diverged_at_s"])
    assert math.isnan(figures["noise_reduction_db"])


def test_rated_power_is_relative_to_what_the_unconstrained_filter_needs():
    (scenario,) = built_in_grid({"duration_s": 1.0, "n_taps": 32}, [3]).runs()
    scene = scene_of(scenario)
    ridge = scene.measurement_noise / (scene.settled[0].size * scene.initial_variance)
    bound = power_constrained_wiener(
        scene.references[0],
        scene.disturbances[0],
        scene.secondary,
        32,
        1.0,
        fs=FS,
        switch_on_s=SWITCH_ON_S,
        ridge=ridge,
    )
    assert bound.unconstrained.control_power == pytest.approx(1.0, rel=1e-6)  # least squares of 16000 samples


def test_results_do_not_depend_on_what_runs_together():
    grid = built_in_grid(
        SMALL
        | {
            "algorithm": ["KF-ANC", "KF-OPC", "FxLMS", "KF-PB"],
            "rated_power_db": [-11, -8, -5, -2],
            "amplifier": ["linear", "hard clip"],
        },
        1,
    )
    pending = dict(enumerate(grid.runs()))
    few, many = ({k: v for job in plan(pending, n) for k, v in do_job(job, None, 1).items()} for n in (1, 7))
    assert len(few) == 32
    np.testing.assert_equal(few, many)  # to the last bit
    np.testing.assert_equal(few, {number: run_group([values], 1)[0] for number, values in pending.items()})


def test_a_diverged_run_leaves_those_it_shares_gains_with_alone(tmp_path):
    # An estimate of the wrong sign diverges; only where the rated power lets it.
    grid = {"path_phase_deg": 180.0, "algorithm": ["KF-ANC", "KF-OPC"], "noise": "tone"}
    anc, opc = swept(tmp_path / "both", grid, seeds=1).runs
    (alone,) = swept(tmp_path / "alone", grid | {"algorithm": "KF-OPC"}, seeds=1).runs
    assert anc["diverged"]
    assert not opc["diverged"]
    np.testing.assert_equal(opc, alone)


def test_setting_tuned_is_the_winner_of_the_studies_rule(tmp_path):
    scene = scene_of(scenario_of({"noise": "tone"}))
    tuned = {"setting": "tuned", "noise": "tone"}
    (run, other) = swept(tmp_path / "one", {"algorithm": "FxLMS", **tuned}).runs
    assert run["setting_used"] == tune(Runs(), scene, ["FxLMS"])["FxLMS"].setting
    assert run["setting_used"] != middle("FxLMS")  # else this test says nothing
    assert other["setting_used"] == run["setting_used"]  # of the first seed, for all
    (run,) = swept(tmp_path / "two", {"algorithm": "leaky FxLMS", **tuned}, seeds=1).runs
    best = tune(Runs(), scene, ["leaky FxLMS"])["leaky FxLMS"].setting
    assert (run["setting_used"], run["second_setting_used"]) == best


@pytest.mark.parametrize("algorithm", ["KF-OPC", "FxLMS"])
def test_exception_names_the_scenario(tmp_path, algorithm):
    grid = {"algorithm": algorithm, "rated_power_db": [-10, -5], "path_delay": [0, -200]}
    with pytest.raises(ScenarioError, match=r"scenario path=duct.*path_delay=-200\.0.*seed=1: ValueError: .*causally"):
        swept(tmp_path, grid)


def test_shared_run_that_fails_is_found():
    scenarios = built_in_grid(SMALL | {"rated_power_db": [-20, -10, -5]}, 1).runs()
    make = sweep_scenario.make_controller

    def spoilt(bad, scene, *rest):
        controller = make(scene, *rest)
        if scene.rated_power == bad:
            return make(replace(scene, measurement_noise=math.nan), *rest)
        return controller

    with (
        smaller(sweep_scenario, make_controller=partial(spoilt, 0.1)),
        pytest.raises(ScenarioError, match=r"rated_power_db=-10\.0, .*ValueError: .*finite, got nan"),
    ):
        run_group(scenarios, 1)


def test_measured_paths_where_they_are_at_hand(tmp_path, shared_data, data_folder):
    data_folder(shared_data)
    measured_data.cache_clear()
    (run,) = swept(tmp_path, {"path": "measured duct", "noise": "motor"}, seeds=1).runs
    assert math.isfinite(run["noise_reduction_db"])
    assert not run["diverged"]


def test_measured_paths_are_refused_where_they_are_not():
    with smaller(), pytest.raises(ValueError, match="measured duct and motor need the measured data: set KFOPC_DATA"):
        built_in_grid({"path": "measured-duct"}, 1)


def test_command_end_to_end_and_the_same_in_one_process(tmp_path, capsys):
    command = "sweep --rated-power-db -20,-10 --algorithm KF-OPC,FxLMS --duration-s 0.5 --n-taps 24 --seeds 2 --jobs 2"
    out = tmp_path / "two"
    assert main([*command.split(), "--output", str(out), "--quiet"]) == 0
    printed = capsys.readouterr()
    assert "8 runs, 0 of them diverged, 4 cells" in printed.out
    assert printed.err == ""  # no bar
    with open(out / "cells.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    cells = [(name, power) for name in ("KF-OPC", "FxLMS") for power in ("-20.0", "-10.0")]
    assert [(row["algorithm"], row["rated_power_db"]) for row in rows] == cells
    for row in rows:
        mean, low, high = (float(row[f"noise_reduction_db_{end}"]) for end in ("mean", "low", "high"))
        assert low < mean < high
    assert {path.name for path in (out / "figures").iterdir()} == {"rated_power_db.png", "rated_power_db.svg"}
    swept(tmp_path / "one", {"algorithm": ["KF-OPC", "FxLMS"], "rated_power_db": [-20, -10]}, jobs=1)
    for table in ("cells.csv", "runs.csv"):
        assert (out / table).read_bytes() == (tmp_path / "one" / table).read_bytes()


# Jobs.


def runs_of(axes, seeds):
    return dict(enumerate(built_in_grid(axes, seeds).runs()))


@pytest.mark.parametrize(("cores", "sizes"), [(1, [20]), (2, [10, 10]), (3, [7, 7, 6])])
def test_one_gain_sequence_is_spread_over_all_cores(cores, sizes):
    pending = runs_of({"rated_power_db": list(range(-20, 0))}, 1)
    jobs = plan(pending, cores)
    assert [len(job) for job in jobs] == sizes
    assert sorted(number for job in jobs for number in job) == list(pending)


@pytest.mark.parametrize(
    "axis", ["path", "noise", "duration_s", "n_taps", "sensor_noise_db", "path_gain_db", "path_delay", "setting"]
)
def test_runs_that_differ_in_reference_path_or_setting_do_not_share(axis):
    values = {"path": ["duct", "band-pass"], "noise": ["tone", "bursts"], "n_taps": [32, 64]}.get(axis, [1.0, 2.0])
    one, other = runs_of({axis: values}, 1).values()
    assert group_of(one) != group_of(other)


def test_long_runs_are_fewer_together_so_that_memory_is_bounded():
    def signals_of(run):
        return most_together(run) * 8 * 5 * 16000 * run["duration_s"]

    short, long, longest = runs_of({"duration_s": [4.0, 60.0, 3600.0]}, 1).values()
    assert most_together(short) == 64
    assert most_together(longest) == 1
    assert signals_of(long) <= 256e6
