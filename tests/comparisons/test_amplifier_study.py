"""The study of the amplifier on a small scale, harmonics against the Fourier series, claims from rows made by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.studies import run_study, short_duct, smaller

from comparisons.studies import amplifier, cases
from comparisons.studies.amplifier import KNOWN, UNKNOWN, AmplifierRow, saturating, settings_for
from comparisons.studies.cases import Case
from kfopc_filterpy import HardClipAmplifier, SoftSaturationAmplifier, noise_reduction_db, simulate
from kfopc_filterpy.bench import Claim, StudyReport, make_controller
from kfopc_filterpy.metrics import harmonics_db
from kfopc_filterpy.signals import tone

FS = 16000.0
TAPS = 16
STUDIED = ("KF-ANC", "FxLMS", "KF-OPC", "KF-PB", "clipping FxLMS")


@pytest.fixture(scope="module")
def small() -> Any:
    """Few taps, two seconds, one pair of paths cut short, two overdrives, hard clip on a tone and a band noise."""
    short = short_duct()
    studied = [Case("duct", "tone", "hard clip"), Case("duct", "band noise", "soft saturation")]
    constants = {"ALGORITHMS": STUDIED, "OVERDRIVES_DB": (0.0, 10.0), "DURATION_S": 2.0}
    own = {"all_cases": lambda names: studied, "PEAK_LIMITED": ("clipping FxLMS",)}
    with smaller(cases, N_TAPS=TAPS, ducts=lambda: short), smaller(amplifier, **constants, **own):
        return run_study(amplifier), cases.driven_case(short["duct"], cases.noise_of("tone", 2.0), 0.0)


def test_the_report_is_complete(small: Any) -> None:
    report: StudyReport = small[0]
    assert (report.name, report.claims_heading, len(report.claims)) == ("amplifier", "Findings", 6)
    assert [item.stem for item in report.figures] == ["duct-tone-hard-clip", "duct-band-noise-soft-saturation"]
    rows = report.extra["rows"]
    keys = [(row["noise"], row["overdrive_db"], row["known"], row["algorithm"]) for row in rows]
    assert len(keys) == len(set(keys)) == 2 * 2 * (5 + 3)
    assert all(np.isnan(row["coherence"]) == (row["noise"] == "tone") for row in rows if row["diverged_at_s"] is None)
    tried = report.parameters["settings"].value["duct, tone, hard clip"]["10 dB, unknown"]
    assert [len(tried[name]["tried"]) for name in STUDIED] == [5, 14, 5, 1, 28]


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
    result = simulate(
        make_controller(driven, algorithm, row["setting"], amplifier=clip if known == KNOWN else None),
        scene.references[0],
        disturbance=scene.disturbances[0],
        secondary_path=scene.secondary,
        fs=FS,
        amplifier=clip,
        rated_power=0.1,
        sensor_noise_std=scene.sensor_noise_std,
        rng=1000,
        switch_on_s=0.5,
        record_weights_every=160,
    )
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


# ---- Theory


@pytest.mark.parametrize("overdrive_db", [3.0, 10.0, 20.0])
def test_harmonics_of_a_clipped_sine_are_those_of_its_fourier_series(overdrive_db: float) -> None:
    """A sine of amplitude a clipped at 1 stays below it up to phi = asin(1/a); its odd sine coefficients follow.

    b_n = 2a/pi (sin((n-1) phi)/(n-1) - sin((n+1) phi)/(n+1)) + 4/(n pi) cos(n phi). The sampled clip aliases a little:
    at 200 Hz and 16 kHz no alias of a harmonic below the 40th falls upon the first ten.
    """
    a = 10 ** (overdrive_db / 20)
    y = tone(200.0, 2.0, fs=FS, amplitude=a, phase_rad=0.3)
    d = tone(200.0, 2.0, fs=FS, phase_rad=0.3)
    phi = np.arcsin(1 / a)
    n = np.array([3, 5, 7, 9])
    inside = np.sin((n - 1) * phi) / (n - 1) - np.sin((n + 1) * phi) / (n + 1)
    b = 2 * a / np.pi * inside + 4 / (n * np.pi) * np.cos(n * phi)
    expected = 10 * np.log10(np.sum(b**2))  # over a disturbance of amplitude 1
    measured = harmonics_db(d - HardClipAmplifier(1.0)(y), d, 200.0, FS)
    assert measured == pytest.approx(expected, abs=0.3)


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
        (OVERRUNS, row("KF-ANC", noise="band noise"), True),
        (OVERRUNS, row("KF-ANC", known=KNOWN), True),
        (CLIPPING_OVERRUNS, row("KF-ANC", asked_power=9.0), False),  # of no run
        (CLIPPING_OVERRUNS, row("clipping FxLMS", asked_power=2.1), True),
        (KNOWN_OVERRUNS_NOWHERE, row("KF-ANC", asked_power=50.0), True),
        (KNOWN_OVERRUNS_NOWHERE, row("KF-ANC", known=KNOWN, asked_power=1.9), True),
        (KNOWN_OVERRUNS_NOWHERE, row("KF-ANC", known=KNOWN, asked_power=2.1), False),
        (CLEAN, row("KF-PB", harmonics_db=-60.1), True),
        (CLEAN, row("KF-PB", harmonics_db=-59.9), False),
        (POWER, row("KF-PB", 20.0, power=1.02), True),
        (POWER, row("KF-PB", 20.0, power=1.021), False),
        (POWER, row("KF-OPC", 20.0, power=np.nan), False),
    ],
)
def test_claims_on_both_sides_of_each_threshold(which: int, changed: AmplifierRow, met: bool) -> None:
    assert claim(which, changed).holds == met


def test_nothing_is_claimed_of_harmonics_and_order_without_overdrive() -> None:
    clean = [row(name, 0.0, harmonics_db=-62.0) for name in ("KF-ANC", "KF-OPC", "KF-PB")]
    assert claim(CLEAN, *clean).holds
    assert claim(ORDER, *clean).holds


@pytest.mark.parametrize(("anc_db", "pb_db"), [(-20.0, -60.0), (np.nan, -20.0), (-20.0, np.nan), (np.nan, np.nan)])
def test_harmonics_of_a_run_that_diverged_meet_nothing(anc_db: float, pb_db: float) -> None:
    found = claim(CLEAN, row("KF-ANC", 0.5, harmonics_db=anc_db), row("KF-PB", 0.5, harmonics_db=pb_db))
    assert found.holds == np.isfinite(pb_db)


@pytest.mark.parametrize(("reduction", "met"), [(5.01, True), (5.0, False), (np.nan, False)])
def test_the_order_is_that_of_each_overdrive(reduction: float, met: bool) -> None:
    found = claim(ORDER, row("KF-OPC", 20.0, noise_reduction_db=reduction))
    assert found.holds == met
    assert ("not with tone at 20 dB" in found.measured) != met
