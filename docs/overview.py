"""The first figure of the README and of these pages: a noise that gets too loud for its amplifier.

``python docs/overview.py docs/figures/overview.png`` draws it and prints its numbers. It needs the measured data, which
it fetches as the studies do.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from comparisons.bench.measured import load_measured_duct
from kfopc_filterpy import (
    HardClipAmplifier,
    Plant,
    kf_anc,
    kf_opc,
    kf_pb,
    power_constrained_wiener,
    simulate,
)
from kfopc_filterpy.bounds import WienerSolution, wiener_solution
from kfopc_filterpy.plot import curve_style

FS, TAPS, SWITCH_ON_S = 16000.0, 256, 0.5
CLIP = 3.0  # times the root of the rated power; at 2, the clipped peaks of the compressor would cost KF-PB up to 12 dB
LEVELS_DB = tuple(float(level) for level in np.arange(-3.0, 12.1, 1.5))
ALGORITHMS = ("KF-ANC", "KF-OPC", "KF-PB")
SAID = {"KF-ANC": "plain Kalman filter", "KF-OPC": "KF-OPC", "KF-PB": "KF-PB"}


@dataclass(frozen=True)
class Overload:
    """The compressor and the duct of the paper's first author; the amplifier clips at thrice the root of its rated power.

    Only the ratio of noise and rated power matters. So the noise stays as it is, and the amplifier gets smaller.
    """

    duration_s: float = 17.0  # of the recording's 17.5 s; KF-PB keeps the power as a mean over ten

    @cached_property
    def duct(self) -> Plant:
        """The duct with a linear amplifier."""
        measured = load_measured_duct("compressor", "author")
        return Plant(measured.secondary, measured.primary, fs=FS)

    @cached_property
    def x(self) -> np.ndarray:
        """Reference."""
        noise = load_measured_duct("compressor", "author").noise[: int(self.duration_s * FS)]
        return (noise - noise.mean()) / np.std(noise)

    @cached_property
    def full_control(self) -> WienerSolution:
        """The best fixed filter without a constraint; its power is the rated power of 0 dB."""
        x, d = (signal[int(SWITCH_ON_S * FS) :] for signal in (self.x, self.duct.disturbance(self.x)))
        return wiener_solution(x, self.duct, n_taps=TAPS, disturbance=d)

    def rated_power(self, level_db: float) -> float:
        """Rated power that the noise exceeds by a level."""
        return self.full_control.control_power / 10 ** (level_db / 10)

    @property
    def settings(self) -> dict[str, float]:
        """Settings of KF-ANC and KF-OPC: those of the tutorial on the constraint factor."""
        q = 1e-3 * self.full_control.disturbance_power
        variance = self.full_control.control_power / (TAPS * np.mean(self.x**2))
        return {"state_noise": 1e-8 * q, "measurement_noise": q, "initial_variance": float(variance)}

    def run(self, algorithm: str, level_db: float) -> tuple[float, float]:
        """Noise reduction in dB, and power of the control signal over the rated power, in the second half of a run."""
        rated = self.rated_power(level_db)
        plant = Plant(self.duct.secondary, self.duct.primary, amplifier=HardClipAmplifier(CLIP * rated**0.5), fs=FS)
        if algorithm == "KF-ANC":
            controller = kf_anc(TAPS, plant, **self.settings)
        elif algorithm == "KF-OPC":
            controller = kf_opc(TAPS, plant, rated_power=rated, **self.settings)
        else:
            controller = kf_pb(TAPS, plant, rated_power=rated)
        run = simulate(controller, self.x, plant, switch_on_s=SWITCH_ON_S)
        return run.noise_reduction_db, float(run.output_power) / rated

    def bound(self, level_db: float) -> float:
        """Noise reduction in dB of the best fixed filter within the rated power, in the second half of the run."""
        ridge = self.settings["measurement_noise"] / (self.x.size * self.settings["initial_variance"])
        rated = self.rated_power(level_db)
        best = power_constrained_wiener(
            self.x, self.duct, n_taps=TAPS, rated_power=rated, switch_on_s=SWITCH_ON_S, ridge=ridge
        )
        return float(best.noise_reduction_over(0.5 * best.whole.end_s)["whole"])


def draw(levels_db: Sequence[float], runs: dict[str, np.ndarray], bounds: Sequence[float]) -> Figure:
    """Noise reduction and power over the level of the noise; `runs` holds two rows for each algorithm."""
    with plt.rc_context({"font.size": 11.5}):
        figure, (left, right) = plt.subplots(1, 2, figsize=(7.8, 3.8), sharex=True, layout="constrained")
        left.plot(levels_db, bounds, color="0.78", lw=6, solid_capstyle="round", label="most within rated power")
        for name in ALGORITHMS:
            for ax, values in zip((left, right), runs[name], strict=True):
                ax.plot(levels_db, values, **curve_style(name), lw=2, ms=6, zorder=3, label=SAID[name])
        for name, height in (("KF-OPC", 3.0), ("KF-PB", 0.33)):
            text = f"{runs[name][1, -1]:.2f} times"
            right.text(11.8, height, text, color=curve_style(name)["color"], weight="bold", ha="right", va="center")
        left.axhline(0, color="0.5", lw=1)
        right.axhline(1, color="k", ls=":")
        left.set(title="Noise reduction (dB)", ylim=(-4, 32))
        right.set(title="Power asked for / rated power", yscale="log", ylim=(0.12, 3e3))  # the plain filter leaves it
        for ax in (left, right):
            ends = min(levels_db) - 0.5, max(levels_db) + 0.5  # whole markers
            ax.axvspan(0, ends[1], color="#D55E00", alpha=0.06, lw=0)
            ax.set(xlim=ends, xticks=(-3, 0, 3, 6, 9, 12))
            ax.grid(alpha=0.3)
        figure.supxlabel("Noise level (dB over what the rated power can cancel)", fontsize=11.5)
        handles, labels = left.get_legend_handles_labels()
        order = {"ncols": 4, "columnspacing": 1.2, "handletextpad": 0.5, "frameon": False}
        figure.legend(handles[1:] + handles[:1], labels[1:] + labels[:1], loc="outside upper center", **order)
    return figure


if __name__ == "__main__":
    overload = Overload()
    found = {name: np.transpose([overload.run(name, level) for level in LEVELS_DB]) for name in ALGORITHMS}
    limits = [overload.bound(level) for level in LEVELS_DB]
    for k, level_db in enumerate(LEVELS_DB):
        told = (
            f"{name} {found[name][0, k]:.1f} dB at {found[name][1, k]:.2f} of the rated power" for name in ALGORITHMS
        )
        print(f"{level_db:5.1f} dB: bound {limits[k]:.1f} dB; {'; '.join(told)}")
    draw(LEVELS_DB, found, limits).savefig(sys.argv[1], dpi=180)
