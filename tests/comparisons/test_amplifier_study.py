"""The study of the amplifier on a small scale, harmonics against the Fourier series, claims from rows made by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from comparisons import __main__ as command
from comparisons.studies import amplifier, cases
from comparisons.studies.amplifier import KNOWN, UNKNOWN, AmplifierRow, saturating, settings_for
from comparisons.studies.cases import Case
from kfopc_filterpy import HardClipAmplifier, SoftSaturationAmplifier, noise_reduction_db, simulate
from kfopc_filterpy.bench import Runs, StudyReport, make_controller
from kfopc_filterpy.metrics import harmonics_db
from kfopc_filterpy.signals import tone

FS = 16000.0
TAPS = 16
STUDIED = ("KF-ANC", "FxLMS", "KF-OPC", "KF-PB", "clipping FxLMS")


@pytest.fixture(scope="module")
def small() -> Any:
    """Few taps, two seconds, one pair of paths cut short, two overdrives, hard clip on a tone and a band noise."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("KFOPC_DATA", "/no/such/folder")
        cases.measured_data.cache_clear()
        short = {"duct": tuple(path[:200] for path in cases.ducts()["duct"])}
        studied = [Case("duct", "tone", "hard clip"), Case("duct", "band noise", "soft saturation")]
        patch.setattr(cases, "N_TAPS", TAPS)
        patch.setattr(amplifier, "ducts", lambda: short)
        patch.setattr(amplifier, "cases", lambda names: studied)
        patch.setattr(amplifier, "ALGORITHMS", STUDIED)
        patch.setattr(amplifier, "OVERDRIVES_DB", (0.0, 10.0))
        patch.setattr(amplifier, "DURATION_S", 2.0)
        patch.setattr(amplifier, "PEAK_LIMITED", ("clipping FxLMS",))
        runs = Runs()
        report = amplifier.main(runs)
        planned = amplifier.planned_runs()
        scene = cases.driven_case(short["duct"], cases.noise_of("tone", 2.0), 0.0)
    cases.measured_data.cache_clear()
    return report, runs.done, planned, scene


def test_planned_runs_are_those_taken(small: Any) -> None:
    _, done, planned, _ = small
    # two cases, two overdrives: three filters of 5 settings twice, FxLMS of 14, clipping of 14 x 2; 5 + 3 at their best
    assert planned == done == 2 * 2 * (2 * 11 + 14 + 28 + 8)


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


def test_the_table_counts_the_rows(small: Any) -> None:
    (table,) = small[0].tables
    names = [
        (known, name) for known in (UNKNOWN, KNOWN) for name in STUDIED if known == UNKNOWN or name.startswith("KF")
    ]
    assert [(row[1], row[0]) for row in table.rows] == names
    rows = [row for row in small[0].extra["rows"] if (row["algorithm"], row["known"]) == ("KF-ANC", UNKNOWN)]
    over = sum(row["asked_power"] > 2.0 for row in rows)
    powers = sorted(row["power"] for row in rows)
    assert table.rows[0][2:6] == [len(rows), over, 0, f"{powers[0]:.3g} to {powers[-1]:.3g}"]
    assert over > 0


@pytest.mark.parametrize(("algorithm", "known"), [("KF-PB", UNKNOWN), ("KF-ANC", KNOWN), ("clipping FxLMS", UNKNOWN)])
def test_a_row_is_that_of_a_plain_run(small: Any, algorithm: str, known: str) -> None:
    report, _, _, scene = small
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
    scene = small[3]
    case = Case("duct", "tone", "soft saturation")
    driven = saturating(scene, case, 6.0, KNOWN)
    assert isinstance(driven.amplifier, SoftSaturationAmplifier)
    assert driven.known_amplifier is driven.amplifier
    assert driven.amplifier.limit == pytest.approx(np.sqrt(2 * 10**-0.6))
    assert saturating(scene, case, 6.0, UNKNOWN).known_amplifier is None
    assert amplifier.knowing() == ["KF-ANC", "KF-OPC", "KF-PB", "MOV-FxLMS"]


def test_peak_limits_go_up_to_the_amplifiers(small: Any) -> None:
    driven = saturating(small[3], Case("duct", "tone", "hard clip"), 10.0, UNKNOWN)
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


def _row(algorithm: str, overdrive_db: float = 10.0, **more: Any) -> AmplifierRow:
    values: dict[str, Any] = {
        "path": "duct",
        "noise": "tone",
        "amplifier": "hard clip",
        "known": UNKNOWN,
        "setting": 0.1,
        "within_budget": True,
        "noise_reduction_db": 5.0,
        "harmonics_db": -20.0,
        "coherence": np.nan,
        "power": 1.0,
        "asked_power": 1.0,
        "weight_growth": 1.0,
        "diverged_at_s": None,
    }
    return AmplifierRow(algorithm=algorithm, overdrive_db=overdrive_db, **{**values, **more})


@pytest.mark.parametrize(("asked", "at", "met"), [(2.1, None, True), (1.9, None, False), (np.nan, 1.0, True)])
def test_overrunning_is_asking_for_too_much_or_diverging(asked: float, at: float | None, met: bool) -> None:
    rows = [_row("KF-ANC", asked_power=9.0), _row("KF-ANC", 20.0, asked_power=asked, diverged_at_s=at)]
    rows += [_row("KF-ANC", 0.0), _row("KF-ANC", noise="band noise"), _row("KF-ANC", known=KNOWN)]  # not claimed
    assert amplifier._overruns(rows, "KF-ANC").holds == met


@pytest.mark.parametrize(("overdrive_db", "met"), [(5.0, False), (4.9, True)])
def test_overrunning_is_claimed_from_5_db_on(overdrive_db: float, met: bool) -> None:
    rows = [_row("KF-ANC", asked_power=9.0), _row("KF-ANC", overdrive_db, asked_power=1.9)]
    assert amplifier._overruns(rows, "KF-ANC").holds == met


def test_overruns_are_told_of_the_runs_that_went_on() -> None:
    rows = [_row("KF-ANC", asked_power=9.0, weight_growth=1.5), _row("KF-ANC", asked_power=4.0, weight_growth=1.25)]
    rows += [_row("KF-ANC", diverged_at_s=at, asked_power=np.nan, weight_growth=np.nan) for at in (0.5, 0.0, 1.0)]
    figure = amplifier._overruns(rows, "KF-ANC").measured
    assert figure.startswith("5 of 5 runs; their weights end up asking for 4 to 9 times the power")
    assert "and grow 1.25 to 1.5 times over the second half; 3 passed 1e6 times the rated amplitude" in figure


def test_overruns_of_no_run_prove_nothing() -> None:
    assert not amplifier._overruns([_row("KF-ANC", 0.0, asked_power=9.0)], "KF-ANC").holds


@pytest.mark.parametrize(("asked", "met"), [(1.9, True), (2.1, False)])
def test_the_known_amplifier_is_judged_where_known(asked: float, met: bool) -> None:
    rows = [_row("KF-ANC", asked_power=50.0), _row("KF-ANC", known=KNOWN, asked_power=asked)]
    assert amplifier._known(rows).holds == met


@pytest.mark.parametrize(("level", "met"), [(-60.1, True), (-59.9, False)])
def test_harmonics_are_compared_at_each_overdrive(level: float, met: bool) -> None:
    rows = [_row("KF-ANC"), _row("KF-OPC", harmonics_db=-70.0), _row("KF-PB", harmonics_db=level)]
    rows += [_row("KF-ANC", 0.0, harmonics_db=-62.0), _row("KF-OPC", 0.0, harmonics_db=-62.0)]  # nothing is clipped
    assert amplifier._clean(rows).holds == met


@pytest.mark.parametrize(
    ("anc_db", "pb_db", "said"),
    [
        (-20.0, -60.0, "by 40.0 dB at least (KF-PB, duct, tone, hard clip, 0.5 dB)"),
        (np.nan, -20.0, "by 50.0 dB at least (KF-OPC, duct, tone, hard clip, 10.0 dB)"),
        (-20.0, np.nan, "by nan dB at least (KF-PB, duct, tone, hard clip, 0.5 dB)"),
        (np.nan, np.nan, "by nan dB at least"),
    ],
)
def test_harmonics_of_a_run_that_diverged_meet_nothing(anc_db: float, pb_db: float, said: str) -> None:
    rows = [_row("KF-ANC"), _row("KF-OPC", harmonics_db=-70.0)]
    rows += [_row("KF-ANC", 0.5, harmonics_db=anc_db), _row("KF-PB", 0.5, harmonics_db=pb_db)]
    claim = amplifier._clean(rows)
    assert claim.holds == np.isfinite(pb_db)
    assert claim.measured.startswith(said)


@pytest.mark.parametrize(("power", "met"), [(1.02, True), (1.021, False), (np.nan, False)])
def test_power_is_kept_at_every_overdrive(power: float, met: bool) -> None:
    rows = [_row("KF-OPC"), _row("KF-PB"), _row("KF-PB", 20.0, power=power)]
    assert amplifier._power(rows).holds == met


@pytest.mark.parametrize(("reduction", "met"), [(5.01, True), (5.0, False), (4.99, False), (np.nan, False)])
def test_the_order_is_that_of_each_overdrive(reduction: float, met: bool) -> None:
    rows = [_row("KF-ANC"), _row("KF-OPC", noise_reduction_db=9.0), _row("KF-ANC", 0.0), _row("KF-OPC", 0.0)]
    rows += [_row("KF-ANC", 20.0), _row("KF-OPC", 20.0, noise_reduction_db=reduction)]
    claim = amplifier._ordering(rows)
    assert claim.holds == met
    assert ("not with tone at 20 dB" in claim.measured) != met


def test_the_command_knows_the_study() -> None:
    assert command.FURTHER["amplifier"] == (amplifier.main, amplifier.planned_runs)
    assert "amplifier" not in command.STUDIES
