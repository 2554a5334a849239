"""The study of the constraint on a small scale, its claims from rows made by hand, its scenes against a dense solve."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.studies import run_study, short_duct, smaller

from comparisons.bench import Scene, StudyReport
from comparisons.studies import cases, constraint
from comparisons.studies.cases import make_case
from comparisons.studies.constraint import ClippedRow, ConstraintRow
from kfopc_filterpy.paths import duct_plant

TAPS = 16
STUDIED = ("tone", "swelling band noise")


# ---- The study


@pytest.fixture(scope="module")
def report() -> StudyReport:
    """The study without measured data: one pair of paths, two noises, one seed, two seconds, 16 taps."""
    made = cases.made_noises()
    constants = {
        "N_TAPS": TAPS,
        "DURATIONS_S": (2.0,),
        "SEEDS": (1,),
        "CLIPPED_NOISES": ("tone",),
        "plants": short_duct,
    }
    with smaller(constraint, noises=lambda: {name: made[name] for name in STUDIED}, **constants):
        assert cases.measured_data() is None
        assert list(cases.plants()) == ["band-pass", "duct"]
        assert list(cases.noises()) == list(NOISES)
        return run_study(constraint)


def test_rows_say_what_such_runs_must_give(report: StudyReport) -> None:
    for row in report.extra["rows"]:
        if row["algorithm"].endswith("limited"):
            assert row["worst_window"] <= 1 + 1e-9
        if row["noise"] == "tone":
            # Cut to a share of the power that cancels it (1, to what the ridge and 40 dB of noise leave): the error of a
            # tone is 1 - sqrt(share) of the disturbance.
            assert row["bound_db"] == pytest.approx(-20 * np.log10(1 - np.sqrt(row["share"])), abs=0.05)


# ---- Claims


def row(kind: type = ConstraintRow, **changes: Any) -> Any:
    values: dict[str, Any] = {"path": "duct", "noise": "tone", "algorithm": "KF-PB", "worst_window": 1.0, "power": 1.0}
    if kind is ConstraintRow:
        values |= {"share": 0.25, "duration_s": 8.0, "seed": 1, "bound_db": 10.0}
    return kind(**values | changes)


def test_claims_from_rows_made_by_hand() -> None:
    varying = {"noise": "swelling band noise", "noise_reduction_db": 9.2}
    rows = [
        row(power=1.01, noise_reduction_db=9.7),
        row(seed=2, power=0.96, noise_reduction_db=9.8),
        row(**varying, power=1.04),
        row(**varying, power=2.0, duration_s=2.0),  # varying noises are judged over the longest runs
        row(algorithm="KF-PB limited", noise_reduction_db=8.0),
        row(algorithm="KF-OPC limited", noise_reduction_db=8.2),
    ]
    clipped = [row(ClippedRow, algorithm="KF-PB limited", known="path", worst_window=1 + 2e-9)]
    settled = {"this": {"KF-PB": 0.5, "KF-ANC": 0.4}, "other": {"KF-PB": 5.0, "KF-ANC": np.nan}}  # that does not settle
    claims = constraint.claims(rows, clipped, settled)
    expected = [1.01, 0.96, 0.3, 1.04, 0.8, 1 + 2e-9, 0.2, -0.1]
    assert [claim.value for claim in claims] == pytest.approx(expected, rel=1e-12)
    assert [k for k, claim in enumerate(claims) if not claim.holds] == [1, 5]
    lost = row(seed=3, power=np.nan, noise_reduction_db=np.nan)
    claims = constraint.claims([*rows, lost], clipped, {"this": {"KF-PB": np.nan, "KF-ANC": 0.4}})
    assert [k for k, claim in enumerate(claims) if not claim.holds] == [0, 1, 2, 5, 7]


# ---- The scenes


def unconstrained_power(scene: Scene) -> float:
    """E[y^2] of the w of (R_x' + q/(N P0) I) w = r over the samples from switch-on on, with what was before in the lines."""
    start, taps = round(scene.switch_on_s * scene.fs), scene.n_taps
    x, d = scene.references[0], scene.disturbances[0][start:]

    def delayed(signal: np.ndarray) -> np.ndarray:
        return np.stack([signal[start - k : signal.size - k] for k in range(taps)], axis=1)

    filtered = delayed(np.convolve(x, scene.secondary)[: x.size])
    ridge = scene.measurement_noise / (d.size * scene.initial_variance)
    correlations = filtered.T @ filtered / d.size + ridge * np.eye(taps)
    weights = np.linalg.solve(correlations, filtered.T @ d / d.size)
    return float(np.mean((delayed(x) @ weights) ** 2))


NOISES = ("tone", "compressor", "band noise", "bursts", "swelling band noise")


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scene]:
    """Cases of two seconds in the duct. Without the ridge band noise would ask for 1.2 times the power."""
    made, plant = cases.made_noises(), duct_plant(fs=cases.FS)
    return {noise: make_case(plant, made[noise](2.5, 3), n_taps=160) for noise in NOISES}


def test_the_unconstrained_control_power_is_one(scenes: Any) -> None:
    """1e-6: two ways to solve a system whose condition the ridge bounds; noise is what is left of 1e-16 times 1e8."""
    for noise, scene in scenes.items():
        assert unconstrained_power(scene) == pytest.approx(1.0, rel=1e-6), noise
        after = scene.disturbances[0][8000:]
        assert scene.sensor_noise_std**2 / np.mean(after**2) == pytest.approx(1e-4, rel=1e-9)  # 40 dB below


def test_measured_data_join_where_they_are_at_hand(shared_data: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KFOPC_DATA", str(shared_data))
    cases.measured_data.cache_clear()
    plants, made = cases.plants(), cases.noises()
    cases.measured_data.cache_clear()
    assert (list(plants)[-1], list(made)[-1]) == ("measured duct", "motor")
    assert np.sum(plants["measured duct"].secondary ** 2) == pytest.approx(1.0, rel=1e-12)
    motor = [made["motor"](0.5, seed) for seed in (1, 2)]
    assert not np.array_equal(*motor)
    # 18 cases: 6 settings, 2 durations with 4 seeds each; convergence on 9, clipping of 6
    assert constraint.planned_runs() == 18 * 6 + 18 * 8 + 9 + 6
