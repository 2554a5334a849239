"""Parts that the figures of runs share: results by name, a fixed style per algorithm, channels, spans of time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from .._validate import as_count, as_number
from ..loop.result import SimulationResult
from .style import COLOURS, STYLES, curve_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DISTURBANCE: dict[str, Any] = {"color": "0.6", "linestyle": "-", "linewidth": 1.2, "zorder": 1.5}
RATED: dict[str, Any] = {"color": "0.15", "linestyle": (0, (1, 1.2)), "linewidth": 1.2}


class Curve(NamedTuple):
    """One entry of a legend: its runs (several seeds of one experiment) and its style."""

    label: str
    runs: list[SimulationResult]
    style: dict[str, Any]

    @property
    def run(self) -> SimulationResult:
        """The first run."""
        return self.runs[0]

    def stack(self, name: str, channel: int | None = None) -> np.ndarray:
        """Return the signals `name` of the runs, (n_runs, n_samples) or, with all of several channels, 3-D."""
        signals = (getattr(run, name) for run in self.runs)
        return np.stack([x if channel is None else one_channel(x, channel) for x in signals])

    def line(self) -> dict[str, Any]:
        """Return the label, with the time of a divergence, and the line style of a smooth curve."""
        label = self.label
        ends = [run.diverged_at_s for run in self.runs if run.diverged_at_s is not None]
        if ends:
            several = f"{len(ends)} of {len(self.runs)} runs " if len(self.runs) > 1 else ""
            label += f" ({several}diverged at {min(ends):.3g} s)"
        return {"label": label, **self.style, "marker": ""}

    def draw(self, ax: Axes, y: np.ndarray, i: int, samples: np.ndarray | None = None) -> None:
        """Draw some samples of `y`, (n,) or (n_loudspeakers, n), over time, thin, solid and with sparse markers.

        The markers of the i-th curve lie between those of the others. The loudspeakers of a run look alike.
        """
        samples = thinned(y.shape[-1]) if samples is None else samples
        style = {**self.line(), "linestyle": "-", "linewidth": 1.0, "markersize": 4.5}
        rows = np.atleast_2d(y)[:, samples]
        if len(rows) > 1:
            style["label"] += f", {len(rows)} loudspeakers"
        for row in rows:
            drawn = style
            if np.any(np.isfinite(row) & (row != 0)):  # matplotlib cannot place markers along a curve without points
                drawn = style | {"marker": self.style["marker"], "markevery": (0.02 + 0.025 * (i % 4), 0.1)}
            ax.plot((samples + 1) / self.run.fs, row, **drawn)
            style = style | {"label": None}


def one_channel(signal: np.ndarray, channel: int | None) -> np.ndarray:
    """Return one channel of a run's signal, (n_samples,); of several it has to be chosen."""
    n_channels = 1 if signal.ndim == 1 else len(signal)
    if channel is None and n_channels > 1:
        raise ValueError(f"results hold {n_channels} channels; choose one with channel=0 to channel={n_channels - 1}")
    index = as_count(channel or 0, "channel", minimum=0)
    if index >= n_channels:
        raise ValueError(f"channel must be below the {n_channels} channel(s) of the results, got {index}")
    return np.atleast_2d(signal)[index]


def named_styles(labels: list[str], algorithms: list[str]) -> list[dict[str, Any]]:
    """Return the styles of curves, each with a colour of its own while there are enough.

    A curve gets the style of its label if that names an algorithm, otherwise that of its algorithm. If these are taken,
    it gets one of the other colours. A solid line is wide and beneath the others, so that curves that coincide are both
    seen.
    """
    taken: list[dict[str, Any]] = []
    others = [curve_style(i) for i in range(COLOURS)]
    for label, algorithm in zip(labels, algorithms, strict=True):
        colours = {style["color"] for style in taken}
        known = [curve_style(name) for name in (label, algorithm) if name in STYLES]
        style = next((one for one in [*known, *others] if one["color"] not in colours), others[0])
        width, order = (2.2, 2.0) if style["linestyle"] == "-" else (1.4, 2.1)
        taken.append({**style, "linewidth": width, "zorder": order})
    return taken


# Runs to be drawn together: one, several, or by name one or several.
Results: TypeAlias = (
    SimulationResult | Sequence[SimulationResult] | Mapping[str, SimulationResult | Sequence[SimulationResult]]
)


def curves(results: Results, *, single: bool = False) -> list[Curve]:
    """Return results as curves; they come as one result, a sequence, or a mapping of name to one or several."""
    named = _grouped(results)
    if not named or not all(named.values()):
        raise ValueError("results must hold at least one SimulationResult for each name, got none")
    for label, runs in named.items():
        for run in runs:
            if not isinstance(run, SimulationResult):
                raise TypeError(f"results must hold SimulationResult, got {type(run).__name__} under {label!r}")
        if len({(run.fs, run.error.shape, run.control_signal.shape) for run in runs}) > 1:
            raise ValueError(f"results {label!r} must be runs of one length and one fs, with the same channels")
        if single and len(runs) > 1:
            raise ValueError(f"results must hold one run per name here, got {len(runs)} runs of {label!r}")
    styles = named_styles(list(named), [runs[0].algorithm for runs in named.values()])
    return [Curve(label, runs, style) for (label, runs), style in zip(named.items(), styles, strict=True)]


def _grouped(results: Any) -> dict[str, list[Any]]:
    if isinstance(results, Mapping):
        several = (list, tuple)
        return {str(name): list(value) if isinstance(value, several) else [value] for name, value in results.items()}
    if isinstance(results, SimulationResult):
        return {results.algorithm: [results]}
    if not isinstance(results, list | tuple):
        raise TypeError(f"results must be a SimulationResult or a sequence of them, got {type(results).__name__}")
    named: dict[str, list[Any]] = {}
    for result in results:
        name = getattr(result, "algorithm", type(result).__name__)
        if name in named:
            raise ValueError(f"results hold two runs of {name!r}; pass a mapping that gives each a name of its own")
        named[name] = [result]
    return named


def require_common_disturbance(shown: list[Curve]) -> None:
    """Raise ValueError if the runs have different disturbances, which these figures draw once."""
    first = shown[0].stack("disturbance")
    for curve in shown[1:]:
        if curve.run.fs != shown[0].run.fs or not np.array_equal(curve.stack("disturbance"), first):
            raise ValueError(
                f"results must have one disturbance, because it is drawn once: those of {curve.label!r} and "
                f"{shown[0].label!r} differ; draw them in two axes"
            )


def span_of(run: SimulationResult, span_s: tuple[float, float]) -> slice:
    """Return the samples of a run between two times in seconds."""
    duration = run.n_samples / run.fs
    try:
        start, end = (as_number(time, "span_s", unit="s") for time in span_s)
    except (TypeError, ValueError) as error:
        raise ValueError(f"span_s must be a pair (start, end) in seconds, got {span_s!r}") from error
    part = slice(round(start * run.fs), round(end * run.fs))
    if not 0 <= part.start < part.stop <= run.n_samples:
        raise ValueError(f"span_s must satisfy 0 <= start < end <= {duration:g} s, got ({start:g}, {end:g}) s")
    return part


def span_times(ax: Axes, run: SimulationResult, part: slice, span_s: tuple[float, float]) -> np.ndarray:
    """Set the time axis to a span, in ms if it is short; return the times of its samples, `part`."""
    per_second, unit = (1e3, "ms") if span_s[1] - span_s[0] < 0.5 else (1.0, "s")
    ax.set(xlim=(span_s[0] * per_second, span_s[1] * per_second), xlabel=f"Time ({unit})")
    return np.arange(part.start, part.stop) / run.fs * per_second


def thinned(n_samples: int, step: int = 1, most: int = 4000) -> np.ndarray:
    """Return the indices of every step-th sample, of fewer if these are more than `most`."""
    return np.arange(0, n_samples, max(1, step, -(-n_samples // most)))
