"""The registry of algorithms that studies compare, and the tuner with two settings, refusals and divergence."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from comparisons.bench import registry as algorithms
from comparisons.bench.registry import REGISTRY, make_controller
from comparisons.bench.scene import Runs, Scene, make_scene
from comparisons.bench.tuning import AllDivergedError, Trial, best_setting, run_setting, try_settings, tune
from kfopc_filterpy import HardClipAmplifier, Plant
from kfopc_filterpy.paths import duct_plant
from kfopc_filterpy.signals import band_limited_noise

FS = 16000.0


@pytest.fixture(scope="module")
def scene() -> Scene:
    duct = duct_plant(fs=FS)
    short = Plant(duct.secondary[..., :80], duct.primary[..., :120], fs=FS)  # type: ignore[index]
    noise = band_limited_noise((100.0, 2000.0), 0.6, fs=FS, rng=3)
    return make_scene({3: noise}, short, rated_power=0.5, power_multiple=4.0, n_taps=12, switch_on_s=0.1)


def middle(name: str) -> Any:
    own = REGISTRY[name]
    first = own.first[len(own.first) // 2]
    return (first, own.second[len(own.second) // 2]) if own.second else first


@pytest.mark.parametrize("name", algorithms.algorithms())
def test_each_is_made_as_the_registry_says(name: str, scene: Scene) -> None:
    estimate = 0.5 * scene.secondary
    model = HardClipAmplifier(3.0) if REGISTRY[name].knows_amplifier else None
    known = replace(scene, secondary_estimate=estimate)
    controller = make_controller(known, name, middle(name), amplifier=model)
    assert controller.name == name
    np.testing.assert_array_equal(np.ravel(controller.secondary), estimate)
    assert controller.weights.shape == (12,)
    rated = 0.5 if REGISTRY[name].sees_budget and name != "MOV-FxLMS by variance" else None
    assert getattr(controller, "rated_power", None) == rated
    result = run_setting(scene, name, middle(name))
    assert result is not None
    assert result.algorithm == name


@pytest.mark.parametrize("name", [name for name, own in REGISTRY.items() if not own.sees_budget])
def test_runs_that_do_not_see_the_budget_serve_for_all(name: str, scene: Scene) -> None:
    results = [run_setting(replace(scene, rated_power=p), name, middle(name)) for p in (0.1, 1.0)]
    assert results[0] is not None
    assert results[1] is not None
    np.testing.assert_array_equal(results[0].error, results[1].error)


def test_settings_are_in_the_units_of_the_scene(scene: Scene) -> None:
    x = scene.references[0]
    filtered = np.mean(np.convolve(x, scene.secondary)[: x.size] ** 2)
    assert REGISTRY["KF-OPC"].value(scene, 1e-6) == pytest.approx(1e-6 * scene.measurement_noise / filtered, rel=1e-12)
    assert REGISTRY["leaky FxLMS"].value(scene, (0.1, 3.0)) == pytest.approx(0.1 / (12 * filtered), rel=1e-12)
    assert REGISTRY["FxRLS"].value(scene, 1e-4) == 1e-4
    leaky: Any = make_controller(scene, "leaky FxLMS", (0.1, 3.0))
    assert leaky.leak == pytest.approx(3.0 * filtered, rel=1e-12)
    fixed: Any = make_controller(scene, "MOV-FxLMS fixed", (0.1, 3.0))
    assert fixed.penalty_factor == pytest.approx(3.0 * filtered / np.mean(x**2), rel=1e-12)
    computed: Any = make_controller(scene, "MOV-FxLMS by variance", 0.1)
    gain = filtered / np.mean(x**2)
    ratio = np.var(scene.disturbances[0][int(scene.switch_on_s * scene.fs) :]) / (gain * 0.5)
    assert computed.penalty_factor == pytest.approx(gain * (np.sqrt(ratio) - 1), rel=1e-12)
    assert ratio > 1.5  # the penalty acts
    peak: Any = make_controller(scene, "clipping FxLMS", (0.1, 0.25))
    assert peak.amplitude_limit == pytest.approx(np.sqrt(0.25 * 2.0), rel=1e-12)  # unconstrained power 4 * 0.5


def test_a_leak_is_at_most_the_whole_weight(scene: Scene) -> None:
    leaky: Any = make_controller(scene, "leaky FxLMS", (0.5, 1000.0))
    assert leaky.leak * leaky.step_size == pytest.approx(1.0)


def test_the_finer_grid_lies_between_the_neighbours_of_the_best() -> None:
    own = REGISTRY["leaky FxLMS"]
    best = (own.first[5], own.second[5])
    finer = np.array(own.finer(best))
    assert set(finer[:, 0]) == {best[0] / 2, best[0], 2 * best[0]}
    assert own.second[4] < finer[:, 1].min() < finer[:, 1].max() < own.second[6]
    assert REGISTRY["FxLMS"].finer(0.1) == []


def test_tuning_two_settings_follows_the_rule(scene: Scene) -> None:
    """Grid, then the finer one, then the rule: recomputed here from plain runs."""
    runs, n_settings = Runs(), len(REGISTRY["leaky FxLMS"].grid)
    best = tune(runs, scene, ["leaky FxLMS"])["leaky FxLMS"]
    assert runs.done == n_settings  # those of the grid are the ones planned
    assert len(best.trials) == n_settings + 30
    kept = {}
    for trial in (trial for trial in best.trials if not trial.diverged):
        result = run_setting(scene, "leaky FxLMS", trial.setting)
        assert result is not None
        nse = float(np.mean(result.nse_db(scene.nse_window_s)))
        assert trial.mean_nse_db == pytest.approx(nse, rel=1e-12)
        if result.output_power <= 1.02 * scene.rated_power:
            kept[trial.setting] = round(nse, 2)
    assert best.within_budget
    assert kept[best.setting] == min(kept.values())


class RefusingScene(Scene):
    """A scene in which every filter refuses to go on."""

    def run(self, controller: Any, k: int = 0) -> Any:
        error = ValueError("P is not positive definite")
        error.add_note("in sample 3 of the run")
        raise error


class DivergingScene(Scene):
    """A scene whose second seed ends in a divergence."""

    def run(self, controller: Any, k: int = 0) -> Any:
        return replace(super().run(controller, k), diverged_at_s=0.2 if k else None)


def test_a_filter_that_refuses_to_go_on_counts_as_diverged(scene: Scene) -> None:
    scene = RefusingScene(**vars(scene))
    trials = try_settings(Runs(), scene, {"FxRLS": [1e-5]})["FxRLS"]
    assert trials == [Trial(1e-5, np.inf, np.inf, 0.0)]
    assert trials[0].diverged
    with pytest.raises(ValueError, match="not positive definite"):  # no other may
        try_settings(Runs(), scene, {"FxLMS": [0.1]})
    with pytest.raises(ValueError, match="forgetting must be"):  # nor may a bad setting count as divergence
        try_settings(Runs(), scene, {"FxRLS": [1.5]})


def test_edges_of_one_and_of_two_settings(scene: Scene) -> None:
    def at_edge(trials: list[Trial]) -> bool:
        best = best_setting(scene, "FxLMS", trials)
        assert best is not None
        return best.at_edge

    one = [Trial(s, -s, 0.1) for s in (1.0, 2.0, 3.0)]
    assert at_edge(one)
    assert not at_edge([replace(one[1], mean_nse_db=-9.0), one[0], one[2]])
    two = [Trial((a, b), -9.0 * (a == b == 2.0), 0.1) for a in (1.0, 2.0, 3.0) for b in (1.0, 2.0, 3.0)]
    assert not at_edge(two)
    assert at_edge([replace(t, mean_nse_db=-10.0) if t.setting == (2.0, 3.0) else t for t in two])


def test_trials_are_means_over_seeds_and_one_divergence_is_all(scene: Scene) -> None:
    two = replace(scene, references=2 * scene.references, disturbances=2 * scene.disturbances, seeds=[3, 4])
    (both,) = try_settings(Runs(), two, {"FxLMS": [0.1]}, seeds=2)["FxLMS"]
    results = [run_setting(two, "FxLMS", 0.1, k) for k in range(2)]
    powers = [result.output_power for result in results if result is not None]
    reductions = [result.noise_reduction_db for result in results if result is not None]
    assert both.output_power == pytest.approx(np.mean(powers), rel=1e-12)
    assert both.noise_reduction_db == pytest.approx(np.mean(reductions), rel=1e-12)
    two = DivergingScene(**vars(two))
    (lost,) = try_settings(Runs(), two, {"FxLMS": [0.1]}, seeds=2)["FxLMS"]
    assert lost == Trial(0.1, np.inf, np.inf, 0.2)
    assert best_setting(two, "FxLMS", [lost]) is None
    with pytest.raises(AllDivergedError, match=r"FxLMS diverged at every setting tried: \[0\.1\]"):
        tune(Runs(), two, ["FxLMS"], trials={"FxLMS": [lost]})
