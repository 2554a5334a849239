"""The laws against what the code of the paper's first author gave under GNU Octave: the first second of three runs.

All agree to 1e-10, or as the tests say: sums are added up in another order, which changes the last digits.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracles import lms, signals
from oracles.powers import Constraint

from comparisons.bench.measured import load_measured_duct
from comparisons.rivals import ImprovedMOV
from comparisons.rivals.improved_mov import FLOOR, WINDOW
from comparisons.studies import duct, tonal
from comparisons.studies.cases import AUTHORS
from kfopc_filterpy import HardClipAmplifier, OutputPowerConstraint, Plant, mov_fx_lms, noise_reduction_db, simulate
from kfopc_filterpy.signals import tone

CASES = ("duct", "broadband", "tone")


class Case:
    """Inputs and settings of a case, and what the code gave."""

    def __init__(self, runs: Any, name: str) -> None:
        self.of = lambda key: runs[f"{name}/{key}"]
        self.x, self.d = self.of("reference"), self.of("disturbance")
        self.L, self.fixed = int(self.of("settings/n_taps")), float(self.of("settings/fixed_penalty_factor"))
        self.mu, self.rated_power = float(self.of("settings/step_size")), float(self.of("settings/rated_power"))
        self.primary, self.secondary = (runs[f"broadband/{path}"] for path in ("primary", "secondary"))
        if name == "duct":
            duct = load_measured_duct("compressor", "author")
            self.primary, self.secondary = duct.primary, duct.secondary

    def run(self, controller: Any, amplifier: Any = None) -> Any:
        return simulate(controller, self.x, Plant(self.secondary, amplifier=amplifier, fs=16000), disturbance=self.d)

    def assert_equal(self, algorithm: str, error: np.ndarray, control_signal: np.ndarray) -> None:
        np.testing.assert_allclose(error, self.of(f"{algorithm}/error"), rtol=0, atol=1e-10)
        np.testing.assert_allclose(control_signal, self.of(f"{algorithm}/control_signal"), rtol=0, atol=1e-10)


@pytest.fixture
def authors_runs(shared_data: Path) -> Any:
    runs = shared_data / "author_code" / "runs.npz"
    if not runs.is_file():
        pytest.skip(f"no runs of the authors' code: {runs} is not there")
    return np.load(runs)


@pytest.fixture(params=CASES)
def case(request: pytest.FixtureRequest, shared_data: Path, authors_runs: Any, monkeypatch: pytest.MonkeyPatch) -> Case:
    monkeypatch.setenv("KFOPC_DATA", str(shared_data))
    return Case(authors_runs, request.param)


def test_a_fixed_penalty_is_the_authors(case: Case) -> None:
    result = case.run(mov_fx_lms(case.L, case.secondary, step_size=case.mu, penalty_factor=case.fixed, fs=16000))
    case.assert_equal("fixed", result.error, result.control_signal)


@pytest.mark.parametrize("clips_at", [None, np.sqrt(2.0)])
def test_the_improved_form_is_the_authors(case: Case, clips_at: float | None) -> None:
    controller = ImprovedMOV(
        case.L, case.secondary, step_size=case.mu, rated_power=case.rated_power, primary=case.primary
    )
    algorithm, amplifier = "improved_mov", None
    if clips_at:
        algorithm, amplifier = "improved_mov_clipped", HardClipAmplifier(clips_at)
    result = case.run(controller, amplifier)
    case.assert_equal(algorithm, result.error, result.control_signal)
    assert controller.gamma == pytest.approx(case.of(f"{algorithm}/penalty_factor")[-1], abs=1e-10)


class SumsWithFloors(Constraint):
    """The authors' powers: sums over a window that begins with zeros, with floors for x and x'."""

    def __init__(self, rated_power: float) -> None:
        super().__init__(rated_power)
        self.squares = np.zeros((3, WINDOW))

    def take(self, d2: float, xf2: float, x2: float) -> float:
        self.squares = np.roll(self.squares, 1, axis=1)
        self.squares[:, 0] = d2, xf2, x2
        sums = np.maximum(self.squares.sum(axis=1), [0.0, FLOOR, FLOOR])
        self.disturbance_power, self.gain = sums[0] / WINDOW, sums[1] / sums[2]
        return 1.0


def test_mov_mfxlms_is_the_authors_but_for_the_powers(case: Case) -> None:
    """With their sums the oracle of our law agrees; with a sliding window the first 64 ms differ, and not the level."""
    oracle = lms.MOVFxLMS(
        s_hat=case.secondary[None, None],
        n_taps=case.L,
        constraints=[SumsWithFloors(case.rated_power)],
        mu=case.mu,
        modified=True,
    )
    found = signals.run(oracle, case.x[None], case.d[None], case.secondary[None, None])
    case.assert_equal("mov_mfxlms", found.e[0], found.y[0])
    constraint = OutputPowerConstraint(case.rated_power, fs=16000, memory_s=WINDOW / 16000, window="sliding")
    result = case.run(mov_fx_lms(case.L, case.secondary, step_size=case.mu, constraint=constraint, modified=True))
    theirs = noise_reduction_db(case.of("mov_mfxlms/error"), case.d)
    assert noise_reduction_db(result.error, case.d) == pytest.approx(theirs, abs=0.002)


def test_the_studies_have_the_authors_settings(authors_runs: Any) -> None:
    """Their band-pass paths bit for bit, their window, their tone to 1 %, and their compressor of unit variance."""
    plant = AUTHORS.plant()
    np.testing.assert_array_equal(plant.primary[0, 0], authors_runs["broadband/primary"])
    np.testing.assert_array_equal(plant.secondary[0, 0], authors_runs["broadband/secondary"])
    assert (AUTHORS.n_taps, AUTHORS.memory_s * 16000, AUTHORS.window) == (256, WINDOW, "sliding")
    sine = tone(400.0, 1.5, fs=16000)
    scene = AUTHORS.scene({0: sine}, plant, rated_power=tonal.RATED_POWER, power_multiple=tonal.POWER_MULTIPLE)
    assert np.max(scene.references[0]) == pytest.approx(np.max(authors_runs["tone/reference"]), rel=0.01)
    assert np.sqrt(2.0) == tonal.LIMIT
    noise = np.random.default_rng(0).standard_normal(16000)
    short = Plant([1.0], [0.0, 1.0], fs=16000)
    scene = duct.scene_of(noise, short, as_authors=True)
    assert np.var(scene.references[0]) == pytest.approx(1.0)
    assert scene.power_window == "sliding"
    assert scene.unconstrained_power == pytest.approx(1.0, rel=0.02)  # white noise through a delay
