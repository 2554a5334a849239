"""The writer of the report: a page, figures, sounds, results.json, and a table for the terminal."""

from __future__ import annotations

import json
import os
import textwrap
from collections.abc import Sequence
from pathlib import Path

from kfopc_filterpy._writing import prepare_folder, replacing_files, write_whole
from kfopc_filterpy.plot import save_figure
from kfopc_filterpy.verdict.items import Table, aligned, write_files

from .opening import claims_sentence, glance
from .report_page import page
from .study_report import StudyReport, merit_table, require_different

SCREEN_ROWS = 30  # of a table that fits a screen, with the claims above it


def write_report(studies: Sequence[StudyReport], folder: str | os.PathLike[str]) -> Path:
    """Write report.html, results.json, figures/, audio/ and, if there are any, tables/ into a folder.

    Parameters
    ----------
    studies : sequence of StudyReport
        The studies, in their order.
    folder : path
        Where to write; files of the same names are replaced, all of them or none, and others stay.

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
    path, lead = prepare_folder(folder), glance(studies)
    with replacing_files(path) as new:
        if lead is not None:
            save_figure(lead.figure, new / "figures" / lead.stem)
        for study in studies:
            write_files(new, study.name, fs=study.fs, figures=study.figures, sounds=study.sounds, tables=study.tables)
        write_whole(new / "results.json", results + "\n")
        write_whole(new / "report.html", page(studies, new, lead))
    return path / "report.html"


def results_table(studies: Sequence[StudyReport]) -> str:
    """Return the studies' results as text for a terminal: the claims and one table, so that a study fits a screen.

    The table is that of the figures of merit or, without them, the first that fits. All tables are in the report. What has
    no claims shows all its tables that fit.

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
    ...     claims=[Claim("KF-OPC keeps its rated power", True, "0.9999 of 1")],
    ... )
    >>> print(results_table([study]))
    tonal: A tone (rated power 1)
            noise reduction  output power  of rated power  peak control signal  clipped  harmonics  converged  diverged
                         dB                         times                             %         dB          s         s
    KF-OPC             10.1        0.9999          0.9999                    -        -          -          -         -
      REPRODUCED      KF-OPC keeps its rated power
                      0.9999 of 1
    <BLANKLINE>
    The one claim of the paper was reproduced.
    """
    lines = []
    for study in studies:
        lines.append(f"{study.name}: {study.title} (rated power {study.rating})")
        if study.algorithms:
            columns, rows = merit_table(study)
            heads = [["", *head] for head in zip(*columns, strict=True)]
            named = [[name, *row] for name, row in zip(study.algorithms, rows, strict=True)]
            lines += aligned([*heads, *named], {0})
        for claim in study.claims:
            mark = study.marks[0 if claim.holds else 1].upper()
            lines += textwrap.wrap(claim.text, 116, initial_indent=f"  {mark:<16}", subsequent_indent=18 * " ")
            lines += textwrap.wrap(claim.measured, 116, initial_indent=18 * " ", subsequent_indent=18 * " ")
        for table in _on_a_screen(study):
            lines += ["", *textwrap.wrap(table.caption, 116), *table.lines]
        lines.append("")
    return "\n".join([*lines, *textwrap.wrap(claims_sentence(studies), 116)])


def _on_a_screen(study: StudyReport) -> list[Table]:
    """Return the tables that a terminal shows beside the figures of merit and the claims."""
    fitting = [table for table in study.tables if len(table.rows) <= SCREEN_ROWS]
    if not study.claims:
        return fitting
    return [] if study.algorithms else fitting[:1]
