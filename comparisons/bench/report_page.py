"""The report as one HTML page that needs no other file; its layout is in report.html.jinja."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from kfopc_filterpy._writing import jsonable
from kfopc_filterpy.verdict.items import FigureItem
from kfopc_filterpy.verdict.page import images, inlined, players, rendered

from .descriptions import described
from .opening import claims_sentence
from .study_report import Parameter, StudyReport, merit_table

TITLE = "Kalman filter with output power constraint"
WITHOUT_CLAIMS = "Comparison of algorithms"
PAPER = (
    "J. Ji, D. Shi, B. Wang, X. Shen, Z. Luo and W.-S. Gan, “Preventing output saturation in active noise control: "
    "An output-constrained Kalman filter approach”."
)
TEMPLATE = Path(__file__).with_name("report.html.jinja")
_LONG = 4  # lines of a parameter's value beyond which they are folded away


def page(studies: Sequence[StudyReport], folder: Path, lead: FigureItem | None) -> str:
    """Return the report as HTML, with its figures, which lie in `folder`, and excerpts of its sounds inlined.

    The `lead` figure stands at the top; without one, the first figure of the studies does.
    """
    figures = [images(folder, study.name, study.figures) for study in studies]
    first: dict[str, Any] | None = None
    if lead is not None:
        first = inlined(lead, folder / "figures" / lead.stem)
    elif shown := next(filter(None, figures), None):
        first = shown.pop(0)
    names = [name for study in studies for name in study.algorithms]
    return rendered(
        TEMPLATE,
        title=TITLE if any(study.claims for study in studies) else WITHOUT_CLAIMS,
        paper=PAPER if "KF-OPC" in names else "",
        described=described(name for name in names if name != "KF-OPC"),
        lead=first,
        claims=claims_sentence(studies),
        parts=[_part(study, own, folder) for study, own in zip(studies, figures, strict=True)],
    )


def _part(study: StudyReport, figures: list[dict[str, Any]], folder: Path) -> dict[str, Any]:
    """Return what the template shows of a study."""
    headings, merit = _merit(study)
    return {
        "study": study,
        "held": sum(bool(claim.holds) for claim in study.claims),
        "merit_headings": headings,
        "merit": merit,
        "figures": figures,
        "players": list(players(folder, study.name, study.sounds, study.fs)),
        "parameters": list(_parameters(study.parameters, study.algorithms)),
    }


def _merit(study: StudyReport) -> tuple[list[str], list[list[str]]]:
    """Return the headings and rows of the figures of merit, without the columns that say nothing."""
    columns, rows = merit_table(study)
    headings = [heading.capitalize() + (f" ({unit})" if unit else "") for heading, unit in columns]
    kept = [i for i in range(len(headings)) if any(row[i] != "-" for row in rows)]
    cells = (["–" if row[i] == "-" else row[i] for i in kept] for row in rows)
    shown = [[name, *own] for name, own in zip(study.algorithms, cells, strict=True)]
    return ["Algorithm", *(headings[i] for i in kept)], shown


def _parameters(parameters: Mapping[str, Parameter], algorithms: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the algorithm, meaning, value and origin of each parameter; without an algorithm it is the study's."""
    longest_first = sorted(algorithms, key=len, reverse=True)
    for name, own in parameters.items():
        whose = next((algorithm for algorithm in longest_first if name.startswith(f"{algorithm} ")), "")
        meaning = (name.removeprefix(f"{whose} ") if whose else name).replace("_", " ")
        lines = _text(jsonable(own.value)).split("\n")
        said = {"whose": whose, "meaning": meaning, "chosen": own.chosen}
        yield {**said, "lines": lines, "folded": len(lines) > _LONG}


def _text(value: Any) -> str:
    """Return a value as text: a line for each row of a table, and for each key of a mapping."""
    if isinstance(value, list):
        return ("\n" if any(isinstance(item, list) for item in value) else ", ").join(map(_text, value))
    if isinstance(value, dict):
        return "\n".join(f"{key.replace('_', ' ')}: {_text(item)}" for key, item in value.items())
    if isinstance(value, float):
        return f"{value:.6g}"
    return "–" if value is None else str(value)
