"""A monitor for any controller: if the noise is louder with control than without, the loudspeakers are muted."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._validate import as_channels, as_nonnegative, as_number, as_positive, as_sample_count
from ..power.constraint import DEFAULT_FS
from .base import Controller, WrappedController
from .channel_samples import channel_sample

LONGEST_PAUSE = 64.0  # of the first pause
WIDEST_MARGIN = 8.0  # of the first margin


@dataclass(frozen=True)
class HealthEvent:
    """Something that a monitor noticed.

    Attributes
    ----------
    time_s : float
        Time of the event, in seconds since the first sample.
    what : str
        "louder": the control made the noise louder and was stopped; "not louder": the control was suspected wrongly and
        goes on; "not finite": the control signal was NaN or Inf, and the control was stopped; "retry": the control
        starts anew.
    change_db : float
        How much louder the noise was with control than without, in dB; NaN if that was not measured.
    """

    time_s: float
    what: str
    change_db: float = np.nan


class Recent:
    """The newest samples of one channel or several, up to a number of them."""

    def __init__(self, most: int) -> None:
        self._most, self._count = most, 0
        self._samples = np.empty(0)  # a ring, (most, channels)

    def add(self, sample: Any) -> None:
        """Add a sample, a number or (channels,)."""
        if self._count == 0:
            # Zeros: a file must not hold what happened to be in memory.
            self._samples = np.zeros((self._most, *np.shape(sample)))
        self._samples[self._count % self._most] = sample
        self._count += 1

    @property
    def samples(self) -> np.ndarray:
        """The samples in order of time, (n,) or (channels, n)."""
        if self._count < self._most:
            return self._samples[: self._count].T
        return np.roll(self._samples, -self._count, axis=0).T

    def clear(self) -> None:
        """Forget all samples."""
        self._count = 0


class MonitoredController(WrappedController):
    """A controller with a monitor that mutes the loudspeakers if the control makes the noise louder.

    A secondary path with a flipped sign, or a delay that is wrong by several samples, makes the noise louder with any
    controller. The controller's own estimates do not show this, because they rely on the same path. So the monitor
    compares the power of the error, relative to that of the reference, with what it was while the loudspeakers were
    silent. If it exceeds that by `margin_db`, the loudspeakers are muted for `window_s`. The control is to blame if
    this lowers the power by more than half the margin. It is then replaced by a fresh copy, which starts after a pause,
    and each further failure doubles the pause. Otherwise the control goes on, and the margin is widened by half, up to
    eight times the first one, because the noise evidently fluctuates. A window in which reference or error is silent
    decides nothing.

    A copy keeps the limiter, and the secondary path, its uncertainty and the rated power that were assigned to the
    monitor. What was changed inside the controller is lost.

    Parameters
    ----------
    controller : Controller
        Any controller that can be copied and has not processed a sample yet. While muted, it follows the noise if it
        has a method ``listen(references, errors)``, as the built-in ones have.
    fs : float, default 16000
        Sample rate in Hz.
    window_s : float, default 0.5
        Time over which powers are compared, in seconds. Control begins after a window of silence, unless `listen` has
        already been given at least that much.
    margin_db : float, default 1.5
        Rise of this relative power of the error, in dB, that causes a test.
    pause_s : float, default 2
        First pause after a failure, in seconds.

    Attributes
    ----------
    health : list of HealthEvent
        What was noticed, in order of time.
    muted : bool
        Whether the loudspeakers are muted now.

    Raises
    ------
    TypeError, ValueError
        An object that is not a controller, a time or margin out of range.

    Notes
    -----
    The monitor is stepped from Python, which `simulate` does for any object with these methods.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import kf_anc, simulate
    >>> from kfopc_filterpy.controllers import MonitoredController
    >>> path = np.array([0.0, 1.0, 0.4])
    >>> controller = kf_anc(8, -path, state_noise=1e-8, measurement_noise=1e-3)  # wrong sign
    >>> monitored = MonitoredController(controller, fs=2000.0)
    >>> x = np.random.default_rng(0).standard_normal(6000)
    >>> result = simulate(monitored, x, primary_path=[0.0, 0.0, 0.5], secondary_path=path, fs=2000.0)
    >>> [event.what for event in monitored.health], monitored.muted
    (['louder'], True)
    """

    def __init__(
        self,
        controller: Controller,
        *,
        fs: float = DEFAULT_FS,
        window_s: float = 0.5,
        margin_db: float = 1.5,
        pause_s: float = 2.0,
    ) -> None:
        super().__init__(controller)
        self.fs = as_positive(fs, "fs", unit="Hz")
        self._window = as_sample_count(window_s, fs, "window_s")
        self._pause = self._first_pause = as_sample_count(pause_s, fs, "pause_s")
        self.margin_db = as_nonnegative(margin_db, "margin_db", unit="dB")
        self._widest_margin_db = WIDEST_MARGIN * self.margin_db
        self.name = f"{getattr(controller, 'name', type(controller).__name__)} monitored"
        self.health: list[HealthEvent] = []
        self._fresh = deepcopy(controller)  # with which it tries again
        self._samples = 0
        self._silent_ratio = np.nan  # power of the error over that of the reference, without control
        self._suspicious_ratio = np.nan  # the same with control, while a test is under way
        self._muted_for = self._window  # samples left of a silence
        self._after_silence = "learn"  # or "judge" or "retry": which decision follows the silence
        self._references, self._errors = Recent(self._window), Recent(self._window)
        self._begin_window()

    @property
    def muted(self) -> bool:
        """Whether the loudspeakers are muted now."""
        return self._muted_for > 0

    def __repr__(self) -> str:
        return f"<{self.name}: {'muted' if self.muted else 'running'}, {len(self.health)} events>"

    def _rates(self) -> dict[str, float | None]:
        return {"monitor": self.fs}

    def _pass_on(self, name: str, value: Any) -> None:
        super()._pass_on(name, value)
        if name != "limiter":  # the copy that takes over after a silence gets the limiter in use
            setattr(self._fresh, name, value)

    def _sample(self, value: Any, name: str, what: str) -> Any:
        """Return a checked sample of the references or of the microphones. While muted, nobody else checks it."""
        several = getattr(self.controller, "multichannel", None)  # None: not known of a user's controller
        if hasattr(self.controller, "physical"):  # it checks the microphones that exist, and needs no others
            return value
        if several:
            value = channel_sample(value, getattr(self.controller, f"n_{what}"), name, what)
        elif several is False or np.ndim(value) == 0:
            value = as_number(value, name)
        with np.errstate(over="ignore"):
            if not np.isfinite(np.sum(np.square(value))):
                raise ValueError(f"{name} must be finite and have a finite square, got {value}: nothing was changed")
        return value

    def control_signal(self, reference: Any) -> Any:
        """Return the control signal y(n) for the newest `reference` x(n), or silence."""
        self._newest = self._sample(reference, "reference", "references")
        if not self.muted:
            y = self.controller.control_signal(self._newest)
            if np.all(np.isfinite(y)):
                return y
            self._note("not finite")
            self._stop()
        return self._silence()

    def update(self, error: Any) -> None:
        """Pass the `error` e(n) on to the controller, and compare powers at the end of a window."""
        error = self._sample(error, "error", "microphones")
        if self.muted:
            self._references.add(self._newest)
            self._errors.add(error)
        else:
            self.controller.update(error)
        self._samples += 1
        self._reference_energy += float(np.sum(np.square(self._newest)))
        self._error_energy += float(np.nansum(np.square(error)))  # NaN: a microphone that does not exist
        self._counted += 1
        if self.muted:
            self._muted_for -= 1
            if not self.muted:
                self._end_silence()
        elif self._counted >= self._window:
            self._compare()

    def listen(self, references: Any, errors: Any) -> None:
        """Follow `references` and `errors` before the control is switched on, with silent output."""
        x, e = as_channels(references, "references"), as_channels(errors, "errors")
        self._follow(x, e)
        if x.shape[-1] >= self._window:
            self._learn(_ratio(float(np.sum(e**2)), float(np.sum(x**2))))
            if self._after_silence == "learn":  # not during a pause after a failure
                self._muted_for = 0
        self._begin_window()

    # ---- The decisions, each at the end of a window

    def _compare(self) -> None:
        """Mute for a test if the error is louder than in silence, or if that is not known yet."""
        ratio = _ratio(self._error_energy, self._reference_energy)
        self._begin_window()
        if np.isfinite(ratio) and not _change_db(ratio, self._silent_ratio) <= self.margin_db:  # NaN: not known yet
            self._suspicious_ratio = ratio
            self._muted_for, self._after_silence = self._window, "judge"

    def _judge(self, ratio: float) -> None:
        """Stop the control if the noise is quieter without it."""
        change_db = _change_db(self._suspicious_ratio, ratio)
        if change_db > 0.5 * self.margin_db:
            self._note("louder", change_db)
            self._stop()
        elif np.isfinite(change_db):
            self._note("not louder", change_db)
            self.margin_db = max(self.margin_db, min(1.5 * self.margin_db, self._widest_margin_db))
        self._learn(ratio)

    def _learn(self, ratio: float) -> None:
        """Take over the ratio of powers that was measured in silence, if there was anything to measure."""
        if np.isfinite(ratio):
            self._silent_ratio = ratio

    def _stop(self) -> None:
        """Start a pause, after which a fresh controller begins, behind the same limiter: that knows what was played."""
        before, self.controller = self.controller, deepcopy(self._fresh)
        if hasattr(before, "limiter"):
            self.controller.limiter = before.limiter  # type: ignore[attr-defined]
        self._muted_for, self._after_silence = self._pause, "retry"
        self._pause = min(2 * self._pause, round(LONGEST_PAUSE * self._first_pause))
        self._references.clear()
        self._errors.clear()
        self._begin_window()

    def _retry(self, ratio: float) -> None:
        self._learn(ratio)
        self._note("retry")

    # ---- Silence

    def _end_silence(self) -> None:
        """Let the controller follow what was heard in silence, and decide."""
        heard = self._references.samples, self._errors.samples
        ratio = _ratio(self._error_energy, self._reference_energy)
        self._references.clear()
        self._errors.clear()
        self._begin_window()
        self._follow(*heard)
        {"learn": self._learn, "judge": self._judge, "retry": self._retry}[self._after_silence](ratio)

    def _follow(self, references: np.ndarray, errors: np.ndarray) -> None:
        listen = getattr(self.controller, "listen", None)
        if listen is not None:
            listen(references, errors)

    def _silence(self) -> Any:
        loudspeakers = getattr(self.controller, "n_loudspeakers", 1)
        return np.zeros(loudspeakers) if getattr(self.controller, "multichannel", False) else 0.0

    def _begin_window(self) -> None:
        self._reference_energy = self._error_energy = 0.0
        self._counted = 0

    def _note(self, what: str, change_db: float = np.nan) -> None:
        self.health.append(HealthEvent(self._samples / self.fs, what, change_db))


def _ratio(above: float, below: float) -> float:
    """Return a ratio of energies; NaN if one of them is 0, which tells nothing."""
    return above / below if above > 0.0 and below > 0.0 else np.nan


def _change_db(ratio: float, before: float) -> float:
    """Return a change in dB."""
    return float(10.0 * np.log10(ratio / before))
