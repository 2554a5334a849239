"""The report as one HTML page that needs no other file."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from .items import (
    COLUMNS,
    HEADROOM,
    FigureItem,
    Sound,
    StudyReport,
    Table,
    Verdict,
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
_ONE_SCALE = (
    '<p class="soft audio">All sounds of this study have one scale, so their levels compare: full scale is the loudest '
    f"one's peak, at most {HEADROOM:g} times the peak of the first.</p>"
)
_SVG_LIMIT = 600_000  # bytes beyond which a page inlines a figure as PNG

_CSS = """
:root { color-scheme: light; --ink: #1c2430; --soft: #5a6472; --line: #d8dde4; --head: #f3f5f8;
  --yes: #0a6b4a; --no: #a33b00; }
* { box-sizing: border-box; }
body { margin: 0; color: var(--ink); background: #fff; line-height: 1.5;
  font-family: system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
main { max-width: 1080px; margin: 0 auto; padding: 1.5rem 1.25rem 4rem; }
h1 { font-size: 1.7rem; line-height: 1.25; margin: 0.5rem 0; }
h2 { font-size: 1.35rem; margin: 3rem 0 0.5rem; padding-top: 0.75rem; border-top: 2px solid var(--ink); }
h3 { font-size: 1.05rem; margin: 1.75rem 0 0.5rem; }
p, ul { margin: 0.5rem 0; max-width: 46rem; }
.soft, figcaption { color: var(--soft); font-size: 0.9rem; }
nav ul { list-style: none; padding: 0; max-width: none; display: flex; flex-wrap: wrap; gap: 0.25rem 1.25rem; }
a { color: #0a58a8; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.9rem; width: 100%; }
th, td { text-align: left; vertical-align: top; padding: 0.35rem 0.7rem; border-bottom: 1px solid var(--line); }
thead th { background: var(--head); font-weight: 600; }
.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
thead .number { white-space: normal; }
tbody .value:first-child { white-space: nowrap; }
.stack .value:first-child { white-space: normal; }
.value { max-width: 24rem; overflow-wrap: anywhere; }
.mark { white-space: nowrap; font-weight: 600; }
.yes { color: var(--yes); } .no { color: var(--no); }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 460px), 1fr)); gap: 1.25rem; }
figure { margin: 0; break-inside: avoid; }
figure img { width: 100%; height: auto; display: block; }
.sounds { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 300px), 1fr)); gap: 0.75rem; }
audio { width: 100%; }
pre { overflow: auto; max-height: 24rem; background: var(--head); padding: 0.75rem; font-size: 0.8rem; }
@media (max-width: 600px) {
  main { padding: 0.75rem 0.75rem 3rem; } h1 { font-size: 1.35rem; } th, td { padding: 0.3rem 0.45rem; }
  .stack thead { display: none; } .stack tr { display: block; padding: 0.4rem 0; border-bottom: 1px solid var(--line); }
  .stack td, .stack th { display: block; border: 0; padding: 0.1rem 0.2rem; max-width: none; }
}
@media print {
  main { max-width: none; padding: 0; font-size: 0.85rem; } tr { break-inside: avoid; }
  section:not(#verdicts):not(#terms) h2 { break-before: page; } h2, h3 { break-after: avoid; }
  .figures { grid-template-columns: 1fr 1fr; }
  .sounds, .audio, details { display: none; } .wide { overflow: visible; } a { color: inherit; text-decoration: none; }
}
"""


def page(studies: Sequence[StudyReport], folder: Path) -> str:
    """HTML of the report, with the figures and sounds that lie in `folder` inlined."""
    sections = [("verdicts", "Verdicts"), *((study.name, study.title) for study in studies), ("terms", "Terms")]
    contents = "".join(f'<li><a href="#{name}">{escape(title)}</a></li>' for name, title in sections)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(TITLE)}</title>
<style>{_CSS}</style>
</head>
<body>
<main>
<h1>{escape(TITLE)}</h1>
<p class="soft">Reproduction of {escape(PAPER)}</p>
<nav aria-label="Contents"><ul>{contents}</ul></nav>
{_overview(studies)}
{"".join(_study(study, folder) for study in studies)}
{_TERMS}
</main>
</body>
</html>
"""


_TERMS = """<section id="terms">
<h2>Terms</h2>
<ul>
<li>Figures are of the steady second half of each run, means over the seeds where there are several;
“–” is undefined, or did not happen.</li>
<li>Noise reduction: −10 log<sub>10</sub>(Σe²/Σd²), with the error e and the disturbance d.</li>
<li>Output power: mean square of the control signal before the amplifier; the rated power ρ<sub>o</sub> is its
limit.</li>
<li>Clipped: share of the samples of the control signal beyond sqrt(2 rated power), the limit of the clipping amplifiers; with a linear one, what a clipping one would cut.</li>
<li>Harmonics: power at 2 to 10 times the tone's frequency in e, over the power of d at the tone.</li>
<li>Converged: first time from which the normalised squared error stays within 3 dB of its steady value.</li>
<li>Diverged: time at which the control signal passed 10<sup>6</sup> √ρ<sub>o</sub>, and the run was stopped.</li>
</ul>
</section>"""


def _overview(studies: Sequence[StudyReport]) -> str:
    rows = [
        [
            f'<a href="#{study.name}">{escape(study.title)}</a>',
            escape(verdict.claim),
            _mark(verdict, study),
            escape(verdict.figure),
        ]
        for study in studies
        for verdict in study.verdicts
    ]
    table = _table(["Study", "Claim", "Verdict", "Measured"], rows, "stack")
    return (
        f'<section id="verdicts">\n<h2>Verdicts</h2>\n<p>{escape(count_of_claims(studies))}.</p>\n{table}</section>\n'
    )


def _study(study: StudyReport, folder: Path) -> str:
    parameters = [
        [escape(name), _value(parameter.value), escape(parameter.chosen)]
        for name, parameter in study.parameters.items()
    ]
    merit = [
        [escape(name), *("–" if cell == "-" else escape(cell) for cell in cells(figures, study.rated_power))]
        for name, figures in study.algorithms.items()
    ]
    headings = [heading.capitalize() + (f" ({unit})" if unit else "") for heading, unit in COLUMNS]
    verdicts = [[escape(verdict.claim), _mark(verdict, study), escape(verdict.figure)] for verdict in study.verdicts]
    notes = (f"<li>{escape(note)}</li>" for note in study.notes)
    figures = (_figure(study, item, folder) for item in study.figures)
    parts = [
        f'<section id="{study.name}">\n<h2>{escape(study.title)}</h2>\n<p>{escape(study.summary)}</p>',
        f"<p>Rated power ρ<sub>o</sub> = {study.rated_power:g}, sampling frequency {study.fs:g} Hz.</p>",
        *_part("Results", _table(["Algorithm", *headings], merit, numbers=range(1, len(headings) + 1))),
        *_part(escape(study.claims), _table(["Claim", "Verdict", "Measured"], verdicts, "stack")),
        *(part for table in study.tables for part in _part(escape(table.caption), _shown(table))),
        *_part("Notes", _group(notes, "<ul>", "</ul>")),
        *_part("Figures", _group(figures, '<div class="figures">', "</div>")),
        *_part("Sounds", _group(_sounds(study, folder), f'{_ONE_SCALE}<div class="sounds">', "</div>"), "audio"),
        *_part("Parameters", _table(["Parameter", "Value", "How it was chosen"], parameters, "stack")),
    ]
    if study.extra:
        text = json.dumps(jsonable(study.extra), ensure_ascii=False, indent=1)
        parts.append(
            f"<details><summary>Further figures, as in results.json</summary><pre>{escape(text)}</pre></details>"
        )
    return "\n".join([*parts, "</section>\n"])


def _shown(table: Table) -> str:
    rows = [[escape(cell) for cell in row] for row in table.cells]
    return _table(table.headings, rows, numbers=table.numbers)


def _part(heading: str, content: str, kind: str = "") -> list[str]:
    """A part under its heading; nothing where it is empty."""
    return [f'<h3 class="{kind}">{heading}</h3>', content] if content else []


def _group(items: Iterable[str], start: str, end: str) -> str:
    content = "".join(items)
    return f"{start}{content}{end}" if content else ""


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]], kind: str = "", numbers: Iterable[int] = ()) -> str:
    """Table of cells that are HTML, nothing without rows; the columns `numbers` are aligned to the right."""
    right = set(numbers)
    if not rows:
        return ""

    def row(cells: Sequence[str], tag: str) -> str:
        marked = (
            f'<{tag} class="{"number" if i in right else "value"}">{cell}</{tag}>' for i, cell in enumerate(cells)
        )
        return f"<tr>{''.join(marked)}</tr>"

    body = "\n".join(row(cells, "td") for cells in rows)
    head = row([escape(heading) for heading in headings], "th")
    return f'<div class="wide"><table class="{kind}"><thead>{head}</thead>\n<tbody>{body}</tbody></table></div>\n'


def _mark(verdict: Verdict, study: StudyReport) -> str:
    held, not_held = study.marks
    if verdict.reproduced:
        return f'<span class="mark yes">✓ {held}</span>'
    return f'<span class="mark no">✗ {not_held}</span>'


def _value(value: Any) -> str:
    """A parameter's value; the rows of a table of values on lines of their own."""
    clean = jsonable(value)
    if isinstance(clean, list) and any(isinstance(item, list) for item in clean):
        return "<br>".join(_value(item) for item in clean)
    if isinstance(clean, list):
        return ", ".join(_value(item) for item in clean)
    if isinstance(clean, dict):
        return "<br>".join(f"{escape(key)}: {_value(item)}" for key, item in clean.items())
    if isinstance(clean, float):
        return f"{clean:.6g}"
    return "–" if clean is None else escape(str(clean))


def _figure(study: StudyReport, item: FigureItem, folder: Path) -> str:
    path = figure_file(folder, study, item)
    data, kind = path.with_name(path.name + ".svg").read_bytes(), "svg+xml"
    if len(data) > _SVG_LIMIT:
        data, kind = path.with_name(path.name + ".png").read_bytes(), "png"
    caption = escape(item.caption)
    image = f'<img alt="{caption}" src="{_data_uri(data, f"image/{kind}")}">'
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>\n"


def _sounds(study: StudyReport, folder: Path) -> Iterable[str]:
    for sound, (clipped, _) in zip(study.sounds, loudness(study), strict=True):
        source = _data_uri(sound_file(folder, study, sound).read_bytes(), "audio/wav")
        label = escape(sound.label) + _caveat(sound, clipped)
        yield f'<div>{label}<br><audio controls src="{source}"></audio></div>\n'


def _caveat(sound: Sound, clipped: np.ndarray) -> str:
    signal = np.asarray(sound.signal, dtype=np.float64)
    remarks = []
    if not np.array_equal(signal, clipped, equal_nan=True):
        remarks.append("louder than full scale: clipped")
    if np.isnan(signal[-1]):
        remarks.append("silent after the divergence")
    return f' <span class="soft">({"; ".join(remarks)})</span>' if remarks else ""


def _data_uri(data: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
