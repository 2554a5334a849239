"""What may change in a noise, a path or a microphone during a run: one list for the study and the benchmark."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from kfopc_filterpy import Plant

SignalChange = Callable[[np.ndarray, int, float], np.ndarray]  # of a signal (n_samples,), at a sample, at a sample rate


def _same(signal: np.ndarray, at: int, fs: float) -> np.ndarray:
    return signal


@dataclass(frozen=True)
class Change:
    """How each signal and path changes; by default, nothing does."""

    noise: SignalChange = _same  # the noise itself
    reference: SignalChange = _same  # as the reference microphone delivers it
    disturbance: SignalChange = _same  # what the primary path makes of the noise
    secondary: Callable[[np.ndarray], np.ndarray] | None = None  # taps along the last axis
    limit: float = np.inf  # at which the error microphone clips, over the rms of the disturbance
    lasting_s: float = 0.0

    def plant(self, plant: Plant, at_s: float) -> Plant:
        """Return a plant whose secondary path changes at a time."""
        return plant if self.secondary is None else plant.changed_at(at_s, secondary=self.secondary(plant.secondary))


def _then(change: Callable[[np.ndarray], np.ndarray]) -> SignalChange:
    """Return a function that changes a signal from the event on."""
    return lambda signal, at, fs: np.concatenate([signal[:at], change(signal)[at : signal.size]])


def _late(taps: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda s: np.concatenate([np.zeros((*s.shape[:-1], taps)), s], axis=-1)


def _drifting(rate: float) -> SignalChange:
    """Return a function whose delay grows by a rate in samples a second."""

    def drift(d: np.ndarray, at: int, fs: float) -> np.ndarray:
        t = np.arange(d.size)
        delayed: np.ndarray = CubicSpline(t, d)(t - rate * np.maximum(t - at, 0) / fs)
        return delayed

    return drift


def _dead(lasting_s: float) -> Change:
    def silent(x: np.ndarray, at: int, fs: float) -> np.ndarray:
        t = np.arange(x.size) - at
        return np.where((t < 0) | (t >= round(lasting_s * fs)), x, 0.0)

    return Change(reference=silent, lasting_s=lasting_s)


def _click(x: np.ndarray, at: int, fs: float) -> np.ndarray:
    clicked = x.copy()
    clicked[at] = 1e4 * np.sqrt(np.mean(x**2))
    return clicked


def _joined(louder_db: float, lasting_s: float) -> Change:
    """Return a change in which a noise joins that the reference does not know."""

    def join(d: np.ndarray, at: int, fs: float) -> np.ndarray:
        n = min(round(lasting_s * fs), d.size - at)
        other = np.zeros(d.size)
        other[at : at + n] = np.random.default_rng(at).standard_normal(n)
        return d + 10 ** (louder_db / 20) * np.sqrt(np.mean(d**2)) * other

    return Change(disturbance=join, lasting_s=lasting_s)


def _faded(level: float, fade_s: float = 0.0) -> SignalChange:
    """Return a function that makes a signal soft before the event, with a fade in up to it."""

    def soft(x: np.ndarray, at: int, fs: float) -> np.ndarray:
        missing = np.clip((at - np.arange(x.size)) / max(fade_s * fs, 1.0), 0.0, 1.0)
        return x * level**missing

    return soft


CHANGES: dict[str, Change] = {
    "nothing": Change(),
    "primary path's sign": Change(disturbance=_then(np.negative)),
    "primary path 5 samples late": Change(disturbance=_then(_late(5))),
    "secondary path's sign": Change(secondary=np.negative),
    "secondary path 2 samples late": Change(secondary=_late(2)),
    "secondary path 6 dB louder": Change(secondary=lambda s: 2.0 * s),
    "secondary path 6 dB softer": Change(secondary=lambda s: 0.5 * s),
    "noise 12 dB softer": Change(noise=_then(lambda x: 10**-0.6 * x)),
    "noise 12 dB louder": Change(noise=_then(lambda x: 10**0.6 * x)),
    **{f"reference dead for {lasting_s:g} s": _dead(lasting_s) for lasting_s in (1.0, 10.0)},
    "another noise, 30 dB louder, for 1 s": _joined(30.0, 1.0),
    "a reference sample of 1e4": Change(reference=_click),
    **{f"soft past, {level}": Change(noise=_faded(float(level))) for level in ("1e-3", "1e-6")},
    "fades in over 4 s from 1e-4": Change(noise=_faded(1e-4, 4.0)),
    **{f"drift of {100 * rate:g} % of a sample a second": Change(disturbance=_drifting(rate)) for rate in (0.02, 0.2)},
    "seams of a recording": Change(noise=lambda x, at, fs: np.resize(x[:at], x.size)),
    **{f"microphone clips at {limit:g}": Change(limit=limit) for limit in (0.1, 0.5)},
}
