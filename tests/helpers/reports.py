"""A small report that tests write."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from comparisons.bench import Claim, FigureItem, Parameter, Sound, StudyReport

FS = 8000.0
D = np.sin(np.arange(400) / 3)


def figure() -> Figure:
    """Return a small figure."""
    drawn = Figure(figsize=(3, 2))
    drawn.subplots().plot([0, 1])
    return drawn


def study(name: str = "tonal", **changes: Any) -> StudyReport:
    """Return a report with something in every part; `changes` replace parts."""
    settings: dict[str, Any] = {
        "name": name,
        "title": "Tone & clip <hard>",
        "summary": "A tone <of> 2.",
        "fs": FS,
        "rated_power": 0.8,
        "parameters": {
            "q": Parameter(np.float64(1e-4), "estimate <of> eq. 7"),
            "seeds": Parameter(range(3), "of noise"),
            "tried": Parameter([(1e-7, np.nan), (1e-6, "diverged")], "grid"),
        },
        "algorithms": {
            "KF-ANC": {"noise_reduction_db": np.float64(8.125), "output_power": np.inf, "diverged_at_s": 1.5},
            "KF-OPC": {"output_power": 0.79971, "clipped_fraction": 0.25, "harmonics_db": float("nan")},
        },
        "extra": {"sweep": {"over_db": np.arange(2), "best": np.array([1.0, -np.inf])}, "flip": np.float32(4.5)},
        "claims": [
            Claim("KF-OPC < rated", 0.99964, at_most=1.0),
            Claim("It is faster (s)", np.float64(2.0), at_least=3.0, note="a <note>"),
        ],
        "figures": [FigureItem("a-spectra", 'Spectra "of" e & d.', figure())],
        "sounds": [Sound("disturbance", "Disturbance", D), Sound("kf-anc", "Residual", np.append(D[:-1] / 2, np.nan))],
        "notes": ["One <note>."],
    }
    return StudyReport(**(settings | changes))
