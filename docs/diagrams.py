"""The paper's block diagrams (Fig. 1, 3 and 4), drawn anew with the sign convention of this package.

``python docs/diagrams.py folder`` writes them as SVG.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch

Point = tuple[float, float]
SOUND, SIGNAL, ADAPTATION = "#0072B2", "black", "#D55E00"  # through the air, in the controller, what adapts it
RADIUS = 0.16


def canvas(width: float, height: float) -> tuple[Figure, Axes]:
    """Axes whose unit is 0.8 inches, with nothing but the diagram."""
    figure, ax = plt.subplots(figsize=(0.8 * width, 0.8 * height), layout="constrained")
    ax.set(xlim=(0, width), ylim=(0, height), aspect="equal")
    ax.axis("off")
    return figure, ax


def box(ax: Axes, at: Point, text: str, color: str = SIGNAL, size: Point = (1.1, 0.66)) -> None:
    """A block around its centre."""
    (x, y), (width, height) = at, size
    corner = (x - width / 2, y - height / 2)
    ax.add_patch(FancyBboxPatch(corner, width, height, "round,pad=0,rounding_size=0.06", fc="white", ec=color, lw=1.4))
    ax.text(x, y, text, ha="center", va="center", color=color, fontsize=10)


def adder(ax: Axes, at: Point, signs: Sequence[tuple[str, float, float]], color: str = SIGNAL) -> None:
    """A sum, with the sign of each input at an offset from its centre."""
    ax.add_patch(Circle(at, RADIUS, fc="white", ec=color, lw=1.4))
    ax.text(*at, r"$\Sigma$", ha="center", va="center", fontsize=8, color=color)
    for sign, right, up in signs:
        ax.text(at[0] + right, at[1] + up, sign, ha="center", va="center", fontsize=11, color=color)


def wire(ax: Axes, *points: Point, color: str = SIGNAL, tip: bool = True, style: str = "-") -> None:
    """Straight pieces through points, with a tip at the last."""
    xs, ys = zip(*points, strict=True)
    ax.plot(xs, ys, color=color, lw=1.4, ls=style, solid_capstyle="round", zorder=0.5)
    if tip:
        (x0, y0), (x1, y1) = points[-2:]
        length = ((x1 - x0) ** 2 + (y1 - y0) ** 2) ** 0.5
        start = (x1 - 0.01 * (x1 - x0) / length, y1 - 0.01 * (y1 - y0) / length)
        ax.annotate(
            "", (x1, y1), start, arrowprops={"arrowstyle": "-|>", "color": color, "lw": 1.4, "shrinkA": 0, "shrinkB": 0}
        )


def dot(ax: Axes, *points: Point, color: str = SIGNAL) -> None:
    """Branches of a wire."""
    for x, y in points:
        ax.add_patch(Circle((x, y), 0.05, color=color))


def label(ax: Axes, at: Point, text: str, color: str = SIGNAL, **options: str) -> None:
    """A signal's name."""
    ax.text(*at, text, color=color, fontsize=10, **{"ha": "center", "va": "bottom"} | options)


def state_space_model() -> Figure:
    """Fig. 1: the state space model of eq. 1."""
    figure, ax = canvas(9.6, 2.9)
    wire(ax, (0.5, 1.9), (1.6 - RADIUS, 1.9))
    adder(ax, (1.6, 1.9), [("+", -0.3, 0.16), ("+", 0.18, -0.3)])
    wire(ax, (1.6 + RADIUS, 1.9), (5.4, 1.9))
    dot(ax, (4.2, 1.9))
    wire(ax, (4.2, 1.9), (4.2, 0.7), (3.45, 0.7))
    box(ax, (2.9, 0.7), r"$z^{-1}\,\mathbf{I}$")
    wire(ax, (2.35, 0.7), (1.6, 0.7), (1.6, 1.9 - RADIUS))
    box(ax, (6.0, 1.9), r"$\mathbf{x'}^T(n)$", size=(1.2, 0.66))
    wire(ax, (6.6, 1.9), (8.0 - RADIUS, 1.9))
    adder(ax, (8.0, 1.9), [("+", -0.3, 0.16), ("+", 0.18, 0.32)])
    wire(ax, (8.0, 2.8), (8.0, 1.9 + RADIUS))
    wire(ax, (8.0 + RADIUS, 1.9), (9.3, 1.9))
    label(ax, (0.8, 1.98), r"$\mathbf{v}(n)$")
    label(ax, (3.0, 1.98), r"$\mathbf{w}(n)$")
    label(ax, (1.05, 1.05), r"$\mathbf{w}(n-1)$")
    label(ax, (7.2, 1.98), r"$y'(n)$")
    label(ax, (8.42, 2.5), r"$e_o(n)$")
    label(ax, (8.9, 1.98), r"$d(n)$")
    ax.text(2.9, 0.12, "state equation (1a)", ha="center", fontsize=9, color="0.4")
    ax.text(7.2, 0.12, "observation equation (1b)", ha="center", fontsize=9, color="0.4")
    return figure


def _plant(ax: Axes, amplifier: bool) -> None:
    """What the figures 3 and 4 share: the sound, and the modified structure around the control filter."""
    wire(ax, (0.3, 5.4), (4.45, 5.4), color=SOUND)
    box(ax, (5.0, 5.4), "$P(z)$", SOUND)
    wire(ax, (5.55, 5.4), (9.2 - RADIUS, 5.4), color=SOUND)
    label(ax, (0.6, 5.46), "$x(n)$", SOUND)
    label(ax, (7.6, 5.46), "$d(n)$", SOUND)
    dot(ax, (1.1, 5.4), color=SOUND)
    wire(ax, (1.1, 5.4), (1.1, 4.1), (1.75, 4.1))
    box(ax, (2.3, 4.1), "$W(z)$", ADAPTATION)
    wire(ax, (2.85, 4.1), (3.95 if amplifier else 5.9, 4.1))
    if amplifier:
        box(ax, (4.5, 4.1), "amplifier")
        wire(ax, (5.05, 4.1), (5.9, 4.1))
        label(ax, (5.48, 4.16), "$y_{amp}$")
    label(ax, (3.28, 4.16), "$y(n)$")
    box(ax, (6.45, 4.1), "$S(z)$", SOUND)
    wire(ax, (7.0, 4.1), (9.2, 4.1), (9.2, 5.4 - RADIUS), color=SOUND)
    label(ax, (8.1, 4.16), "$y'(n)$", SOUND)
    adder(ax, (9.2, 5.4), [("+", -0.32, 0.16), ("−", 0.2, -0.34)], SOUND)
    wire(ax, (9.2 + RADIUS, 5.4), (10.9, 5.4), color=SOUND)
    label(ax, (10.3, 5.46), "$e(n) = d - y'$", SOUND)
    dot(ax, (10.0, 5.4), color=SOUND)
    # the estimate of the disturbance
    dot(ax, (3.28, 4.1))
    wire(ax, (3.28, 4.1), (3.28, 2.9), (5.9, 2.9))
    box(ax, (6.45, 2.9), r"$\hat{S}(z)$")
    wire(ax, (7.0, 2.9), (10.0 - RADIUS, 2.9))
    wire(ax, (10.0, 5.4), (10.0, 2.9 + RADIUS))
    adder(ax, (10.0, 2.9), [("+", -0.32, 0.16), ("+", 0.2, 0.34)])
    label(ax, (8.4, 2.96), r"$(\hat{s} * y)(n)$")
    # the filtered reference
    dot(ax, (1.1, 4.1))
    wire(ax, (1.1, 4.1), (1.1, 1.1), (1.75, 1.1))
    box(ax, (2.3, 1.1), r"$\hat{S}(z)$")


def _filter(ax: Axes, at: Point) -> None:
    """The Kalman filter, and its weights on their way to the control filter."""
    box(ax, at, "Kalman filter", ADAPTATION, (1.7, 0.8))
    wire(ax, (2.85, 1.1), (at[0] - 0.85, at[1]))
    label(ax, (3.5, 1.16), r"$\mathbf{x'}(n)$")
    wire(ax, (at[0], at[1] + 0.4), (at[0], 2.3), (2.3, 2.3), (2.3, 3.77), color=ADAPTATION, style="--")
    label(ax, (3.9, 2.34), r"$\hat{\mathbf{w}}(n|n)$", ADAPTATION)


def kalman_anc() -> Figure:
    """Fig. 3: active noise control with a Kalman filter."""
    figure, ax = canvas(11.2, 6.0)
    _plant(ax, amplifier=False)
    _filter(ax, (5.2, 1.1))
    wire(ax, (10.0, 2.9 - RADIUS), (10.0, 1.1), (6.05, 1.1))
    label(ax, (8.2, 1.16), r"$\hat{d}(n) = e + \hat{s} * y$")
    return figure


def kalman_opc() -> Figure:
    """Fig. 4: the same with the output power constraint, and the amplifier that it is for."""
    figure, ax = canvas(11.2, 6.0)
    _plant(ax, amplifier=True)
    _filter(ax, (5.2, 1.1))
    wire(ax, (10.0, 2.9 - RADIUS), (10.0, 1.1), (8.35, 1.1))
    box(ax, (7.9, 1.1), r"$\times\;\alpha$", ADAPTATION, (0.9, 0.66))
    wire(ax, (7.45, 1.1), (6.05, 1.1))
    label(ax, (9.25, 1.16), r"$\hat{d}(n)$")
    label(ax, (6.75, 1.16), r"$\alpha\,\hat{d}(n)$", ADAPTATION)
    label(ax, (7.9, 0.12), r"$\alpha = \min\{\sqrt{\rho_o G_s / \delta_d^2},\, 1\}$", ADAPTATION)
    wire(ax, (7.9, 0.52), (7.9, 0.77), color=ADAPTATION)
    return figure


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for draw in (state_space_model, kalman_anc, kalman_opc):
        draw().savefig(folder / f"{draw.__name__}.svg")
