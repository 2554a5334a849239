"""How the controllers of an assessment are made, tuned and run, for one channel or several."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.signal import fftconvolve
from threadpoolctl import threadpool_limits

from kfopc_filterpy import FxLMS, OutputPowerConstraint, SimulationResult, kf_opc, kf_pb, nse_db, simulate
from kfopc_filterpy.bounds import SuggestedSettings
from kfopc_filterpy.controllers import with_internal_model

from .._types import ProgressBar
from .limits import ChannelLimits, Limits, amplifiers, each_of, scaled

ALGORITHMS = ("KF-PB", "KF-OPC", "FxLMS")
NSE_WINDOW_S = 0.1  # of the figures that are drawn beside the time of convergence
TUNED_ON_S = 5.0  # of the record, for FxLMS's step size
# Step sizes that are tried, over the taps and the power of the filtered reference. From twice the largest on, gradient
# descent diverges on any noise; with the smallest it learns for some 10^4 samples per tap.
STEP_SIZES = tuple((2.0 ** -np.arange(1.0, 15.0)).tolist())


class AllDivergedError(RuntimeError):
    """No setting that was tried is stable."""


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Give numpy's and scipy's BLAS one thread.

    A filter of some hundred taps gains nothing from more, and the threads of several runs get in each other's way.
    """
    with threadpool_limits(1, user_api="blas"):
        yield


def filtered_power(x: np.ndarray, s: np.ndarray) -> float:
    """Return the power of the filtered reference; it makes step sizes and state noises comparable.

    With several channels, it is summed over microphones and references, and averaged over loudspeakers.
    """
    x, s = np.atleast_2d(x), s if s.ndim == 3 else s.reshape(1, 1, -1)
    filtered = fftconvolve(x[np.newaxis, np.newaxis], s[:, :, np.newaxis], axes=-1)[..., : x.shape[1]]
    return float(np.mean(filtered**2, axis=(1, 3)).sum())


@dataclass
class Plan:
    """How the controllers of an assessment are made and run."""

    x: np.ndarray
    d: np.ndarray
    s: np.ndarray
    fs: float
    start: int
    limits: Limits
    settings: SuggestedSettings
    uncertainty: Any
    bar: Any
    feedback: bool = False  # the last references are then what an exact internal model gives
    lock: Any = field(default_factory=threading.Lock)

    def outcomes(self, names: list[str]) -> list[SimulationResult | AllDivergedError]:
        """Return the run of each algorithm, or why there is none; the first one is behind a limiter."""

        def outcome(name: str) -> SimulationResult | AllDivergedError:
            try:
                return self.run(name, limited=name == names[0])
            except AllDivergedError as error:
                return error

        # Threads are enough, because the compiled loop releases Python's global interpreter lock.
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            return list(pool.map(outcome, names))

    def planned_samples(self, name: str) -> int:
        """Return how many samples an algorithm runs over, its tuning included."""
        tuned_on = len(STEP_SIZES) * self.tuning_samples if name == "FxLMS" else 0
        return tuned_on + self.x.shape[-1] - self.start

    def advance(self, samples: int) -> None:
        """Move the bar, if there is one; several threads share it."""
        if self.bar is not None:
            with self.lock:
                self.bar.update(samples)

    def run(self, name: str, *, limited: bool, share: float = 1.0) -> SimulationResult:
        """Run an algorithm, behind a limiter or not, with a share of the rating's power."""
        limits = scaled(self.limits, share)
        controller = self.controller(name, limits, limited)
        heard: Any = self.x
        if self.feedback:
            controller = with_internal_model(controller)
            heard = np.atleast_2d(self.x)[: controller.n_references] if controller.n_references else None
        return simulate(
            controller,
            heard,
            disturbance=self.d,
            secondary_path=self.s,
            fs=self.fs,
            amplifier=amplifiers(limits),
            rated_power=limits.rated_power,
            switch_on_s=self.start / self.fs,
            record_weights_every=self.x.shape[-1] - self.start - 1 if self.feedback else None,  # the first and the last
            progress=self.advance,
        )

    def controller(self, name: str, limits: Limits, limited: bool) -> Any:
        """Return a fresh controller."""
        limiter = limits.limiter(self.fs) if limited else None
        n_taps = self.settings.n_taps
        several = isinstance(limits, ChannelLimits)
        outside: dict[str, Any] = {"limiter": limiter}
        if several:
            outside["n_references"] = len(self.x)
        noises: dict[str, Any] = self.settings.settings
        if name == "FxLMS":
            return FxLMS(n_taps, self.s, step_size=self.step_size(limits), **outside)
        if name == "KF-OPC":
            each = [OutputPowerConstraint(one.rated_power, fs=self.fs) for one in each_of(limits)]
            return kf_opc(n_taps, self.s, constraint=each if several else each[0], **outside, **noises)
        return kf_pb(
            n_taps,
            self.s,
            rated_power=limits.rated_power,
            fs=self.fs,
            secondary_path_uncertainty=self.uncertainty,
            **outside,
        )

    @property
    def tuning_samples(self) -> int:
        """Samples of the record's start on which each step size is tried."""
        return min(round(TUNED_ON_S * self.fs), self.x.shape[-1] - self.start)

    def step_size(self, limits: Limits) -> float:
        """Return the step size of FxLMS with the lowest mean NSE over the start of the record, among the stable ones.

        Errors that agree to 0.01 dB are a tie, which goes to the smaller step.
        """
        x, d = (one[..., : self.start + self.tuning_samples] for one in (self.x, self.d))
        unit = self.settings.n_taps * filtered_power(x, self.s)
        several: dict[str, Any] = {"n_references": len(x)} if isinstance(limits, ChannelLimits) else {}

        def error_db(step: float) -> float:
            run = simulate(
                FxLMS(self.settings.n_taps, self.s, step_size=step / unit, **several),
                x,
                disturbance=d,
                secondary_path=self.s,
                fs=self.fs,
                amplifier=amplifiers(limits),
                rated_power=limits.rated_power,
                switch_on_s=self.start / self.fs,
            )
            self.advance(self.tuning_samples)
            if run.diverged_at_s is not None:
                return np.inf
            # There is no NSE until the first sound has passed the primary path.
            return round(float(np.nanmean(nse_db(run.error, run.disturbance, self.fs, NSE_WINDOW_S))), 2)

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            least, best = min(zip(pool.map(error_db, STEP_SIZES), STEP_SIZES, strict=True))
        if least == np.inf:
            raise AllDivergedError(f"FxLMS diverged with every step size tried: {[step / unit for step in STEP_SIZES]}")
        return best / unit


def announce(bar: ProgressBar | None, samples: int, description: str) -> None:
    """Add samples to a bar's total, and say what begins."""
    if bar is not None:
        bar.total = (bar.total or 0) + samples
        bar.set_description(description)
