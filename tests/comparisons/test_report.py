"""The report: strict JSON, a page that needs no other file, sounds of one scale, tables, refusals."""

import csv
import html
import json
import re
from pathlib import Path

import numpy as np
import pytest
from helpers.reports import FS, figure, study

from comparisons.bench.registry import ABOUT, REGISTRY
from comparisons.bench.report import results_table, write_report
from comparisons.bench.study_report import Claim, FigureItem, Table
from comparisons.studies.rows import worst_claim
from kfopc_filterpy.signals import read_recording


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report") / "new" / "folder"
    page = write_report([study(), study("duct-measured", figures=[], sounds=[], notes=[], extra={})], folder)
    assert page == folder / "report.html"
    return folder


def test_results_are_strict_json_of_the_agreed_layout(written):
    def refuse(constant):
        raise AssertionError(constant)

    results = json.loads((written / "results.json").read_text(encoding="utf-8"), parse_constant=refuse)
    assert list(results) == ["studies"]
    assert list(results["studies"]) == ["tonal", "duct-measured"]
    study = results["studies"]["tonal"]
    assert set(study) == {"rated_power", "parameters", "algorithms", "claims", "extra"}
    assert study["rated_power"] == 0.8
    assert study["parameters"] == {"q": 1e-4, "seeds": [0, 1, 2], "tried": [[1e-7, None], [1e-6, "diverged"]]}
    merits = study["algorithms"]["KF-ANC"]
    assert {name: value for name, value in merits.items() if value is not None} == {
        "noise_reduction_db": 8.125,
        "diverged_at_s": 1.5,
    }
    assert len(merits) == 7
    claim = {"text": "It is faster (s)", "value": 2.0, "at_least": 3.0, "at_most": None, "note": "a <note>"}
    assert study["claims"][1] == claim | {"holds": False}
    assert study["extra"] == {"sweep": {"over_db": [0, 1], "best": [1.0, None]}, "flip": 4.5}


def test_page_needs_no_other_file(written):
    source = (written / "report.html").read_text(encoding="utf-8")
    ids = re.findall(r' id="([^"]*)"', source)
    references = re.findall(r'<(\w+)[^>]* (?:src|href|srcset|data|action|poster)="([^"]*)"', source)
    links = [reference for tag, reference in references if tag == "a" and not reference.startswith("#")]
    data = [reference for tag, reference in references if tag != "a"]
    assert {reference[1:] for _, reference in references if reference.startswith("#")} <= set(ids)
    assert len(ids) == len(set(ids))
    assert links == ["audio/tonal-disturbance.wav", "audio/tonal-kf-anc.wav"]  # in full length, beside the page
    assert all((written / link).is_file() for link in links)
    assert len(data) == 3
    assert all(re.match(r"data:(image/png|audio/flac);base64,[A-Za-z0-9+/=]+$", own) for own in data)
    assert not re.search(r"<(link|iframe|object)\b", source)
    assert not re.search(r"https?:|@import|url\(|fetch\(|import\(|XMLHttpRequest|<script src", source)
    assert "default-src 'none'" in source  # and the browser holds it to that


def test_page_says_everything_and_escapes_it(written):
    source = (written / "report.html").read_text(encoding="utf-8")
    assert not re.search(r"<(hard|of|note)>", source)
    text = html.unescape(re.sub(r"<[^>]*>", "", source))
    for said in (
        "Tone & clip <hard>",
        "A tone <of> 2.",
        "2 of 4 claims hold",
        "✓ holds",
        "✗ fails",
        "It is faster (s) (a <note>)",
        "estimate <of> eq. 7",
        "1e-07, –",
        'Spectra "of" e & d.',
        "Residual, full length (silent after the divergence)",
        "One <note>.",
    ):
        assert said in text, said


def test_figures_and_sounds_are_files_too(written):
    assert {path.name for path in (written / "figures").iterdir()} == {
        f"tonal-a-spectra.{kind}" for kind in ("png", "svg")
    }
    disturbance = read_recording(written / "audio" / "tonal-disturbance.wav")
    loud, soft = disturbance.samples, read_recording(written / "audio" / "tonal-kf-anc.wav").samples
    assert disturbance.fs == FS
    assert np.max(np.abs(loud)) == pytest.approx(1.0, abs=1e-3)
    np.testing.assert_allclose(soft[:-1], loud[:-1] / 2, atol=1e-4)  # one scale
    assert soft[-1] == 0
    assert not list(written.glob(".*"))


def test_same_studies_same_bytes(tmp_path):
    pages = [write_report([study()], tmp_path / name).read_bytes() for name in ("one", "two")]
    assert pages[0] == pages[1]


POWERS = Table(
    "powers",
    "Powers < 1 & more",
    ["paths", "noise, of <kind>", "power"],
    [["duct", 'tone "300"', 0.123456789], ["band-pass", "diverged", np.float64(1e6)], ["duct", 7.0, 3]],
)
EMPTY = Table("none", "Nothing to show", ["paths", "power"], [])


def test_a_table_as_a_file_has_all_digits(tmp_path):
    write_report([study(tables=[POWERS, EMPTY]), study("duct")], tmp_path)
    assert sorted(path.name for path in (tmp_path / "tables").iterdir()) == [
        f"{name}-{stem}.csv"
        for name, stems in (("duct", ("claims", "merit")), ("tonal", ("claims", "merit", "powers")))
        for stem in stems
    ]
    with (tmp_path / "tables" / "tonal-powers.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["paths", "noise, of <kind>", "power"]
    assert rows[1:] == [
        ["duct", 'tone "300"', "0.123456789"],
        ["band-pass", "diverged", "1000000.0"],
        ["duct", "7.0", "3"],
    ]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: study(figures=2 * [FigureItem("a", "", figure())]), "figures of study 'tonal' .* got a twice"),
        (lambda: study(tables=[POWERS, EMPTY, POWERS]), "tables of study 'tonal' .* got powers twice"),
        (lambda: study(algorithms={"KF-ANC": {"loudness": 1.0}}), r"unknown figures of merit \['loudness'\]"),
    ],
)
def test_what_no_study_holds_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("studies", "error", "message"),
    [
        ([], ValueError, "studies must hold at least one"),
        ([study(), study()], ValueError, "studies must have different names, got tonal twice"),
        ([study(extra={"path": Path()})], TypeError, r"study 'tonal', 'extra', 'path' must hold numbers.*got \w+Path"),
    ],
)
def test_what_cannot_be_written_is_refused_before_anything_is(studies, error, message, tmp_path):
    with pytest.raises(error, match=message):
        write_report(studies, tmp_path / "unused")
    assert not (tmp_path / "unused").exists()


def test_every_algorithm_has_a_description():
    assert list(ABOUT) == list(REGISTRY)


# ---- Claims


@pytest.mark.parametrize(
    ("limits", "words", "holding", "failing"),
    [
        ({"at_most": 1.0}, "at most 1", (-9.0, 1.0), (1.001, np.inf, np.nan)),
        ({"at_least": 1.0}, "at least 1", (1.0, np.inf), (0.999, -np.inf, np.nan)),
        ({"at_least": 0.97, "at_most": 1.02}, "0.97 to 1.02", (0.97, 1.02), (0.969, 1.021, np.nan)),
    ],
)
def test_a_claim_holds_within_its_limits_and_never_with_nan(limits, words, holding, failing):
    claims = {value: Claim("", value, **limits) for value in (*holding, *failing)}
    assert [value for value, claim in claims.items() if claim.holds] == list(holding)
    assert {claim.limits for claim in claims.values()} == {words}


@pytest.mark.parametrize("lost", [3.0, np.inf, np.nan])
def test_a_claim_is_judged_at_the_worst_wherever_that_stands(lost):
    others = {"a": 2.0, "b": 0.0}
    for values in ({"lost": lost} | others, others | {"lost": lost}):
        most = worst_claim("", values, at_most=2.5)
        least = worst_claim("", {where: -value for where, value in values.items()}, at_least=-2.5)
        assert not most.holds
        assert not least.holds
        assert most.note.startswith("lost; mean ")
        assert least.note.startswith("lost; mean ")
    assert worst_claim("", others, at_most=2.5).holds
    assert not worst_claim("", {}, at_most=2.5).holds


# ---- In the terminal


def test_the_terminal_shows_claims_figures_of_merit_and_what_fits_a_screen():
    long = Table("long", "Too long", ["power"], [[1.0]] * 31)
    lines = results_table([study(tables=[long, POWERS, EMPTY])]).splitlines()
    assert lines[0] == "tonal: Tone & clip <hard>"
    assert [" ".join(line.split()) for line in lines[2:4]] == [
        "holds 0.9996 at most 1 KF-OPC < rated",
        "fails 2 at least 3 It is faster (s) (a <note>)",
    ]
    assert [" ".join(line.split()) for line in lines[6:9]] == [
        "algorithm noise reduction (dB) output power of the rated power clipped diverged (s)",
        "KF-ANC 8.125 – – – 1.5",
        "KF-OPC – 0.7997 0.9996 0.25 –",
    ]
    assert [caption for caption in (long.caption, POWERS.caption, EMPTY.caption) if caption in lines] == [
        POWERS.caption
    ]
    assert lines[-1] == "1 of 2 claims hold; failing: 1 of tonal"
