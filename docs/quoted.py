"""Every number that the documentation quotes from the studies, with its page and the command that prints it.

``python docs/quoted.py studies`` compares the pages with the results in that folder, fresh from ``python -m comparisons``,
and fails if a page says something else. It skips studies that are not in the folder, and names them.

A `Quote` is a sentence of a page with a format field for each number, and a function that computes the numbers from the
results. Numbers in examples and tutorials need no list, because they are executed. Nor do the times in speed.txt: they are
the output of ``python -m comparisons speed`` and depend on the machine.
"""

from __future__ import annotations

import csv
import json
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parent
LONG_S = 60.0  # runs of the constraint study; only the long ones last several averaging times
STUDIES, CONSTRAINT = "python -m comparisons", "python -m comparisons constraint"
FIELD = re.compile(r"\{:\.(\d)f\}")


@dataclass(frozen=True)
class Results:
    """Results of studies in a folder."""

    folder: Path

    @cached_property
    def studies(self) -> dict[str, Any]:
        """Content of results.json by study."""
        return json.loads((self.folder / "results.json").read_text(encoding="utf-8"))["studies"]

    def merit(self, study: str, algorithm: str, figure: str = "noise_reduction_db") -> float:
        """Figure of merit of an algorithm."""
        return self.studies[study]["algorithms"][algorithm][figure]

    def rated(self, study: str, algorithm: str) -> float:
        """Output power over the rated power."""
        return self.merit(study, algorithm, "output_power") / self.studies[study]["rated_power"]

    def extra(self, study: str, *keys: str) -> Any:
        """What a study found in addition to the figures of merit."""
        value = self.studies[study]["extra"]
        for key in keys:
            value = value[key]
        return value

    def said(self, study: str, words: str) -> list[float]:
        """Numbers in what was measured for the claim that begins with these words."""
        claim = next(claim for claim in self.studies[study]["claims"] if claim["text"].startswith(words))
        return [float(number) for number in re.findall(r"[-+]?\d+(?:\.\d+)?", claim["measured"])]

    def reproduced(self) -> tuple[int, int]:
        """How many claims of the paper's studies were reproduced, and how many there are."""
        held = [claim["holds"] for study in PAPER for claim in self.studies[study]["claims"]]
        return sum(held), len(held)

    def rows(self, algorithm: str, stationary: bool, duration_s: float = LONG_S) -> list[dict[str, Any]]:
        """Runs of an algorithm in the constraint study, on stationary or on varying noise."""
        steady = ("tone", "compressor", "band noise")
        rows = [r for r in self.extra("constraint", "rows") if r["duration_s"] == duration_s]
        return [r for r in rows if r["algorithm"] == algorithm and (r["noise"] in steady) == stationary]

    def summary(self, algorithm: str) -> list[float]:
        """A line of the constraint study's summary."""
        line: list[float] = []
        for stationary in (True, False):
            rows = self.rows(algorithm, stationary)
            powers, losses = [r["power"] for r in rows], [r["bound_db"] - r["noise_reduction_db"] for r in rows]
            line += [min(powers), max(powers), sum(losses) / len(losses), max(losses)]
        both = self.rows(algorithm, True) + self.rows(algorithm, False)
        return [*line, max(r["worst_window"] for r in both)]

    def clipped_power(self) -> list[float]:
        """KF-ANC's output power if the amplifier clips, unknown and known: measured duct, band noise."""
        path = self.folder / "tables" / "constraint-amplifier.csv"
        with path.open(encoding="utf-8", newline="") as file:
            rows = {row["amplifier or path"]: row for row in csv.DictReader(file) if _is(row, "KF-ANC")}
        return [float(rows[known]["power"]) for known in ("unknown", "known")]


PAPER = ("tonal", "broadband", "duct", "duct-measured")


def _is(row: dict[str, str], algorithm: str) -> bool:
    return (row["paths"], row["noise"], row["algorithm"]) == ("measured duct", "band noise", algorithm)


@dataclass(frozen=True)
class Quote:
    """Words of a page, a format field for each number, and the numbers in fresh results."""

    page: str
    words: str
    studies: tuple[str, ...]
    numbers: Callable[[Results], Sequence[float]]
    command: str = STUDIES

    def found(self) -> list[str] | None:
        """Numbers on the page, or None if the words are not on it."""
        pattern = ""
        for k, piece in enumerate(re.split(r"(\{:\.\df\})", " ".join(self.words.split()))):
            field = FIELD.fullmatch(piece) if k % 2 else None
            digits = int(field[1]) if field else 0
            pattern += r"([-+]?\d+" + (rf"\.\d{{{digits}}}" if digits else "") + ")" if field else re.escape(piece)
        match = re.search(pattern, plain(self.page))
        return list(match.groups()) if match else None

    def wrong(self, results: Results) -> list[str]:
        """Numbers that differ from the results by more than the rounding of the last digit plus 1 % for another machine."""
        quoted, fresh = self.found(), list(self.numbers(results))
        if quoted is None:
            return [f"{self.page} does not say: {self.words}"]
        assert len(quoted) == len(fresh), self.words
        return [
            f"{self.page} says {said}, the results {value:.6g}: {self.words}"
            for said, value in zip(quoted, fresh, strict=True)
            if not abs(float(said) - value) <= 0.51 * 10.0 ** -len(said.partition(".")[2]) + 0.01 * abs(value)
        ]


def plain(page: str) -> str:
    """Text of a page in one line with single spaces."""
    return " ".join((DOCS / page).read_text(encoding="utf-8").split())


def _tonal() -> Iterator[Quote]:
    def quote(words: str, numbers: Callable[[Results], Sequence[float]]) -> Quote:
        return Quote("limits.md", words, ("tonal",), numbers)

    yield quote(
        "leads KF-ANC between {:.1f} and {:.1f} dB of overdrive",
        lambda r: r.extra("tonal", "ordering_flips_at_overdrive_db"),
    )
    yield quote(
        "At 3 dB of overdrive FxLMS reaches {:.1f} dB and KF-OPC {:.1f} dB",
        lambda r: [r.merit("tonal", "FxLMS"), r.merit("tonal", "KF-OPC")],
    )
    yield quote(
        "After 10 s the largest one is {:.0f} times the optimal weight",
        lambda r: [r.extra("tonal", "largest_weight_over_optimal")],
    )
    most = ("largest_weight_over_optimal", "peak_control_signal", "output_power")
    yield quote(
        "With the largest state noise of the grid it is {:.0f} times the optimal weight, the control signal goes up to {:.0f}, and the output "
        "power is {:.0f} times the rated power",
        lambda r: [r.extra("tonal", "with_most_state_noise", "KF-ANC", key) for key in most],
    )
    yield quote(
        "With a hundredth of the least state noise the largest weight still grows {:.2f} times over the second half",
        lambda r: [r.extra("tonal", "with_less_state_noise", "KF-ANC at 1e-10", "weight_growth")],
    )


def _broadband() -> Iterator[Quote]:
    def span(r: Results, name: str, key: str) -> list[float]:
        """The least and the largest of all seeds."""
        seeds = r.extra("broadband", "with_clipping_amplifier", name, key)
        return [min(seeds), max(seeds)]

    def settled(r: Results, name: str, key: str = "weight_error_below_20_db_after_s") -> float:
        return 1e3 * r.extra("broadband", key, name)

    first, peak = "first_second_noise_reduction_db", "peak_control_signal_of_the_whole_run"
    opc, unaware, known = "KF-OPC", "KF-OPC, q without the clipping", "KF-OPC, known amplifier"
    yield Quote(
        "limits.md",
        "q is then {:.3f}, and the start is as good as the rest: over eight seeds the first second is reduced by {:.1f} to "
        "{:.1f} dB, the steady half by {:.1f} dB, and the control signal goes up to {:.1f} to {:.1f}",
        ("broadband",),
        lambda r: [
            r.studies["broadband"]["parameters"]["measurement_noise_q with clipping"],
            *span(r, opc, first),
            r.extra("broadband", "with_clipping_amplifier", opc, "noise_reduction_db"),
            *span(r, opc, peak),
        ],
    )
    yield Quote(
        "limits.md",
        "without clipping, {:.7f}, the filter trusts its first samples too much: the first second is reduced by {:.1f} to "
        "{:.1f} dB, and the control signal goes up to {:.1f} in the best seed and to {:.0f} in the worst",
        ("broadband",),
        lambda r: [
            r.studies["broadband"]["parameters"]["measurement_noise_q"],
            *span(r, unaware, first),
            *span(r, unaware, peak),
        ],
    )
    yield Quote(
        "limits.md",
        "knows the amplifier: the first second is then reduced by {:.1f} to {:.1f} dB",
        ("broadband",),
        lambda r: span(r, known, first),
    )
    yield Quote(
        "limits.md",
        "own solution after {:.1f} ms in KF-OPC and after {:.1f} ms in KF-ANC. MOV-FxLMS first gets there after {:.1f} ms",
        ("broadband",),
        lambda r: [
            settled(r, "KF-OPC"),
            settled(r, "KF-ANC"),
            settled(r, "MOV-FxLMS", "weight_error_first_below_20_db_after_s"),
        ],
    )
    yield Quote(
        "limits.md",
        "KF-OPC at {:.1f} dB of reduction after {:.1f} ms, KF-ANC at {:.1f} dB after {:.1f} ms",
        ("broadband",),
        lambda r: [
            number
            for name in ("KF-OPC", "KF-ANC")
            for number in (r.merit("broadband", name), 1e3 * r.merit("broadband", name, "convergence_time_s"))
        ],
    )
    yield Quote(
        "limits.md",
        "{:.1f} ms with 128 taps, {:.1f} ms with 256",
        ("broadband",),
        lambda r: [
            1e3 * r.merit("broadband", "KF-OPC", "convergence_time_s"),
            1e3 * r.extra("broadband", "convergence_time_s_at_256_taps", "KF-OPC"),
        ],
    )


DUCTS = {  # study, and what the pages call its duct and noise
    "duct": "modelled duct, synthetic compressor",
    "duct-measured": "measured duct, recorded compressor",
    "duct-motor": "measured duct, recorded motor",
}


def _duct() -> Iterator[Quote]:
    def quote(words: str, studies: tuple[str, ...], numbers: Callable[[Results], Sequence[float]]) -> Quote:
        command = "python -m comparisons duct-motor" if "duct-motor" in studies else STUDIES
        return Quote("limits.md", words, studies, numbers, command)

    def of(
        results: Results, study: str, *names: str, algorithms: Sequence[str] = ("KF-OPC", "MOV-FxLMS")
    ) -> list[float]:
        return [results.extra(study, "figures", algorithm, name) for name in names for algorithm in algorithms]

    def gains(results: Results, study: str) -> list[float]:
        return [
            results.extra(study, key) for key in ("gain_of_the_reference_eq_11", "gain_of_the_wiener_control_signal")
        ]

    def start(results: Results, *keys: str) -> list[float]:
        return [results.extra(study, "start_under_constraint", *keys) for study in ("duct", "duct-measured")]

    for study, words in DUCTS.items():
        yield quote(
            f"| {words} | {{:.2f}} | {{:.2f}} | {{:.1f}} |",
            (study,),
            lambda r, study=study: of(r, study, "power", "worst_second", "worst_50_ms", algorithms=["KF-OPC"]),
        )
    yield quote(
        "In the modelled duct the reference sees a gain of {:.2f} and the control signal one of {:.2f}",
        ("duct",),
        lambda r: gains(r, "duct"),
    )
    yield quote(
        "the compressor sees a gain of {:.3f} and the control signal one of {:.3f}",
        ("duct-measured",),
        lambda r: gains(r, "duct-measured"),
    )
    yield quote("With the motor these gains are {:.3f} and {:.3f}", ("duct-motor",), lambda r: gains(r, "duct-motor"))
    kalman = ("KF-OPC", "KF-PB")
    yield quote(
        "An output power of {:.1f} times the rated power means that the constraint fails. KF-PB keeps {:.2f} of",
        ("duct-measured",),
        lambda r: of(r, "duct-measured", "power", algorithms=kalman),
    )
    yield quote(
        "KF-OPC reduces the noise by {:.1f} dB and KF-PB by {:.1f} dB; with one of 10 %, by {:.1f} dB and {:.1f} dB",
        ("duct-measured",),
        lambda r: [
            r.extra("duct-measured", key, algorithm, "noise_reduction_db")
            for key in ("figures", "figures_at_the_smaller_rated_power")
            for algorithm in kalman
        ],
    )
    for study in ("duct-measured", "duct-motor"):
        words = DUCTS[study].removeprefix("measured duct, ")
        yield quote(
            f"| {words} | {{:.2f}}, {{:.2f}} dB | {{:.2f}}, {{:.2f}} dB | {{:.2f}}, {{:.2f}} |",
            (study,),
            lambda r, study=study: of(r, study, "mean_nse_db", "noise_reduction_db", "power"),
        )
    yield quote(
        "power a fixed filter reaches {:.2f} dB on the compressor and {:.2f} dB on the motor",
        ("duct-measured", "duct-motor"),
        lambda r: [
            r.extra(study, "best_noise_reduction_within_the_power_db") for study in ("duct-measured", "duct-motor")
        ],
    )
    yield quote(
        "with the compressor it reaches {:.2f} dB at {:.2f} of the rated power",
        ("duct-measured",),
        lambda r: of(r, "duct-measured", "noise_reduction_db", "power", algorithms=["MOV-FxLMS by variance"]),
    )
    yield quote(
        "{:.0f} against {:.0f} ms in the modelled duct, {:.0f} against {:.0f} ms in the measured one",
        ("duct", "duct-measured"),
        lambda r: [
            1e3 * time
            for pair in zip(start(r, "equal_time_s"), start(r, "mov_equal_time_s"), strict=True)
            for time in pair
        ],
    )
    yield quote(
        "starts the control at {:.0f} s",
        ("duct-motor",),
        lambda r: [r.extra("duct-motor", "start_under_constraint", "at_s")],
    )
    yield quote(
        "at equal power KF-OPC takes {:.0f} ms and MOV-FxLMS {:.0f} ms",
        ("duct-motor",),
        lambda r: [
            1e3 * r.extra("duct-motor", "start_under_constraint", key) for key in ("equal_time_s", "mov_equal_time_s")
        ],
    )
    yield quote(
        "it then reduces the noise by {:.2f} and {:.2f} dB, MOV-FxLMS by {:.2f} and {:.2f} dB",
        ("duct", "duct-measured"),
        lambda r: start(r, "equal_power_db") + start(r, "noise_reduction_db", "MOV-FxLMS"),
    )
    yield quote(
        "MOV-FxLMS at {:.2f} and {:.2f} of the rated power",
        ("duct", "duct-measured"),
        lambda r: [r.rated("duct", "MOV-FxLMS"), r.rated("duct-measured", "MOV-FxLMS")],
    )
    yield quote("{:.0f} of the {:.0f} claims", PAPER, lambda r: r.reproduced())


def _constraint() -> Iterator[Quote]:
    def quote(words: str, numbers: Callable[[Results], Sequence[float]], page: str = "constraint.md") -> Quote:
        return Quote(page, words, ("constraint",), numbers, CONSTRAINT)

    for name in ("KF-OPC", "KF-PB"):
        line = "{:.2f}-{:.2f} | {:.2f} ({:.2f}) dB | {:.2f}-{:.2f} | {:.2f} ({:.2f}) dB | {:.1f} |"
        yield quote(f"| {name} | {line}", lambda r, name=name: r.summary(name))
    yield quote(
        "its output power is {:.0f} times the rated power if the amplifier is unknown, and {:.1f} times if it is known",
        Results.clipped_power,
    )


def _power_range() -> Iterator[Quote]:
    """What the README, the front page and the limitations begin with."""
    words = "KF-OPC's output power was {:.2f} to {:.2f} times the rated power"
    for page in ("../README.md", "index.md", "limits.md"):
        yield Quote(page, words, ("constraint",), _least_and_most_power, CONSTRAINT)


def _least_and_most_power(results: Results) -> list[float]:
    """Output power over the rated power of KF-OPC, over all runs of a minute."""
    powers = [row["power"] for stationary in (True, False) for row in results.rows("KF-OPC", stationary)]
    return [min(powers), max(powers)]


CASES = (("duct", "band noise"), ("duct", "compressor"), ("measured duct", "compressor"), ("measured duct", "motor"))
TABLED = (
    "bound",
    "bound of the record",
    "scaled Wiener",
    "KF-PB",
    "KF-OPC",
    "diagonal KF-OPC",
    "leaky FxLMS",
    "optimal leaky FxLMS",
    "MOV-FxLMS fixed",
    "MOV-FxLMS by variance",
    "MOV-FxLMS",
    "MOV-MFxLMS",
    "two-gradient FxLMS",
    "re-scaling FxLMS",
    "clipping FxLMS",
    "power-limited FxLMS",
)
TABLED_DB = -6.0


def _algorithms() -> Iterator[Quote]:
    def quote(words: str, numbers: Callable[[Results], Sequence[float]]) -> Quote:
        return Quote("algorithms.md", words, ("rated-powers",), numbers, "python -m comparisons rated_powers")

    line = "| {} |" + 4 * " {{:.1f}} dB, {{:.2f}} |"
    for name in TABLED:
        yield quote(line.format(name), lambda r, name=name: _budget_line(r, name))
    yield quote(
        "the diagonal alone reaches {:.1f}, {:.1f}, {:.1f} and {:.1f} dB without a constraint, the full filter {:.1f}, "
        "{:.1f}, {:.1f} and {:.1f} dB",
        lambda r: [_budget_line(r, name)[2 * k] for name in ("diagonal KF", "KF-ANC") for k in range(4)],
    )


def _budget_line(results: Results, algorithm: str) -> list[float]:
    """Noise reduction and output power over the rated power in each case, means over seeds."""
    rows = results.extra("rated-powers", "rows")
    numbers = []
    for path, noise in CASES:
        own = [
            row
            for row in rows
            if (row["path"], row["noise"]) == (path, noise)
            and (row["algorithm"], row["share_db"]) == (algorithm, TABLED_DB)
        ]
        numbers += [sum(row[figure] for row in own) / len(own) for figure in ("noise_reduction_db", "power")]
    return numbers


def _further() -> Iterator[Quote]:
    """Numbers from the claims of the studies of wrong estimates, tracking and amplifiers."""

    def quote(study: str, words: str, claim: str, *which: int) -> Quote:
        def numbers(results: Results) -> list[float]:
            said = results.said(study, claim)
            return [abs(said[k]) for k in which]

        return Quote("studies.md", words, (study,), numbers, f"python -m comparisons {study.replace('-', '_')}")

    yield quote(
        "mismatch",
        "costs KF-ANC {:.1f} dB without tuning again; FxLMS diverges, MOV-FxLMS loses {:.1f} dB",
        "A gain up to",
        *(0, 2),
    )
    yield quote(
        "mismatch",
        "With a wrong gain KF-OPC spends {:.2f} to {:.2f} of its rated power",
        "With a wrong gain KF-PB",
        *(0, 1),
    )
    yield quote("tracking", "by {:.1f} dB on average. Just after", "The mean NSE over the whole run", 0)
    yield Quote(
        "studies.md",
        "by {:.1f} dB on the built-in duct if its sign changes (KF-OPC: {:.1f} dB), and by {:.1f} dB on the measured one ({:.1f} dB)",
        ("tracking",),
        lambda r: [_tracked(r, "sign", path, name) for path in DUCT_PAIR for name in ("KF-PB", "KF-OPC")],
        "python -m comparisons tracking",
    )
    yield Quote(
        "studies.md",
        "makes this noise up to {:.1f} dB louder, while KF-OPC reduces it by {:.1f} to {:.1f} dB. If the sweep recurs, KF-PB reduces "
        "it by {:.1f} and {:.1f} dB",
        ("tracking",),
        lambda r: [
            max(-_tracked(r, "one sweep", path, "KF-PB") for path in DUCT_PAIR),
            *sorted(_tracked(r, "one sweep", path, "KF-OPC") for path in DUCT_PAIR),
            *(_tracked(r, "sweeps", path, "KF-PB") for path in DUCT_PAIR),
        ],
        "python -m comparisons tracking",
    )
    claim = "With its default uncertainty"
    yield quote(
        "uncertain-path", "in any of {:.0f} runs; the least noise reduction of a second is {:.1f} dB", claim, 1, 2
    )
    yield quote(
        "uncertain-path", "a second is louder in {:.0f} of {:.0f} runs, by {:.1f} dB at most", claim, -3, -2, -1
    )
    claim = "With an exact path the default uncertainty costs at most 0.5 dB, noises"
    yield quote("uncertain-path", "costs {:.2f} dB on average and {:.2f} dB at most", claim, 0, 1)
    claim = "On steady noise KF-PB reaches"
    yield quote(
        "multichannel", "KF-PB is {:.2f} dB below the bound on average. The worst case is {:.2f} dB", claim, 0, 1
    )
    yield quote("multichannel", "takes more than {:.3f} times its rating", "Steady noise: every loudspeaker", 2)
    yield quote("multichannel", "the best of them is {:.2f} dB behind on average", "No method of another kind", 0)
    yield quote("amplifier", "its reduction is at best {:.1f} dB larger", "KF-OPC reduces the noise more", 0)
    yield quote("amplifier", "it is {:.1f} dB smaller", "KF-OPC reduces the noise more", 1)
    yield quote(
        "amplifier",
        "KF-OPC keeps {:.2f} to {:.2f} of its rated power",
        "KF-OPC and KF-PB keep",
        0,
        1,
    )


PRIMARY = ("primary path, polarity", "primary path, five samples late")


def _kf_pb() -> Iterator[Quote]:
    """The tables of the page on KF-PB."""

    def quote(study: str, words: str, numbers: Callable[[Results], Sequence[float]]) -> Quote:
        return Quote("kf_pb.md", words, (study,), numbers, f"python -m comparisons {study.replace('-', '_')}")

    for kind in ("steady and recorded", "jumps, bursts, mixes"):
        yield quote(
            "kf-pb",
            f"| {kind} | {{:.0f}} | {{:.3f}} at most | {{:.2f}}, {{:.2f}} dB | {{:.0f}} % | {{:.2f}}, {{:.2f}} dB; {{:.0f}} % below "
            "-0.5 dB | {:.1f} dB |",
            lambda r, kind=kind: _class_line(r, kind),
        )
    for fault in (
        "two samples late",
        "two samples early",
        "3 dB louder",
        "3 dB softer",
        "polarity",
        "another phase",
        *PRIMARY,
    ):
        for begins, words in (
            (("start", "the start"), ("jump", "a jump")) if "primary" not in fault else (("jump", "a jump"),)
        ):
            yield quote(
                "kf-pb",
                f"| {fault} | {words} | {{:.1f}} dB | {{:.2f}}, {{:.2f}} dB | {{:.0f}} to {{:.0f}} |",
                lambda r, fault=fault, begins=begins: _fault_line(r, fault, begins),
            )
    for begins, words in (
        ("jump", "than {:.1f} dB louder than without control"),
        ("start", "made the first second up to {:.1f} dB louder"),
    ):
        yield quote(
            "kf-pb",
            words,
            lambda r, begins=begins: [
                -min(row["worst_second_db"] for row in r.extra("kf-pb", "faults") if row["begins"] == begins)
            ],
        )
    for path in ("band-pass", "duct", "measured duct", "measured room"):
        yield quote("loss-map", f"| {path} |" + 7 * " {:.1f} |", lambda r, path=path: _losses(r, path))


def _class_line(results: Results, kind: str) -> list[float]:
    rows = [row for row in results.extra("kf-pb", "rows") if row["kind"] == kind]
    bound, mov = ([row["noise_reduction_db"] - row[of] for row in rows] for of in ("bound_db", "mov_db"))
    shares = [100.0 * sum(test) / len(rows) for test in ([b >= -1.0 for b in bound], [m < -0.5 for m in mov])]
    means = [sum(values) / len(rows) for values in (bound, mov, [row["first_second_db"] for row in rows])]
    most = max(row["power"] for row in rows)
    return [len(rows), most, means[0], min(bound), shares[0], means[1], min(mov), shares[1], means[2]]


def _fault_line(results: Results, fault: str, begins: str) -> list[float]:
    rows = [row for row in results.extra("kf-pb", "faults") if (row["fault"], row["begins"]) == (fault, begins)]
    lost, alarms = [row["lost_db"] for row in rows], [row["alarms"] for row in rows]
    worst = min(row["worst_second_db"] for row in rows)
    return [worst, sum(lost) / len(rows), max(lost), min(alarms), max(alarms)]


def _losses(results: Results, path: str) -> list[float]:
    """What each stage loses, from 40 dB down, and what is left, on average over the noises."""
    rows = [[40.0, *row["reduction_db"]] for row in results.extra("loss-map", "rows") if row["path"] == path]
    mean = [sum(stage) / len(rows) for stage in zip(*rows, strict=True)]
    return [*(before - after for before, after in pairwise(mean)), mean[-1]]


DUCT_PAIR = ("duct", "measured duct")


def _tracked(results: Results, event: str, path: str, algorithm: str) -> float:
    """Return the noise reduction over the whole run in the study of tracking."""
    rows = results.extra("tracking", "rows")
    return next(
        row["noise_reduction_db"]
        for row in rows
        if (row["event"], row["path"], row["algorithm"]) == (event, path, algorithm)
    )


QUOTES: tuple[Quote, ...] = (
    *_tonal(),
    *_broadband(),
    *_duct(),
    *_constraint(),
    *_power_range(),
    *_algorithms(),
    *_further(),
    *_kf_pb(),
)


def table() -> str:
    """All quotes as a Markdown table, with the command that prints each."""
    lines = ["| page | says | printed by |", "|---|---|---|"]
    for quote in QUOTES:
        said = " ".join(quote.words.split())
        for number in quote.found() or ():
            said = FIELD.sub(number, said, count=1)
        lines.append(f"| {quote.page} | {said.strip('| ').replace(' | ', '; ')} | `{quote.command}` |")
    return "\n".join(lines)


def check(folder: Path) -> tuple[list[str], int, set[str]]:
    """Disagreements with the results in a folder, how many quotes were compared, and which studies are missing."""
    results, wrong, held, lacking = Results(folder), [], 0, set()
    for quote in QUOTES:
        missing = set(quote.studies) - set(results.studies)
        if missing:
            lacking |= missing
            continue
        wrong += quote.wrong(results)
        held += 1
    return wrong, held, lacking


if __name__ == "__main__":
    problems, held, lacking = check(Path(sys.argv[1] if len(sys.argv) > 1 else "studies"))
    print(
        *problems,
        f"{held} of {len(QUOTES)} quotes compared with fresh results, {len(problems)} numbers wrong",
        sep="\n",
    )
    if lacking:
        print(f"not in the folder and not checked: {', '.join(sorted(lacking))}")
    sys.exit(1 if problems or not held else 0)
