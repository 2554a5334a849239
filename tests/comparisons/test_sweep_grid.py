"""A sweep's grid: its axes, its runs, and the jobs that they are put into."""

from __future__ import annotations

import math

import pytest

from comparisons.sweep.grid import AXES, as_seeds, built_in_grid, own_grid
from comparisons.sweep.jobs import plan
from comparisons.sweep.scenario import group_of, most_together
from kfopc_filterpy.bench import algorithms


def test_every_combination_has_a_run_for_each_seed():
    grid = own_grid({"a": [1, 2], "b": "x", "c": (None, True, 0.5)}, [5, 0])
    runs = list(grid.runs())
    assert len(grid) == len(runs) == 2 * 1 * 3 * 2
    assert [run.index for run in runs] == list(range(12))
    assert [(run.values["a"], run.values["c"], run.seed) for run in runs[:5]] == [
        (1, None, 5),
        (1, None, 0),
        (1, True, 5),
        (1, True, 0),
        (1, 0.5, 5),
    ]
    assert [run.cell for run in runs] == [i // 2 for i in range(12)]
    assert runs[3].scenario == {"a": 1, "b": "x", "c": True, "seed": 0}
    assert grid.swept == ["a", "c"]


def test_axes_not_named_have_their_default():
    grid = built_in_grid({"rated_power_db": [-20, -10.0], "algorithm": "kf-pb"}, 2)
    assert list(grid.axes) == list(AXES)
    assert grid.axes["rated_power_db"] == (-20.0, -10.0)
    assert grid.axes["algorithm"] == ("KF-PB",)  # the name as the studies write it
    assert grid.axes["n_taps"] == (128,)
    assert grid.seeds == (1, 2)


def test_names_may_have_hyphens_for_spaces():
    grid = built_in_grid({"noise": "band-noise", "amplifier": ["Hard-Clip", "soft"], "path": "Band pass"}, 1)
    assert grid.axes["noise"] == ("band noise",)
    assert grid.axes["amplifier"] == ("hard clip", "soft")
    assert grid.axes["path"] == ("band-pass",)


@pytest.mark.parametrize("name", algorithms())
def test_every_listed_algorithm_is_known(name):
    assert built_in_grid({"algorithm": name, "setting": "tuned"}, 1).axes["algorithm"] == (name,)


def test_an_algorithm_of_two_settings_has_to_be_tuned():
    with pytest.raises(ValueError, match=r'leaky FxLMS has two settings.*give setting "tuned"'):
        built_in_grid({"algorithm": ["KF-OPC", "leaky FxLMS"]}, 1)


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ({"colour": "red"}, "no axis called colour; there are path, noise"),
        ({"algorithm": "KF-XYZ"}, "algorithm must be one of KF-ANC, KF-OPC, .*got 'KF-XYZ'"),
        ({"algorithm": 3}, "algorithm must be one of"),
        ({"algorithm": []}, "algorithm must have at least one value"),
        ({"n_taps": 0}, "n_taps must be at least 1, got 0"),
        ({"duration_s": [1.0, 0.0]}, "duration_s must be"),
        ({"duration_s": -2}, "duration_s must be"),
        ({"setting": 0.0}, "setting must be"),
        ({"setting": "best"}, 'setting must be a number above 0, "default" or "tuned"'),
        ({"rated_power_db": math.nan}, "rated_power_db must be"),
        ({"rated_power_db": [-10, -10.0]}, r"rated_power_db holds -10\.0 twice"),
        ({"path": "pipe"}, "path must be one of band-pass, duct, measured duct, got 'pipe'"),
        ({"noise": "silence"}, "noise must be one of tone, "),
        ({"amplifier": "valve"}, "amplifier must be one of linear, hard clip, soft, got 'valve'"),
    ],
)
def test_grid_refuses_what_is_no_axis_or_value(axes, message):
    with pytest.raises(ValueError, match=message):
        built_in_grid(axes, 1)


@pytest.mark.parametrize(
    ("axes", "message"), [({"n_taps": 3.5}, "n_taps must be a whole number"), ({"path_delay": "late"}, "path_delay")]
)
def test_grid_refuses_values_of_another_type(axes, message):
    with pytest.raises(TypeError, match=message):
        built_in_grid(axes, 1)


@pytest.mark.parametrize(
    ("seeds", "error", "message"),
    [
        (0, ValueError, "seeds must be at least 1"),
        ([], ValueError, "seeds must have at least one value"),
        ([1, 1], ValueError, "seeds holds 1 twice"),
        ([-1], ValueError, "seeds must be at least 0"),
        (2.5, TypeError, "seeds must be a whole number"),
    ],
)
def test_seeds_refused(seeds, error, message):
    with pytest.raises(error, match=message):
        as_seeds(seeds)


@pytest.mark.parametrize(
    ("axes", "error", "message"),
    [
        ({}, ValueError, "grid must have at least one axis"),
        ({"seed": [1]}, ValueError, 'not be called "seed"'),
        ({"a": []}, ValueError, "a must have at least one value"),
        ({"a": [math.inf]}, ValueError, "a must hold finite numbers"),
        ({"a": [object()]}, TypeError, "a must hold numbers, strings, booleans or None, got object"),
    ],
)
def test_own_axes_refused(axes, error, message):
    with pytest.raises(error, match=message):
        own_grid(axes, 1)


# Jobs.


def runs_of(axes, seeds):
    return list(built_in_grid(axes, seeds).runs())


def test_jobs_hold_each_run_once_and_only_what_shares():
    pending = runs_of({"rated_power_db": list(range(-20, 0)), "algorithm": ["KF-ANC", "KF-OPC", "FxLMS"]}, 3)
    jobs = plan(pending, 2)
    assert sorted(run.index for job in jobs for run in job) == [run.index for run in pending]
    for job in jobs:
        assert len({group_of(run.scenario) for run in job}) == 1
        assert len(job) <= most_together(job[0].scenario)
    # KF-ANC and KF-OPC of one noise: 40 runs of one gain sequence.
    assert max(len(job) for job in jobs) == 40


def test_one_gain_sequence_is_spread_over_all_cores():
    pending = runs_of({"rated_power_db": list(range(-20, 0))}, 1)
    assert [len(job) for job in plan(pending, 1)] == [20]
    assert [len(job) for job in plan(pending, 2)] == [10, 10]
    assert [len(job) for job in plan(pending, 3)] == [7, 7, 6]


@pytest.mark.parametrize(
    "axis", ["path", "noise", "duration_s", "n_taps", "sensor_noise_db", "path_gain_db", "path_delay", "setting"]
)
def test_runs_that_differ_in_reference_path_or_setting_do_not_share(axis):
    values = {"path": ["duct", "band-pass"], "noise": ["tone", "bursts"], "n_taps": [32, 64]}.get(axis, [1.0, 2.0])
    one, other = runs_of({axis: values}, 1)
    assert group_of(one.scenario) != group_of(other.scenario)


def test_long_runs_are_fewer_together_so_that_memory_is_bounded():
    def signals_of(run):
        return most_together(run.scenario) * 8 * 5 * 16000 * run.values["duration_s"]

    short, long, longest = runs_of({"duration_s": [4.0, 60.0, 3600.0]}, 1)
    assert most_together(short.scenario) == 64
    assert most_together(longest.scenario) == 1
    assert signals_of(long) <= 256e6
