"""The study of the amplifier on a small scale, harmonics against the Fourier series, claims from rows made by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.studies import plain_run, run_study, short_duct, smaller

from comparisons.bench import Claim, make_controller
from comparisons.studies import amplifier, cases
from comparisons.studies.amplifier import KNOWN, UNKNOWN, AmplifierRow, saturating, settings_for
from comparisons.studies.cases import Case
from kfopc_filterpy import HardClipAmplifier, SoftSaturationAmplifier, noise_reduction_db
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
    (row,) = (
        r
        for r in report.extra["rows"]
        if (r["noise"], r["overdrive_db"], r["known"], r["algorithm"]) == ("tone", 10.0, known, algorithm)
    )
    driven = saturating(scene, Case("duct", "tone", "hard clip"), 10.0, known)
    clip = HardClipAmplifier(np.sqrt(2 * 0.1))  # 10 dB below the unconstrained power of 1
    amplifiers = {"amplifier": clip, "known": clip if known == KNOWN else None}
    result = plain_run(driven, algorithm, row["setting"], rated_power=0.1, record_weights_every=160, **amplifiers)
    assert result.weights is not None
    assert row["noise_reduction_db"] == pytest.approx(noise_reduction_db(result.error, result.disturbance), abs=1e-9)
    assert row["harmonics_db"] == pytest.approx(harmonics_db(result.error, result.disturbance, 300.0, FS), abs=1e-6)
    asked = np.convolve(result.reference, result.weights[-1])[: result.error.size]
    assert row["asked_power"] == pytest.approx(np.mean(asked[asked.size // 2 :] ** 2), rel=1e-9)


def test_known_amplifiers_reach_those_that_can_know_them(small: Any) -> None:
    scene = small[1]
    case = Case("duct", "tone", "soft saturation")
    driven = saturating(scene, case, 6.0, KNOWN)
    assert isinstance(driven.amplifier, SoftSaturationAmplifier)
    assert driven.known_amplifier is driven.amplifier
    assert driven.amplifier.limit == pytest.approx(np.sqrt(2 * 10**-0.6))
    assert saturating(scene, case, 6.0, UNKNOWN).known_amplifier is None
    assert amplifier.knowing() == ["KF-ANC", "KF-OPC", "KF-PB", "MOV-FxLMS"]


def test_peak_limits_go_up_to_the_amplifiers(small: Any) -> None:
    driven = saturating(small[1], Case("duct", "tone", "hard clip"), 10.0, UNKNOWN)
    limits = {
        round(make_controller(driven, "clipping FxLMS", setting).amplitude_limit, 9)
        for setting in settings_for(driven, ("clipping FxLMS",))["clipping FxLMS"]
    }
    assert limits == {round(driven.amplitude_limit, 9), round(float(np.sqrt(driven.rated_power)), 9)}


# ---- Claims from rows made by hand

OVERRUNS, CLIPPING_OVERRUNS, KNOWN_OVERRUNS_NOWHERE, CLEAN, POWER, ORDER = range(6)  # the claims


def row(algorithm: str, overdrive_db: float = 10.0, **more: Any) -> AmplifierRow:
    where = {"path": "duct", "noise": "tone", "amplifier": "hard clip", "known": UNKNOWN}
    figures = {"noise_reduction_db": 5.0, "harmonics_db": -20.0, "power": 1.0, "asked_power": 1.0, "weight_growth": 1.0}
    return AmplifierRow(algorithm=algorithm, overdrive_db=overdrive_db, **where | figures | more)  # type: ignore[arg-type]


GOOD = [
    one
    for overdrive_db in (2.0, 10.0, 20.0)
    for one in (
        row("KF-ANC", overdrive_db, asked_power=9.0),
        row("KF-ANC", overdrive_db, known=KNOWN),
        row("KF-OPC", overdrive_db, harmonics_db=-80.0, noise_reduction_db=9.0),
        row("KF-PB", overdrive_db, harmonics_db=-80.0),
    )
]


def claim(which: int, *rows: AmplifierRow) -> Claim:
    """Return a claim on good rows and these; a second KF-ANC at a place is what the others are compared with."""
    return amplifier.claims([*GOOD, *rows])[which]


@pytest.mark.parametrize(
    ("which", "changed", "met"),
    [
        (OVERRUNS, row("KF-ANC", asked_power=2.1), True),
        (OVERRUNS, row("KF-ANC", asked_power=1.9), False),
        (OVERRUNS, row("KF-ANC", asked_power=np.nan, diverged_at_s=1.0), True),
        (OVERRUNS, row("KF-ANC", 5.0), False),
        (OVERRUNS, row("KF-ANC", 4.9), True),  # not claimed, as little as the next two
        (CLIPPING_OVERRUNS, row("KF-ANC", asked_power=9.0), False),  # of no run
        (CLIPPING_OVERRUNS, row("clipping FxLMS", asked_power=2.1), True),
        (KNOWN_OVERRUNS_NOWHERE, row("KF-ANC", asked_power=50.0), True),
        (KNOWN_OVERRUNS_NOWHERE, row("KF-ANC", known=KNOWN, asked_power=1.9), True),
        (KNOWN_OVERRUNS_NOWHERE, row("KF-ANC", known=KNOWN, asked_power=2.1), False),
        (CLEAN, row("KF-PB", harmonics_db=-60.1), True),
        (CLEAN, row("KF-PB", harmonics_db=-59.9), False),
        (CLEAN, row("KF-PB", 0.0, harmonics_db=-20.0), True),  # no overdrive
        (CLEAN, row("KF-PB", harmonics_db=np.nan), False),
        (CLEAN, row("KF-ANC", harmonics_db=np.nan), True),
        (POWER, row("KF-PB", 20.0, power=1.02), True),
        (POWER, row("KF-PB", 20.0, power=1.021), False),
        (POWER, row("KF-OPC", 20.0, power=np.nan), False),
        (ORDER, row("KF-OPC", 20.0, noise_reduction_db=5.01), True),
        (ORDER, row("KF-OPC", 20.0, noise_reduction_db=5.0), False),
        (ORDER, row("KF-OPC", 20.0, noise_reduction_db=np.nan), False),
        (ORDER, row("KF-ANC", noise_reduction_db=np.nan), True),
        (ORDER, row("KF-OPC", 0.0), True),  # no overdrive
    ],
)
def test_claims_on_both_sides_of_each_threshold(which: int, changed: AmplifierRow, met: bool) -> None:
    assert claim(which, changed).holds == met
