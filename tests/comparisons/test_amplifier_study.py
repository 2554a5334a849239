"""The study of the amplifier on a small scale, harmonics against the Fourier series, claims."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.studies import plain_run, row_of, run_study, short_duct, smaller

from comparisons.bench import make_controller
from comparisons.studies import amplifier, cases
from comparisons.studies.amplifier import KNOWN, UNKNOWN, AmplifierRow, saturating, settings_for
from comparisons.studies.cases import Case
from kfopc_filterpy import HardClipAmplifier
from kfopc_filterpy.metrics import harmonics_db

FS = 16000.0
TAPS = 16
STUDIED = ("KF-ANC", "FxLMS", "KF-OPC", "KF-PB", "clipping FxLMS")


@pytest.fixture(scope="module")
def small() -> Any:
    """Few taps, a short run, one pair of paths cut short, two overdrives, hard clip on a tone and a band noise."""
    short = short_duct()
    studied = [Case("duct", "tone", "hard clip"), Case("duct", "band noise", "soft saturation")]
    constants = {"ALGORITHMS": STUDIED, "OVERDRIVES_DB": (0.0, 10.0), "DURATION_S": 1.1}
    own = {"all_cases": lambda names: studied, "PEAK_LIMITED": ("clipping FxLMS",)}
    with smaller(cases, N_TAPS=TAPS, ducts=lambda: short), smaller(amplifier, **constants, **own):
        return run_study(amplifier), cases.driven_case(short["duct"], cases.noise_of("tone", 1.1), 0.0)


@pytest.mark.parametrize(("algorithm", "known"), [("KF-PB", UNKNOWN), ("KF-ANC", KNOWN), ("clipping FxLMS", UNKNOWN)])
def test_a_row_is_that_of_a_plain_run(small: Any, algorithm: str, known: str) -> None:
    report, scene = small
    row = row_of(report, noise="tone", overdrive_db=10.0, known=known, algorithm=algorithm)
    driven = saturating(scene, Case("duct", "tone", "hard clip"), 10.0, known)
    clip = HardClipAmplifier(np.sqrt(2 * 0.1))  # 10 dB below the unconstrained power of 1
    amplifiers = {"amplifier": clip, "known": clip if known == KNOWN else None}
    result = plain_run(driven, algorithm, row["setting"], record_weights_every=160, **amplifiers)
    assert result.weights is not None
    assert row["noise_reduction_db"] == pytest.approx(result.noise_reduction_db, abs=1e-9)
    assert row["harmonics_db"] == pytest.approx(harmonics_db(result.error, result.disturbance, 300.0, FS), abs=1e-6)
    asked = np.convolve(result.reference, result.weights[-1])[: result.error.size]
    assert row["asked_power"] == pytest.approx(np.mean(asked[asked.size // 2 :] ** 2), rel=1e-9)


def test_peak_limits_go_up_to_the_amplifiers(small: Any) -> None:
    driven = saturating(small[1], Case("duct", "tone", "hard clip"), 10.0, UNKNOWN)
    limits = {
        round(make_controller(driven, "clipping FxLMS", setting).amplitude_limit, 9)
        for setting in settings_for(driven, ("clipping FxLMS",))["clipping FxLMS"]
    }
    assert limits == {round(driven.amplitude_limit, 9), round(float(np.sqrt(driven.rated_power)), 9)}


def row(algorithm: str, overdrive_db: float = 10.0, **more: Any) -> AmplifierRow:
    where = {"path": "duct", "noise": "tone", "amplifier": "hard clip", "known": UNKNOWN}
    figures = {"noise_reduction_db": 5.0, "harmonics_db": -20.0, "power": 1.0, "asked_power": 1.0, "weight_growth": 1.0}
    return AmplifierRow(algorithm=algorithm, overdrive_db=overdrive_db, **where | figures | more)  # type: ignore[arg-type]


def test_claims_from_rows_made_by_hand() -> None:
    rows = [
        row("KF-ANC", 2.0),  # below 5 dB nothing has to overrun
        row("KF-ANC", asked_power=9.0),
        row("KF-ANC", 20.0, asked_power=np.nan, diverged_at_s=1.0, noise_reduction_db=np.nan, harmonics_db=np.nan),
        *(row("KF-ANC", known=KNOWN, asked_power=asked) for asked in (1.9, 2.1)),
        row("clipping FxLMS"),
        *(row("KF-OPC", level, harmonics_db=-80.0, noise_reduction_db=9.0) for level in (2.0, 10.0, 20.0)),
        row("KF-PB", harmonics_db=-50.0, power=1.01),
    ]
    claims = amplifier.claims(rows)
    assert [claim.value for claim in claims] == pytest.approx([1.0, 0.0, 0.5, -30.0, 1.01, 4.0])
    assert [claim.holds for claim in claims] == [True, False, False, False, True, True]
