"""The report: one page that needs no other file, with its figures, sounds, tables and results.json; and as text."""

from __future__ import annotations

import json
import os
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kfopc_filterpy._writing import jsonable, prepare_folder, replacing_files, write_whole
from kfopc_filterpy.verdict.items import write_files
from kfopc_filterpy.verdict.page import images, players, rendered

from .merit import MERITS
from .registry import ABOUT
from .study_report import Claim, StudyReport, claims_sentence, require_different

SCREEN_ROWS = 30  # of a table that fits a screen
TEMPLATE = Path(__file__).with_name("report.html.jinja")


def write_report(studies: Sequence[StudyReport], folder: str | os.PathLike[str]) -> Path:
    """Write report.html, results.json, figures/, audio/ and, if there are any, tables/ into a folder.

    Parameters
    ----------
    studies : sequence of StudyReport
        The studies, in their order.
    folder : path
        Where to write; files of the same names are replaced once all are written, and others stay.

    Returns
    -------
    pathlib.Path
        report.html, which needs none of the other files: it links to the sounds in full length, and plays excerpts.

    Raises
    ------
    OSError
        The folder cannot be written.
    ValueError, TypeError
        No study, two of one name, or a value that JSON cannot hold.

    Examples
    --------
    >>> import tempfile
    >>> from comparisons.bench import StudyReport, write_report
    >>> study = StudyReport("tonal", "A tone", "", 16000, 1.0, {}, {"KF-OPC": {"output_power": 0.9999}})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     print(write_report([study], folder).name)
    report.html
    """
    if not studies:
        raise ValueError("studies must hold at least one StudyReport, got none")
    require_different((study.name for study in studies), "studies")
    results = json.dumps(
        {"studies": {study.name: study.result for study in studies}}, allow_nan=False, ensure_ascii=False, indent=2
    )
    path = prepare_folder(folder)
    with replacing_files(path) as new:
        for study in studies:
            write_files(
                new, study.name, fs=study.fs, figures=study.figures, sounds=study.sounds, tables=study.all_tables
            )
        write_whole(new / "results.json", results + "\n")
        write_whole(new / "report.html", _page(studies, new))
    return path / "report.html"


def _page(studies: Sequence[StudyReport], folder: Path) -> str:
    """Return the page; the files of its figures and sounds lie in `folder`."""
    parts = [
        {
            "study": study,
            "tables": [table for table in study.all_tables if table.stem != "claims"],
            "figures": images(folder, study.name, study.figures),
            "players": list(players(folder, study.name, study.sounds, study.fs)),
            "parameters": [(name, _text(jsonable(own.value)), own.chosen) for name, own in study.parameters.items()],
        }
        for study in studies
    ]
    names = dict.fromkeys(name for study in studies for name in study.algorithms)
    described = {name: ABOUT[name] for name in names if name in ABOUT}
    return rendered(TEMPLATE, parts=parts, claims=claims_sentence(studies), described=described, merits=MERITS)


def _text(value: Any) -> str:
    """Return a value of JSON as text: a line for each row of a table, and for each key of a mapping."""
    if isinstance(value, list):
        return ("\n" if any(isinstance(item, list) for item in value) else ", ").join(map(_text, value))
    if isinstance(value, dict):
        return "\n".join(f"{key.replace('_', ' ')}: {_text(item)}" for key, item in value.items())
    if isinstance(value, float):
        return f"{value:.6g}"
    return "–" if value is None else str(value)


def results_table(studies: Sequence[StudyReport]) -> str:
    """Return the studies' results as text for a terminal: all tables that fit a screen; the report has the others, too.

    Parameters
    ----------
    studies : sequence of StudyReport
        The studies, in their order.

    Returns
    -------
    str
        Lines without a newline at the end.

    Examples
    --------
    >>> from comparisons.bench import StudyReport, Claim, results_table
    >>> study = StudyReport(
    ...     "tonal", "A tone", "", 16000, 1.0, {}, {"KF-OPC": {"noise_reduction_db": 10.1, "output_power": 0.9999}},
    ...     claims=[Claim("KF-OPC's output power over the rated one", 0.9999, at_most=1.02)],
    ... )
    >>> print(results_table([study]))
    tonal: A tone
    <BLANKLINE>
    holds     0.9999  at most 1.02    KF-OPC's output power over the rated one
    <BLANKLINE>
    Figures of merit
    algorithm  noise reduction (dB)  output power  of the rated power
    KF-OPC                     10.1        0.9999              0.9999
    <BLANKLINE>
    1 of 1 claims hold
    """
    lines = []
    for study in studies:
        lines += [f"{study.name}: {study.title}", ""]
        lines += [line for claim in study.claims for line in _told(claim)]
        lines += [""] if study.claims else []
        for table in study.all_tables:
            if table.stem != "claims" and len(table.rows) <= SCREEN_ROWS:
                lines += [*textwrap.wrap(table.caption, 116), *table.lines, ""]
    return "\n".join([*lines, claims_sentence(studies)]).rstrip()


def _told(claim: Claim) -> list[str]:
    """Return a claim as lines: whether it holds, what was measured, the limits, and the text."""
    begins = f"{'holds' if claim.holds else 'fails'} {claim.value:10.4g}  {claim.limits:<14}  "
    text = f"{claim.text} ({claim.note})" if claim.note else claim.text
    return textwrap.wrap(text, 116, initial_indent=begins, subsequent_indent=" " * len(begins))
