"""One HTML page that needs no other file: its frame, and figures and sounds inlined."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from .items import EXCERPT_S, HEADROOM, FigureItem, Sound, file_of, loudness

_COLOURS = 64  # of an inlined figure: lines and letters need no more, and it is a third as large


def rendered(template: Path, **values: Any) -> str:
    """Return a template filled in with values, which are escaped; it may build on the templates of this folder."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    folders = FileSystemLoader([template.parent, Path(__file__).parent])
    layout = Environment(loader=folders, autoescape=True, undefined=StrictUndefined, keep_trailing_newline=True)
    layout.globals |= {"headroom": HEADROOM, "excerpt_s": EXCERPT_S}
    return layout.get_template(template.name).render(**values)


def images(folder: Path, name: str, figures: Sequence[FigureItem]) -> list[dict[str, Any]]:
    """Return figures as they are inlined; their files, which begin with a `name`, lie in `folder`."""
    return [inlined(item, file_of(folder, name, item)) for item in figures]


def inlined(item: FigureItem, file: Path) -> dict[str, Any]:
    """Return a figure as a small PNG of few colours; its files are the full ones."""
    from PIL import Image

    with Image.open(file.with_name(file.name + ".png")) as image:
        small = io.BytesIO()
        image.convert("RGB").quantize(_COLOURS).save(small, "PNG", optimize=True)
        broad = image.width > 2 * image.height
    source = data_uri(small.getvalue(), "image/png")
    return {"caption": item.caption, "source": source, "broad": broad}


def players(
    folder: Path, name: str, sounds: Sequence[Sound], fs: float, first_heard: str = "KF-OPC"
) -> Iterator[dict[str, Any]]:
    """Yield the sounds of each group, which one player switches between, at first to the label with these words."""
    signals, full_scale = loudness(sound.signal for sound in sounds)
    pairs = zip(sounds, signals, strict=True)
    for number, (group, members) in enumerate(groupby(pairs, key=lambda pair: pair[0].group)):
        tracks = [
            {
                "label": sound.label,
                "caveat": _caveat(sound, clipped),
                "source": data_uri(flac(sound.excerpt(clipped / full_scale, fs), fs), "audio/flac"),
                "file": file_of(folder, name, sound).relative_to(folder).as_posix(),
            }
            for sound, clipped in members
        ]
        shown = next((i for i, track in enumerate(tracks) if first_heard in track["label"]), min(1, len(tracks) - 1))
        yield {"id": f"{name}-sounds-{number}", "group": group, "tracks": tracks, "shown": shown}


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
