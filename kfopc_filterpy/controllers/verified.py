"""A wrapper that verifies the secondary path of a controller, and silences it if it makes the noise louder."""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._validate import as_channels, as_number, as_positive
from ..core.block import LOUDEST_LEARNT
from ..power.constraint import DEFAULT_FS
from .base import Controller, WrappedController, listening
from .channel_samples import amplified, amplifier_functions, channel_sample, require_moderate
from .posterior import DEFAULT_UNCERTAINTY, LEAST_SPREAD, PathObserver, relative_spread

AVERAGE_S = 0.1  # of the powers that are compared
LOUD = 10**0.3  # times the disturbance that is expected: the error is too loud
SUSPECT = 10**0.075  # ... while the path is not known, or the control signal is turned down
NEAR = 0.25  # ... so close to it that the path in use may be wrong
UNSTABLE = 8.0  # ... of the error that is computed for full volume
HOLD_S = 0.25  # after an alarm
LEARN_S = 2.0  # after the error was last so close to the disturbance
LEAST_VOLUME, STEP_S = 0.05, 0.1  # of a new start, and the time until it is doubled
FIRST_PAUSE_S, LONGEST_PAUSE_S, FORGIVEN_S = 0.5, 32.0, 60.0
LEAST_CHANGE, LARGE_CHANGE = 1e-4, 0.25  # of the path's energy: less is not passed on; more is tried in silence first


@dataclass(frozen=True)
class PathEvent:
    """Something that a `VerifiedController` noticed.

    Attributes
    ----------
    time_s : float
        Time since the first sample, in s.
    what : str
        "alarm": the errors contradict the secondary path, which is learned anew; "full volume": the control signal is
        no longer turned down. The other events stop the control. "louder": the noise is louder than it would be without
        control; "another path": the secondary path has drifted far; "unstable": the adaptation diverges while the control
        signal is turned down; "not finite": the control signal is NaN, Inf or above 1e20.
    """

    time_s: float
    what: str


class VerifiedController(WrappedController):
    r"""A controller that learns its paths while it runs, and stops at once if it makes the noise louder.

    Beside the controller, the posterior of `kf_pb` learns the primary paths p and the secondary paths s from the reference
    x, what the loudspeakers play, y, and the errors:

    .. math:: e = p * x - s * y + \text{noise}

    There is no probe: the control signal itself reveals the secondary path, as long as the primary path does not
    change. A drift of the primary path can be mistaken for a change of the secondary path. So the posterior is used
    only while the error is within 6 dB of the noise without control, which the posterior expects to be :math:`p * x`,
    and for two seconds after that.
    The controller then gets the posterior's secondary path, and keeps its weights. If the errors contradict the
    posterior, an alarm is raised. The secondary path returns to the first one, now with a large uncertainty, and is
    learned again. The controller does not adapt until 0.25 s have been heard.

    If the mean power of the error over 0.1 s is 3 dB above that of :math:`p * x` (0.75 dB after an alarm), the
    loudspeakers are silenced at once, and a fresh copy of the controller takes over. In silence, it adapts to
    :math:`e - \hat s * y`, the error that it would hear at full volume. After half a second it starts. Each failure
    doubles this pause, up to 32 s; after a minute without one, the pauses begin with half a second again. A copy also
    takes over if the path has changed by a quarter of its energy without an alarm.

    Every start is soft, including the first. The loudspeakers begin at a twentieth of the volume, which is doubled
    every 0.1 s, unless the noise is 0.75 dB louder than without control.

    In silence, p is learned, and so is the ratio of the noise to :math:`p * x`. So noise that no reference hears is
    expected from then on. This ratio fades with the memory.

    The loudspeakers are silent until there is a first posterior. `listen` provides it before the control begins.

    Parameters
    ----------
    controller : Controller
        Any controller with `n_taps` and a `secondary_path` that can be assigned, as the built-in ones have. It is copied,
        so it must not have processed a sample yet. `kf_pb` is refused: it verifies its path itself.
    fs : float, default 16000
        Sample rate in Hz.
    memory_s : float, default 20
        Memory of the posterior in s. A shorter one forgets an old path sooner, and learns a constant path less exactly.
    amplifier : callable or sequence of J of them, optional
        Known amplifiers, functions of a sample, as for the controller.

    Attributes
    ----------
    events : list of PathEvent
        What was noticed, in order of time.
    volume : float
        Factor of the control signal now, from 0 to 1.

    Raises
    ------
    TypeError
        An object that is not a controller, or lacks a secondary path.
    ValueError
        A setting that is out of range, or a controller that verifies its path itself.

    See Also
    --------
    kf_pb : It also chooses its control filter by the posterior.

    Notes
    -----
    At the start, the estimated path is taken to be wrong by the controller's `secondary_path_uncertainty`, or by 0.3 of
    its rms if that is not set. What is learned has as many taps as the controller's path. So make the controller with a
    path that is filled with zeros to the length of the longest path that may occur.

    A new start keeps the limiter, and the uncertainty and the rated power that were assigned. Other changes to the
    controller are lost.

    `simulate` calls it from Python sample by sample. The core computes the posterior, as for
    `controllers.PowerBudgetController`.

    Examples
    --------
    The estimate has the wrong sign and delay. FxLMS alone diverges:

    >>> import numpy as np
    >>> from kfopc_filterpy import FxLMS, noise_reduction_db, simulate
    >>> from kfopc_filterpy.controllers import VerifiedController
    >>> x, noise = np.random.default_rng(0).standard_normal((2, 16000))
    >>> disturbance = np.roll(x, 5) + 0.1 * noise
    >>> plant = {"disturbance": disturbance, "secondary_path": [0.0, 0.0, -0.8], "fs": 2000.0}
    >>> simulate(FxLMS(8, [0.0, 1.0, 0.0], step_size=0.005), x, **plant).diverged_at_s is not None
    True
    >>> verified = VerifiedController(FxLMS(8, [0.0, 1.0, 0.0], step_size=0.005), fs=2000.0)
    >>> result = simulate(verified, x, **plant)
    >>> verified.secondary_path.round(1) + 0.0
    array([ 0. ,  0. , -0.8])
    >>> bool(noise_reduction_db(result.error, result.disturbance) > 19)
    True
    """

    controller: Any  # with secondary_path and n_taps

    def __init__(
        self, controller: Controller, *, fs: float = DEFAULT_FS, memory_s: float = 20.0, amplifier: Any = None
    ) -> None:
        super().__init__(controller, "with a verified path")
        if getattr(controller, "internal_model", False):
            raise ValueError(
                "VerifiedController takes no controller with an internal model: its reference is computed with the path "
                "that is to be verified; give it the controller without one, or state a secondary_path_uncertainty"
            )
        if hasattr(controller, "physical") or not (
            hasattr(controller, "secondary_path") and hasattr(controller, "n_taps")
        ):
            raise TypeError(
                f"controller must have secondary_path and n_taps, as the built-in ones have, got {controller!r}; "
                "virtual microphones have other paths than those that are heard"
            )
        if hasattr(controller, "alarms"):
            raise ValueError(f"{controller!r} verifies its path itself")
        self.fs, self.memory_s = as_positive(fs, "fs", unit="Hz"), as_positive(memory_s, "memory_s", unit="s")
        self.multichannel = bool(getattr(controller, "multichannel", False))
        self.events: list[PathEvent] = []
        path = self._paths()
        self.n_microphones, self.n_loudspeakers, M = path.shape
        self.n_references = getattr(controller, "n_references", 1)
        self._amplifiers = amplifier_functions(amplifier, self.n_loudspeakers)
        uncertainty = getattr(controller, "secondary_path_uncertainty", None)
        self._observer = PathObserver(
            controller.n_taps,
            path,
            n_references=self.n_references,
            spread=relative_spread(DEFAULT_UNCERTAINTY if uncertainty is None else uncertainty, path) or LEAST_SPREAD,
            fs=self.fs,
            memory_s=self.memory_s,
        )
        self._fresh = deepcopy(controller)
        # The samples of this block and those before it, the oldest first: x, and the part of the control signal that is
        # not played.
        self._block = self._observer.block
        self._x = np.zeros((self.n_references, self._observer.primary_path.shape[-1] - 1 + self._block))
        self._withheld = np.zeros((self.n_loudspeakers, M - 1 + self._block))
        self._n = self._samples = 0  # of this block, and of all
        self._awaits_error = False
        self.volume, self._pause_s = 0.0, 0.0  # no pause before the first failure
        # Samples at which it stopped last, and at which the error was near the disturbance last.
        self._stopped_at = self._near_at = -math.inf
        self._wait = 0  # samples until the volume is next changed
        self._alarms, self._since_alarm = 0, round(HOLD_S * self.fs)  # alarms so far; samples played since the last one
        self._doubts = False  # whether the controller must not adapt, because the path is not known
        self._rate = -math.expm1(-1.0 / (AVERAGE_S * self.fs))
        # Mean powers over AVERAGE_S: the error, the expected noise without control, and the error at full volume.
        self._error = self._expected = self._alone = 0.0
        self._ratio = 1.0  # of the noise to what the posterior expects, found in the last pause
        self._sums = np.zeros(2)  # energies of error and expected noise at this volume
        self._silent_for = 0  # samples of silence
        self._use_posterior()

    def __repr__(self) -> str:
        return f"<{self.name}: volume {self.volume:g}, {len(self.events)} event(s), {self.controller!r}>"

    @property
    def alarms(self) -> int:
        """Number of times so far that the errors contradicted the paths."""
        return self._observer.alarms

    @property
    def primary_path(self) -> np.ndarray:
        """Posterior mean of the primary path, (N,), or with several channels (K, I, N); N = L + M - 1."""
        return self._shaped_path(self._observer.primary_path)

    def _paths(self) -> np.ndarray:
        """Return the secondary paths in use, (K, J, M)."""
        path = np.asarray(self.controller.secondary_path, dtype=np.float64)
        return path if self.multichannel else path.reshape(1, 1, -1)

    def _use_posterior(self) -> None:
        """Set the paths by which samples are judged, the tap of the oldest sample first."""
        self._s = self._paths()[..., ::-1].copy()
        self._known = self._observer.fits > 0
        # Only in silence: sound that is played over an unknown path could be mistaken for a louder primary path.
        if self.volume == 0.0 or self._silent_for >= self._s.shape[-1] + self._block:
            self._p = self._observer.primary_path[..., ::-1].copy()
            self._noise = float(np.sum(self._observer.measurement_noise))

    def _shaped(self, channels: np.ndarray) -> Any:
        """Return values as the controller has them: without an axis of channels if it has one channel."""
        return channels if self.multichannel else float(channels[0])

    def _pass_on(self, name: str, value: Any) -> None:
        super()._pass_on(name, value)
        if name != "limiter":  # a new start gets the limiter in use
            setattr(self._fresh, name, value)
        if name == "secondary_path":
            self._observer.secondary_path = self._paths()
            self._use_posterior()

    # ---- Samples

    def control_signal(self, reference: Any) -> Any:
        """Return the control signal y(n), turned down if necessary, for the newest reference sample x(n).

        With several channels, x(n) is (I,), and the control signal is (J,).
        """
        x = self._channels(reference, len(self._x), "reference", "references")
        own = np.reshape(self.controller.control_signal(reference), -1)
        if self._awaits_error:
            self._take(None)
        if not np.all(np.abs(own) <= LOUDEST_LEARNT):
            if self.volume > 0.0 or not self._is_fresh():
                self._stop("not finite")
            own = np.zeros(len(self._withheld))
        y = self.volume * own
        played = amplified(self._amplifiers, y)
        self._push(x, played, amplified(self._amplifiers, own) - played)
        return self._shaped(y)

    def update(self, error: Any) -> None:
        """Let the controller adapt to the error e(n), or (K,), as it would be at full volume."""
        errors = self._channels(error, len(self._p), "error", "microphones")
        alone = errors
        if self.volume < 1.0 or self._withheld.any():
            newest = self._withheld[:, self._n : self._n + self._s.shape[-1]]
            alone = errors - np.einsum("kjm,jm->k", self._s, newest)
        if not (self._doubts or self._is_fresh()):
            self.controller.update(self._shaped(alone))
        self._take(errors, alone)

    def listen(self, references: Any, errors: Any) -> None:
        """Follow `references` and `errors` before the control is switched on, with silent output."""
        x, e = (np.atleast_2d(as_channels(s, n)) for s, n in ((references, "references"), (errors, "errors")))
        require_moderate(x, "references")
        require_moderate(e, "errors")
        listening(self.controller).listen(references, errors)
        if self._awaits_error:
            self._take(None)
        silence, wait = np.zeros(len(self._withheld)), self._wait
        for sample, heard in zip(x.T, e.T, strict=True):
            self._wait = self._block + 1  # a new start waits for the control
            self._push(sample, silence, silence)
            self._take(heard, heard)
        self._wait = wait
        if self._known and self.volume == 0.0 and not self._pause_s:
            self._turn_up()

    def _channels(self, value: Any, count: int, name: str, what: str) -> np.ndarray:
        """Return a checked sample, of which the observer refuses none."""
        sample = channel_sample(value, count, name, what) if self.multichannel else np.array([as_number(value, name)])
        require_moderate(sample, name)
        return sample

    def _push(self, x: np.ndarray, y: np.ndarray, withheld: np.ndarray) -> None:
        """Take the signals of a sample whose error is still to come; `y` and `withheld` are amplifier outputs."""
        self._x[:, self._x.shape[1] - self._block + self._n] = x
        self._withheld[:, self._withheld.shape[1] - self._block + self._n] = withheld
        self._silent_for = 0 if y.any() else self._silent_for + 1
        self._observer.control_signal(np.concatenate((x, y)))
        self._awaits_error = True

    def _take(self, errors: np.ndarray | None, alone: np.ndarray | None = None) -> None:
        """Take the errors of the sample, or None if they are not known, and decide how loud to play."""
        self._awaits_error = False
        if errors is not None and alone is not None:
            self._observer.update(errors)
            newest = self._x[:, self._n : self._n + self._p.shape[-1]]
            d = np.einsum("kin,in->k", self._p, newest)
            self._judge(float(errors @ errors), self._ratio * (float(d @ d) + self._noise), float(alone @ alone))
        self._n += 1
        self._samples += 1
        if self._n == self._block:
            self._end_block()

    # ---- Decisions

    def _judge(self, error: float, expected: float, alone: float) -> None:
        """Compare powers, and stop at once if the control makes the noise louder."""
        if not self._known:
            if self.volume > 0.0:  # another path was assigned while it plays
                return
            expected = error  # in silence
        self._error += self._rate * (error - self._error)
        self._expected += self._rate * (expected - self._expected)
        self._alone += self._rate * (alone - self._alone)
        if self.volume > 0.0 or self._silent_for >= self._s.shape[-1]:  # otherwise the room still rings
            self._sums += error, expected
        if not self._known:
            return
        if self.volume > 0.0 and self._error > (SUSPECT if self._doubts else LOUD) * self._expected:
            self._stop("louder")
        elif self.volume < 1.0 and self._alone > UNSTABLE * self._expected:
            self._stop("unstable")

    def _end_block(self) -> None:
        """Use what the posterior has learned, and change the volume if it is time."""
        for line in (self._x, self._withheld):
            line[:, : -self._block] = line[:, self._block :].copy()
        self._n = 0
        # While the noise is reduced well, the path is kept: the posterior may have mistaken a drift of the primary path
        # for one of the secondary path.
        is_near = self.volume < 1.0 or self._error > NEAR * self._expected
        self._near_at = self._samples if is_near else self._near_at
        if self._observer.alarms > self._alarms:
            self._alarms, self._since_alarm = self._observer.alarms, 0
        is_new = self._since_alarm < HOLD_S * self.fs  # the posterior knows little of the path
        if is_new and is_near and not self._doubts and self.volume == 1.0:
            self._note("alarm")
        self._doubts = is_new and is_near and self.volume == 1.0  # turned down, it adapts with the path that it had
        if self._known and self._samples - self._near_at < round(LEARN_S * self.fs) and not is_new:
            new, old = self._observer.identified_path, self._paths()
            change = np.sum((new - old) ** 2) / max(np.sum(old**2), np.finfo(float).tiny)
            if change > LEAST_CHANGE:
                if change > LARGE_CHANGE and self.volume == 1.0 and self._since_alarm > self.fs:
                    self._stop("another path")
                self.controller.secondary_path = self._shaped_path(new)
        if self.volume > 0.0:  # silence says nothing about the path
            self._since_alarm += self._block
        self._use_posterior()
        self._ratio **= math.exp(-self._block / (self.memory_s * self.fs))
        if self.volume < 1.0 and self._known:
            self._wait -= self._block
            if self._wait <= 0 and not (is_new and self.volume > 0.0):
                self._turn_up()

    def _shaped_path(self, path: np.ndarray) -> np.ndarray:
        return path if self.multichannel else path[0, 0]

    def _turn_up(self) -> None:
        """Play louder, unless the noise has become louder at this volume."""
        (error, expected), self._sums = self._sums, np.zeros(2)
        if self.volume > 0.0 and error > SUSPECT * expected:
            self._stop("louder")
            return
        if self.volume == 0.0 and error > 0.0 and expected > 0.0:
            self._ratio *= float(error / expected)
        self.volume, self._wait = min(max(2.0 * self.volume, LEAST_VOLUME), 1.0), round(STEP_S * self.fs)
        if self.volume == 1.0 and self._pause_s:
            self._note("full volume")

    def _stop(self, what: str) -> None:
        """Silence the loudspeakers, and let a fresh controller adapt, with the path and the limiter in use."""
        if self.volume > 0.0 or not self.events or self.events[-1].what != what:  # else it repeats the last event
            self._note(what)
        before, self.controller = self.controller, deepcopy(self._fresh)
        if what == "unstable":  # with a path learned from too little: the first one is used until more is known
            self._since_alarm = 0
        else:
            self.controller.secondary_path = before.secondary_path
        if hasattr(before, "limiter"):
            self.controller.limiter = before.limiter
        if self._samples - self._stopped_at > FORGIVEN_S * self.fs:
            self._pause_s = 0.0
        self._stopped_at = self._samples
        if not self._pause_s or (self.volume > 0.0 and what != "another path"):  # a failure that was heard
            self._pause_s = min(max(2.0 * self._pause_s, FIRST_PAUSE_S), LONGEST_PAUSE_S)
        self.volume, self._wait = 0.0, round(self._pause_s * self.fs)
        self._error = self._alone = self._expected
        self._sums = np.zeros(2)

    def _is_fresh(self) -> bool:
        """Return whether the controller in use has no past yet: first it only hears references."""
        return self._samples - self._stopped_at < self._p.shape[-1]

    def _note(self, what: str) -> None:
        self.events.append(PathEvent(self._samples / self.fs, what))

    def _rates(self) -> dict[str, float | None]:
        return {"verification": self.fs}
