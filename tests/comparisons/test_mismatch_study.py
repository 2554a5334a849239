"""The study of mismatch on a small scale, its claims, the bound of 90 degrees from theory."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.studies import plain_run, row_of, run_study, short_duct, smaller

from comparisons.studies import cases, mismatch
from comparisons.studies.cases import Case
from comparisons.studies.mismatch import EXACT, WRONG, MismatchRow, case_scene
from kfopc_filterpy import Plant, fx_lms, simulate
from kfopc_filterpy.paths import path_taps, perturbed_path
from kfopc_filterpy.signals import tone

TAPS = 16
STUDIED = ("KF-ANC", "KF-OPC", "KF-PB", "FxLMS", "MOV-FxLMS")
AMOUNTS = {"phase": (0.0, 45.0, 120.0), "gain": (-6.0, 0.0), "delay": (0.0,)}


@pytest.fixture(scope="module")
def small() -> Any:
    """Few taps, one second, one pair of paths cut short, no measured data."""
    short = short_duct()
    constants = {"ALGORITHMS": STUDIED, "AMOUNTS": AMOUNTS, "DURATION_S": 1.0}
    with smaller(cases, N_TAPS=TAPS), smaller(mismatch, ducts=lambda: short, **constants):
        return run_study(mismatch), case_scene(Case("duct", "tone"), short["duct"])


@pytest.mark.parametrize("algorithm", ["KF-OPC", "FxLMS"])
def test_rows_are_those_of_plain_runs(small: Any, algorithm: str) -> None:
    report, scene = small
    place = {"noise": "tone", "kind": "phase", "amount": 45.0, "tuned_with": EXACT}
    row = row_of(report, algorithm=algorithm, **place)
    estimate = path_taps(perturbed_path(scene.secondary, fs=16000.0, phase_deg=45.0))
    wrong = replace(scene, secondary_estimate=estimate)
    result = plain_run(wrong, algorithm, row["setting"])
    # Kalman filters run together add in another order.
    assert row["noise_reduction_db"] == pytest.approx(result.noise_reduction_db, abs=1e-6)
    assert row["power"] == pytest.approx(result.output_power / scene.rated_power, rel=1e-6)


# ---- Theory


@pytest.mark.parametrize(("phase_deg", "grows"), [(0.0, False), (80.0, False), (-100.0, True)])
def test_fxlms_of_a_tone_decays_below_90_degrees_and_grows_past_it(phase_deg: float, grows: bool) -> None:
    """The weight error of a tone has the exponent -mu L |X'|^2 cos(phase) / 2 a sample, for small step sizes.

    |X'| is the amplitude of the filtered reference over sqrt 2, the taps hold whole periods (20 taps of 800 Hz at 16
    kHz), and the error decays with the weights. The formula is of first order in the step size: 10 % at these.
    """
    fs, taps, mu = 16000.0, 20, 2e-5
    path = np.zeros(5)
    path[3] = 1.0
    turn = 2 * np.pi * 800.0 / fs
    # Two taps that turn the tone by the phase exactly: a + b z^-1 = e^{j phase} at it.
    b = -np.sin(np.deg2rad(phase_deg)) / np.sin(turn)
    a = np.cos(np.deg2rad(phase_deg)) - b * np.cos(turn)
    estimate = np.convolve(path, [a, b])
    x = tone(800.0, 3.0, fs=fs)
    result = simulate(fx_lms(taps, estimate, step_size=mu), x, Plant(path, -path, fs=fs))
    e = result.error
    early, late = (np.mean(e[round(t * fs) : round((t + 0.2) * fs)] ** 2) for t in (0.5, 2.5))
    exponent = np.log(late / early) / 2 / (2.0 * fs)
    expected = -mu * taps * 0.5 * np.cos(np.deg2rad(phase_deg)) / 2
    assert exponent == pytest.approx(expected, rel=0.1)
    assert (late > early) == grows


def row(kind: str, amount: float, algorithm: str, tuned_with: str, **more: Any) -> MismatchRow:
    own: dict[str, Any] = {"path": "duct", "noise": "band noise", "noise_reduction_db": 6.0, "power": 1.0} | more
    return MismatchRow(kind=kind, amount=amount, algorithm=algorithm, tuned_with=tuned_with, **own)


def test_claims_from_rows_made_by_hand() -> None:
    rows = [
        *(row("phase", amount, name, WRONG) for amount in (0.0, 80.0) for name in ("FxLMS", "KF-ANC")),
        row("phase", 90.0, "FxLMS", WRONG, noise_reduction_db=-3.0),  # on the bound: says nothing
        row("phase", 120.0, "FxLMS", EXACT, noise_reduction_db=3.0),  # another tuning
        row("phase", 120.0, "FxLMS", WRONG, noise_reduction_db=np.nan, diverged_at_s=1.0),
        row("phase", 120.0, "KF-ANC", WRONG, noise_reduction_db=0.5),
        *(row("gain", 0.0, name, EXACT) for name in ("KF-ANC", "KF-PB")),
        row("gain", 12.0, "KF-ANC", EXACT, noise_reduction_db=4.0),
        row("gain", -12.0, "KF-PB", EXACT, noise_reduction_db=5.5, power=0.98),
        *(row("delay", amount, "KF-OPC", EXACT, diverged_at_s=1.0) for amount in (4.0, 7.0)),
    ]
    claims = mismatch.claims(rows)
    assert [claim.value for claim in claims] == pytest.approx([6.0, -np.inf, 6.0, 0.5, 2.0, 0.5, 2, 0.98, 1.0])
    assert [k for k, claim in enumerate(claims) if not claim.holds] == [3, 4, 6]
