"""How the controllers of an assessment are made, tuned and run, for one channel or several."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from kfopc_filterpy import Plant, SimulationResult, simulate
from kfopc_filterpy.bounds import SuggestedSettings
from kfopc_filterpy.controllers import with_internal_model
from kfopc_filterpy.controllers.table import CORE
from kfopc_filterpy.metrics import nse_db

from .._types import ProgressBar
from .candidates import CANDIDATES, Known, Settings, filtered_power
from .limits import Limits

NSE_WINDOW_S = 0.1  # of the figures that are drawn beside the time of convergence
TUNED_ON_S = 5.0  # of the record, if there are several settings to try


class AllDivergedError(RuntimeError):
    """No setting that was tried is stable."""


def refused_in_a_run(error: ValueError) -> bool:
    """Return whether a controller refused to go on in a run, as FxRLS may, not to be made."""
    return any(note.startswith("in sample") for note in getattr(error, "__notes__", ()))


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Give numpy's and scipy's BLAS one thread.

    A filter of some hundred taps gains nothing from more, and the threads of several runs get in each other's way.
    """
    with threadpool_limits(1, user_api="blas"):
        yield


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
    chosen: dict[str, Settings] = field(default_factory=dict)  # with which each algorithm ran at the whole rating

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
        tried = len(self.candidates(name, self.limits))
        return (tried * self.tuning_samples if tried > 1 else 0) + self.x.shape[-1] - self.start

    def advance(self, samples: int) -> None:
        """Move the bar, if there is one; several threads share it."""
        if self.bar is not None:
            with self.lock:
                self.bar.update(samples)

    def run(self, name: str, *, limited: bool, share: float = 1.0) -> SimulationResult:
        """Run an algorithm with its best setting, behind a limiter or not, with a share of the rating's power."""
        limits = self.limits.scaled(share)
        limiter, best = limits.limiter(self.fs) if limited else None, self.best(name, limits)
        if share == 1.0:
            self.chosen[name] = best
        controller = self.controller(name, best, limiter=limiter)
        heard: Any = self.x
        if self.feedback:
            controller = with_internal_model(controller)
            heard = np.atleast_2d(self.x)[: controller.n_references] if controller.n_references else None
        first_and_last = self.x.shape[-1] - self.start - 1 if self.feedback else None
        try:
            return self.simulated(
                controller, heard, self.d, limits, record_weights_every=first_and_last, progress=self.advance
            )
        except ValueError as error:
            if not refused_in_a_run(error):
                raise
            raise AllDivergedError(f"{name} could not go on: {error}") from error

    def simulated(self, controller: Any, x: Any, d: np.ndarray, limits: Limits, **options: Any) -> SimulationResult:
        """Return the run of a controller on references and disturbances."""
        return simulate(
            controller,
            x,
            Plant(self.s, amplifier=limits.amplifier(), fs=self.fs),
            disturbance=d,
            switch_on_s=self.start / self.fs,
            **options,
        )

    def controller(self, name: str, settings: Settings, **options: Any) -> Any:
        """Return a fresh controller."""
        if self.limits.several:
            options["n_references"] = len(self.x)
        return CORE[name](self.settings.n_taps, self.s, **settings, **options)

    @property
    def tuning_samples(self) -> int:
        """Samples of the record's start on which each setting is tried, from the switch-on."""
        return min(round(TUNED_ON_S * self.fs), self.x.shape[-1] - self.start)

    @cached_property
    def excerpt(self) -> tuple[np.ndarray, np.ndarray]:
        """References and disturbances on which settings are tried."""
        end = self.start + self.tuning_samples
        return self.x[..., :end], self.d[..., :end]

    @cached_property
    def powers(self) -> tuple[float, float]:
        """Power of the reference and of the filtered reference, in the excerpt."""
        x = np.atleast_2d(self.excerpt[0])
        return float(np.mean(x**2, axis=-1).sum()), filtered_power(x, self.s)

    def candidates(self, name: str, limits: Limits) -> list[Settings]:
        """Return the settings to try for an algorithm."""
        return CANDIDATES[name](Known(self.fs, limits, self.settings, self.uncertainty, *self.powers))

    def best(self, name: str, limits: Limits) -> Settings:
        """Return the setting with the lowest mean NSE over the start of the record, among those that do not diverge.

        Errors that agree to 0.01 dB are a tie, which goes to the smaller setting.
        """
        tried, (x, d) = self.candidates(name, limits), self.excerpt
        if len(tried) == 1:
            return tried[0]

        def error_db(settings: Settings) -> float:
            try:
                run = self.simulated(self.controller(name, settings), x, d, limits)
            except ValueError as error:
                if not refused_in_a_run(error):
                    raise
                return np.inf
            finally:
                self.advance(self.tuning_samples)  # at once, because a run that diverges ends early
            if run.diverged_at_s is not None:
                return np.inf
            # There is no NSE until the first sound has passed the primary path.
            return round(float(np.nanmean(nse_db(run.error, run.disturbance, self.fs, NSE_WINDOW_S))), 2)

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            errors = list(pool.map(error_db, tried))
        if min(errors) == np.inf:
            raise AllDivergedError(f"{name} diverged with every setting tried: {tried}")
        return tried[int(np.argmin(errors))]


def announce(bar: ProgressBar | None, samples: int, description: str) -> None:
    """Add samples to a bar's total, and say what begins."""
    if bar is not None:
        bar.total = (bar.total or 0) + samples
        bar.set_description(description)
