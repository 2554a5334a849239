"""The soak in short, and what it must notice."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.studies import smaller

from comparisons.__main__ import main
from comparisons.soak import study
from kfopc_filterpy import FxLMS, OutputLimiter, kf_anc, simulate

ROOT = Path(__file__).resolve().parents[2]
SHORT = 20_000


@pytest.mark.parametrize("case", study.all_cases(), ids=lambda case: f"{case.name}-{case.ratio}")
def test_every_controller_holds_for_a_while(case: study.Case) -> None:
    """The alternating noise shows all the others in turn; a case that has not got it runs on white noise."""
    signal = "alternating" if "alternating" in case.signals else "white"
    samples = round((4 * study.TURN + SHORT if signal == "alternating" else SHORT) * max(case.share, 0.25))
    outcome = study.soak(case, signal, samples)
    assert outcome.violations == []
    assert outcome.samples == samples


def test_a_band_of_noise_leaves_p_semidefinite() -> None:
    """P(0|0)/q = 1e12 over 200 000 samples; without what `blurred` in covariance.c does, S is negative by 9000."""
    case = study.kalman_case("KF-ANC", kf_anc, 1e12)
    outcome = study.soak(case, "narrow band", 200_000)
    assert outcome.violations == []
    assert outcome.least_eigenvalue >= study.LEAST_EIGENVALUE
    assert outcome.noise_reduction_db > 43.0


class Breaking(FxLMS):
    """FxLMS to whose properties something happens at a sample."""

    def __init__(self, at: int, what: str) -> None:
        super().__init__(4, study.SECONDARY, step_size=1e-3)
        self.at, self.what, self.done = at, what, 0

    def control_signal(self, reference: float) -> float:
        self.done += 1
        louder = 1e3 * reference if self.broken and self.what == "loud" else 0.0
        return super().control_signal(reference) + louder

    @property
    def broken(self) -> bool:
        return self.done >= self.at

    @property
    def covariance(self) -> np.ndarray:
        P = np.eye(4)
        if self.broken:
            P[0, 1] = {"asymmetric": 1e-9, "indefinite": 1.1, "not finite": np.nan}.get(self.what, 0.0)
            P[1, 0] = P[0, 1] if self.what != "asymmetric" else 0.0
        return P

    @property
    def weights(self) -> np.ndarray:
        return np.full(4, np.nan) if self.broken and self.what == "weights" else super().weights

    def update(self, error: float) -> None:
        if self.broken and self.what == "refused":
            raise ValueError("the update has no solution: because")
        super().update(error)


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("asymmetric", "P is not symmetric"),
        ("indefinite", "the smallest eigenvalue of P is -0.048 of the largest"),
        ("not finite", "P is not finite"),
        ("weights", "the weights are not finite"),
        ("loud", "the noise is louder than without control"),
        ("refused", "refused in sample"),
    ],
)
def test_what_goes_wrong_is_noticed_and_dated(what: str, message: str) -> None:
    """At sample 450 of 1000, with a check every 50: the one at 450, and for a refusal the last good one."""
    outcome = study.soak(study.Case("breaking", lambda: Breaking(450, what)), "white", 1000)
    (sample, fault), *_ = outcome.violations
    assert sample == {"refused": 400, "loud": 500}.get(what, 450)
    assert fault.startswith(message)


def test_a_process_that_grows_is_noticed() -> None:
    grown = iter(100.0 + 3.0 * np.arange(study.CHECKS))
    with smaller(study, process_mb=lambda: next(grown)):
        outcome = study.soak(study.Case("FxLMS", lambda: Breaking(10**9, "")), "white", 2000)
    assert outcome.violations == [(800, "the process has grown by 18 MB")]  # from the second check to the eighth


def test_a_limiter_that_does_not_hold_is_noticed() -> None:
    """The limiter's own power against a rating that is a tenth lower than the one it keeps."""
    x = np.sqrt(2.0) * np.sin(0.1 * np.arange(4000))
    limiter = OutputLimiter(0.5, fs=study.FS)
    controller = kf_anc(4, [1.0], state_noise=0.0, measurement_noise=1e-4, limiter=limiter)
    result = simulate(controller, x, disturbance=2.0 * x, secondary_path=[1.0])
    case = study.Case("limited", lambda: controller)
    assert study.signal_faults(case, controller, result, "tone", starting=False) == []
    result = replace(result, control_signal=np.sqrt(1.1) * result.control_signal)
    (fault,) = study.signal_faults(case, controller, result, "tone", starting=False)
    assert fault.startswith("a window has 1.1")


def test_the_intervals_are_one_run() -> None:
    """Anti-noise that is under way between two intervals is not lost. A tone, without the noise drawn for each interval."""
    errors = {}
    for checks in (1, 20):
        controller = FxLMS(8, study.SECONDARY, step_size=1e-3)
        with smaller(study, SENSOR_NOISE=0.0, CHECKS=checks):
            runs = study.intervals("tone", 4000, study.SECONDARY)
            errors[checks] = np.concatenate([run(controller).error for run in runs])
    np.testing.assert_allclose(errors[20], errors[1], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("signal", "power"), [("white", 1.0), ("narrow band", 1.0), ("tone", 1.0), ("alternating", 0.75)]
)
def test_the_noises_go_on_and_have_power_one_where_they_are_not_silent(signal: str, power: float) -> None:
    whole = study.SOURCES[signal](np.random.default_rng(3))(8 * study.TURN)
    take = study.SOURCES[signal](np.random.default_rng(3))
    parts = np.concatenate([take(size) for size in (1, study.TURN - 1, 7 * study.TURN)])
    np.testing.assert_allclose(parts, whole, atol=1e-9)
    assert np.mean(whole**2) == pytest.approx(power, rel=0.1)


def test_the_command_prints_and_writes(tmp_path: Any, capsys: pytest.CaptureFixture) -> None:
    arguments = ["soak", "--quiet", "--samples", "4e3", "--only", "FxLMS", "--output", str(tmp_path / "new")]
    assert main(arguments) == 0
    written = json.loads((tmp_path / "new" / "soak.json").read_text())
    assert [one["signal"] for one in written] == list(study.SOURCES)
    assert all(one["samples"] == 4000 and one["violations"] == [] for one in written)
    printed = capsys.readouterr().out
    assert "0 of 5 runs violated a promise" in printed
    row = next(line for line in printed.splitlines() if line.startswith("FxLMS"))
    assert f"{written[0]['noise_reduction_db']:.1f}" in row


def test_a_violation_fails_the_command_and_an_interruption_keeps_what_is_done(tmp_path: Any, capsys: Any) -> None:
    def interrupted() -> Any:
        raise KeyboardInterrupt

    breaking = study.Case("breaking", lambda: Breaking(1050, "indefinite"), signals=("white", "tone"))
    arguments = ["soak", "--quiet", "--samples", "2000", "--output", str(tmp_path)]
    with smaller(study, all_cases=lambda: [breaking]):
        assert main(arguments) == 1
    printed = capsys.readouterr().out
    assert "VIOLATION: breaking, white, by sample 1,100: the smallest eigenvalue" in printed
    assert "2 of 2 runs violated a promise" in printed
    good = replace(breaking, make=lambda: Breaking(10**9, ""))
    with smaller(study, all_cases=lambda: [good, study.Case("interrupted", interrupted)]):
        assert main(arguments) == study.INTERRUPTED
    assert "interrupted after 2 of 7 runs" in capsys.readouterr().out
    assert len(json.loads((tmp_path / "soak.json").read_text())) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["soak", "--samples", "100"], "--samples must be 2000 at least, got 100"),
        (["soak", "--samples", "nan"], "--samples must be 2000 at least, got nan"),
        (["soak", "--only", "nothing"], "no controller fits nothing; there are KF-ANC"),
        (["tonal", "soak"], "soak runs alone, and is named first"),
    ],
)
def test_bad_arguments_are_refused(
    arguments: list[str], message: str, inside: Path, capsys: pytest.CaptureFixture
) -> None:
    with pytest.raises(SystemExit):
        main(arguments)
    assert message in " ".join(capsys.readouterr().err.split())
    assert list(inside.iterdir()) == []


def test_the_documentation_shows_the_cases_of_today() -> None:
    """docs/soak.txt is a whole run of the command, without a violation."""
    printed = (ROOT / "docs" / "soak.txt").read_text(encoding="utf-8")
    rows = [line.split("  ")[0] for line in printed.split("\n\n")[0].splitlines()[1:]]
    cases = study.all_cases()
    assert rows == [case.name for case in cases]
    runs = sum(len(case.signals) for case in cases)
    assert f"{runs} runs of {study.SAMPLES:,} samples" in printed
    assert f"0 of {runs} runs violated a promise" in printed
    assert "{literalinclude} soak.txt" in (ROOT / "docs" / "soak.md").read_text(encoding="utf-8")
