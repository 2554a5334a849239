"""How the controllers of an assessment are made, tuned and run, for one channel or several."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

from kfopc_filterpy import FxLMS, OutputPowerConstraint, SimulationResult, kf_opc, kf_pb, simulate
from kfopc_filterpy.bounds import SuggestedSettings
from kfopc_filterpy.controllers import with_internal_model

from .._types import ProgressBar
from .limits import ChannelLimits, Limits, amplifiers, clipping_limits, each_of, scaled
from .registry import REGISTRY
from .scene import Runs, Scene
from .tuning import AllDivergedError, tune

ALGORITHMS = ("KF-PB", "KF-OPC", "FxLMS")
NSE_WINDOW_S = 0.1  # of the figures that are drawn beside the time of convergence
TUNED_ON_S = 5.0  # of the record, for FxLMS's step size


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

    def outcome(self, name: str, limited: bool) -> SimulationResult | AllDivergedError:
        """Return an algorithm's run, or why there is none."""
        try:
            return self.run(name, limited=limited)
        except AllDivergedError as error:
            return error

    def planned_samples(self, name: str) -> int:
        """Return how many samples an algorithm runs over, its tuning included."""
        tuned_on = len(REGISTRY[name].grid) * self.tuning_samples if name == "FxLMS" else 0
        return tuned_on + self.x.shape[-1] - self.start

    def advance(self, samples: int) -> None:
        """Move the bar, which several threads share."""
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
            progress=None if self.bar is None else self.advance,
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
        """Return the step size of FxLMS by the rule of the studies, on the start of the record."""
        excerpt = slice(0, self.start + self.tuning_samples)
        scene = recorded_scene(
            self.x[..., excerpt], self.d[..., excerpt], self.s, self.fs, self.start, limits, self.settings
        )
        in_samples: Any = SimpleNamespace(update=lambda runs: self.advance(runs * self.tuning_samples))
        runs = Runs(None if self.bar is None else in_samples)
        return REGISTRY["FxLMS"].value(scene, tune(runs, scene, ["FxLMS"])["FxLMS"].setting)


def recorded_scene(
    x: np.ndarray,
    d: np.ndarray,
    s: np.ndarray,
    fs: float,
    start: int,
    limits: Limits,
    settings: SuggestedSettings,
    unconstrained_power: float = 1.0,
) -> Scene:
    """Return a scene of recorded signals as they are, the control switched on at sample `start`."""
    return Scene(
        fs=fs,
        secondary=s,
        references=[x],
        disturbances=[d],
        rated_power=limits.rated_power,
        n_taps=settings.n_taps,
        sensor_noise_std=0.0,
        switch_on_s=start / fs,
        nse_window_s=NSE_WINDOW_S,
        amplifier=amplifiers(limits),
        measurement_noise=settings.measurement_noise,
        initial_variance=settings.initial_variance,
        unconstrained_power=unconstrained_power,
        seeds=[0],
        clips_at=clipping_limits(limits),
    )


def announce(bar: ProgressBar | None, samples: int, description: str) -> None:
    """Add samples to a bar's total, and say what begins."""
    if bar is not None:
        bar.total = (bar.total or 0) + samples
        bar.set_description(description)
