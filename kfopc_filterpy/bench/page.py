"""The report as one HTML page that needs no other file; its layout is in report.html.jinja."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .items import (
    COLUMNS,
    HEADROOM,
    FigureItem,
    Sound,
    StudyReport,
    cells,
    count_of_claims,
    figure_file,
    jsonable,
    loudness,
    sound_file,
)

TITLE = "Kalman filter with output power constraint: the paper's studies"
PAPER = (
    "J. Ji, D. Shi, B. Wang, X. Shen, Z. Luo and W.-S. Gan, “Preventing output saturation in active noise control: "
    "An output-constrained Kalman filter approach”."
)
TEMPLATE = "report.html.jinja"
_SVG_LIMIT = 600_000  # bytes beyond which a page inlines a figure as PNG


def page(studies: Sequence[StudyReport], folder: Path) -> str:
    """Return the report as HTML, with the figures and sounds that lie in `folder` inlined."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    layout = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        keep_trailing_newline=True,
    )
    return layout.get_template(TEMPLATE).render(
        title=TITLE,
        paper=PAPER,
        contents=[("verdicts", "Verdicts"), *((study.name, study.title) for study in studies), ("terms", "Terms")],
        count=count_of_claims(studies),
        has_verdicts=any(study.verdicts for study in studies),
        headroom=HEADROOM,
        parts=[_part(study, folder) for study in studies],
    )


def _part(study: StudyReport, folder: Path) -> dict[str, Any]:
    """Return what the template shows of a study."""
    return {
        "study": study,
        "merit_headings": [
            "Algorithm",
            *(heading.capitalize() + (f" ({unit})" if unit else "") for heading, unit in COLUMNS),
        ],
        "merit": [
            [name, *("–" if cell == "-" else cell for cell in cells(figures, study.rated_power))]
            for name, figures in study.algorithms.items()
        ],
        "figures": [(item.caption, _image(study, item, folder)) for item in study.figures],
        "sounds": list(_sounds(study, folder)),
        "parameters": [(name, _lines(own.value), own.chosen) for name, own in study.parameters.items()],
        "extra": json.dumps(jsonable(study.extra), ensure_ascii=False, indent=1) if study.extra else "",
    }


def _lines(value: Any) -> list[str]:
    """Return a parameter's value as lines of text: one for each row of a table, and for each key of a mapping."""
    return _text(jsonable(value)).split("\n")


def _text(value: Any) -> str:
    if isinstance(value, list):
        return ("\n" if any(isinstance(item, list) for item in value) else ", ").join(map(_text, value))
    if isinstance(value, dict):
        return "\n".join(f"{key}: {_text(item)}" for key, item in value.items())
    if isinstance(value, float):
        return f"{value:.6g}"
    return "–" if value is None else str(value)


def _image(study: StudyReport, item: FigureItem, folder: Path) -> str:
    path = figure_file(folder, study, item)
    data, kind = path.with_name(path.name + ".svg").read_bytes(), "svg+xml"
    if len(data) > _SVG_LIMIT:
        data, kind = path.with_name(path.name + ".png").read_bytes(), "png"
    return _data_uri(data, f"image/{kind}")


def _sounds(study: StudyReport, folder: Path) -> Iterator[tuple[str, str, str]]:
    """Yield the label, the caveat and the data of each sound."""
    for sound, (clipped, _) in zip(study.sounds, loudness(study), strict=True):
        source = _data_uri(sound_file(folder, study, sound).read_bytes(), "audio/wav")
        yield sound.label, _caveat(sound, clipped), source


def _caveat(sound: Sound, clipped: np.ndarray) -> str:
    signal = np.asarray(sound.signal, dtype=np.float64)
    remarks = []
    if not np.array_equal(signal, clipped, equal_nan=True):
        remarks.append("louder than full scale: clipped")
    if np.isnan(signal[-1]):
        remarks.append("silent after the divergence")
    return "; ".join(remarks)


def _data_uri(data: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
