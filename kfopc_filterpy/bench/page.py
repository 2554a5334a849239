"""The report as one HTML page that needs no other file; its layout is in report.html.jinja."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from . import study_report
from .descriptions import described
from .mathematics import mathml, parameter, prose
from .opening import claims_sentence
from .study_report import FigureItem, Parameter, Sound, StudyReport, file_of, jsonable, loudness, merit_table

TITLE = "Kalman filter with output power constraint"
WITHOUT_CLAIMS = "Comparison of algorithms"
PAPER = (
    "J. Ji, D. Shi, B. Wang, X. Shen, Z. Luo and W.-S. Gan, “Preventing output saturation in active noise control: "
    "An output-constrained Kalman filter approach”."
)
TEMPLATE = "report.html.jinja"
_COLOURS = 64  # of an inlined figure: lines and letters need no more, and it is a third as large
_LONG = 4  # lines of a parameter's value beyond which they are folded away


def page(studies: Sequence[StudyReport], folder: Path, lead: FigureItem | None) -> str:
    """Return the report as HTML, with its figures, which lie in `folder`, and excerpts of its sounds inlined.

    The `lead` figure stands at the top; without one, the first figure of the studies does.
    """
    figures = [images(study, folder) for study in studies]
    first: dict[str, Any] | None = None
    if lead is not None:
        first = _image(lead, folder / "figures" / lead.stem)
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


def rendered(template: str, **values: Any) -> str:
    """Return a template of this folder, filled in with values, which are escaped."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    folder = FileSystemLoader(Path(__file__).parent)
    layout = Environment(loader=folder, autoescape=True, undefined=StrictUndefined, keep_trailing_newline=True)
    layout.filters |= {"math": mathml, "prose": prose}
    layout.globals |= {"headroom": study_report.HEADROOM, "excerpt_s": study_report.EXCERPT_S}
    return layout.get_template(template).render(**values)


def images(study: StudyReport, folder: Path) -> list[dict[str, Any]]:
    """Return the figures of a study, whose files lie in `folder`, as they are inlined."""
    return [_image(item, file_of(folder, study, item)) for item in study.figures]


def _part(study: StudyReport, figures: list[dict[str, Any]], folder: Path) -> dict[str, Any]:
    """Return what the template shows of a study."""
    headings, merit = _merit(study)
    return {
        "study": study,
        "held": sum(bool(claim.holds) for claim in study.claims),
        "merit_headings": headings,
        "merit": merit,
        "figures": figures,
        "players": list(players(study, folder)),
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
    """Yield the algorithm, symbol, meaning, value and origin of each parameter; without an algorithm it is the study's."""
    longest_first = sorted(algorithms, key=len, reverse=True)
    for name, own in parameters.items():
        whose = next((algorithm for algorithm in longest_first if name.startswith(f"{algorithm} ")), "")
        symbol, meaning = parameter(name.removeprefix(f"{whose} ") if whose else name)
        lines = _text(jsonable(own.value)).split("\n")
        said = {"whose": whose, "symbol": symbol, "meaning": meaning, "chosen": own.chosen}
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


def _image(item: FigureItem, file: Path) -> dict[str, Any]:
    """Return a figure as a small PNG of few colours; its files are the full ones."""
    from PIL import Image

    with Image.open(file.with_name(file.name + ".png")) as image:
        small = io.BytesIO()
        image.convert("RGB").quantize(_COLOURS).save(small, "PNG", optimize=True)
        broad = image.width > 2 * image.height
    source = data_uri(small.getvalue(), "image/png")
    return {"caption": item.caption, "alt": item.alt or item.caption, "source": source, "broad": broad}


def players(study: StudyReport, folder: Path, first_heard: str = "KF-OPC") -> Iterator[dict[str, Any]]:
    """Yield the sounds of each group, which one player switches between, at first to the label with these words."""
    signals, full_scale = loudness(sound.signal for sound in study.sounds)
    pairs = zip(study.sounds, signals, strict=True)
    for number, (group, members) in enumerate(groupby(pairs, key=lambda pair: pair[0].group)):
        tracks = [
            {
                "label": sound.label,
                "caveat": _caveat(sound, clipped),
                "source": data_uri(flac(sound.excerpt(clipped / full_scale, study.fs), study.fs), "audio/flac"),
                "file": file_of(folder, study, sound).relative_to(folder).as_posix(),
            }
            for sound, clipped in members
        ]
        shown = next((i for i, track in enumerate(tracks) if first_heard in track["label"]), min(1, len(tracks) - 1))
        yield {"id": f"{study.name}-sounds-{number}", "group": group, "tracks": tracks, "shown": shown}


def flac(signal: np.ndarray, fs: float) -> bytes:
    """Return a signal of full scale 1 as FLAC of 16 bits, lossless and half as large as WAV; NaN is silence."""
    import soundfile

    data = io.BytesIO()
    soundfile.write(data, np.nan_to_num(signal), round(fs), format="FLAC", subtype="PCM_16")
    return data.getvalue()


def _caveat(sound: Sound, clipped: np.ndarray) -> str:
    signal = np.asarray(sound.signal, dtype=np.float64)
    remarks = []
    if not np.array_equal(signal, clipped, equal_nan=True):
        remarks.append("louder than full scale: clipped")
    if np.isnan(signal[-1]):
        remarks.append("silent after the divergence")
    return "; ".join(remarks)


def data_uri(data: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
