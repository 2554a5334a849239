"""A controller whose secondary path is verified while it is used, and which is turned down if it makes the noise louder."""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._validate import as_channels, as_number, as_positive
from ..power.constraint import DEFAULT_FS
from .base import Controller, WrappedController, listening
from .channels import amplifier_functions, channel_sample
from .posterior import DEFAULT_UNCERTAINTY, LEAST_SPREAD, PathObserver, relative_spread

AVERAGE_S = 0.1  # of the powers that are compared
LOUD = 10**0.3  # times the disturbance that is expected: the error is too loud
SUSPECT = 10**0.075  # ... while the path is not known, or the control signal is turned down
UNSTABLE = 8.0  # times the disturbance: what the controller would hear if it played at full volume
HOLD_S = 0.25  # after an alarm
LEAST_VOLUME, STEP_S = 0.05, 0.25  # of a new start, and the time until it is doubled
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 32.0
LEAST_CHANGE = 1e-4  # of the energy of the path: smaller ones are not passed on to the controller
LOUDEST = 1e50  # of what can be learnt from, see `plant.h`


@dataclass(frozen=True)
class PathEvent:
    """Something that a `VerifiedController` noticed.

    Attributes
    ----------
    time_s : float
        Time since the first sample, in s.
    what : str
        "alarm": the errors contradict the secondary path, which is learned anew; "louder": the noise is louder than it
        would be without control; "unstable": the adaptation diverges although the path is right; "not finite": the control signal
        is NaN or Inf; "full volume": the control signal is no longer turned down.
    """

    time_s: float
    what: str


class VerifiedController(WrappedController):
    r"""A controller that learns its paths while it runs, and never makes the noise much louder for long.

    Beside the controller, the posterior of `kf_pb` learns the primary paths p and the secondary paths s from the reference
    x, what the loudspeakers play, y, and the errors:

    .. math:: e = p * x - s * y + \text{noise}

    There is no probe: the control signal itself tells what the path is, as long as the primary path is the one that was
    learned. The controller gets the posterior's secondary path, and keeps its weights. If the errors contradict the
    posterior, an alarm resets the secondary path to the controller's first one with a large uncertainty, and the controller does not adapt for
    0.25 s, in which the path is learned again.

    The posterior also tells how loud the noise would be without control, :math:`p * x`. If the error is 3 dB louder over
    0.1 s (0.75 dB after an alarm), the loudspeakers are silent at once, and a fresh copy of the controller takes over. It
    adapts in silence to :math:`e - \hat s * y`, what it would hear at full volume. After half a second, it plays at a
    twentieth of its volume, which is doubled every 0.25 s in which the noise is not 0.75 dB louder. A failure doubles the
    pause before the next start, up to 32 s. What silence shows to be louder than :math:`p * x`, a noise that no reference hears, is
    expected from then on, and forgotten within the memory.

    The loudspeakers are silent until there is a first posterior. `listen` gives it before the control is switched on.

    Parameters
    ----------
    controller : Controller
        Any controller with `secondary_path`, which can be assigned, and `n_taps`, as the built-in ones have. It must be
        possible to copy it, and it has not processed a sample yet. `kf_pb` verifies its path itself.
    fs : float, default 16000
        Sample rate in Hz.
    memory_s : float, default 20
        Memory of the posterior in s. A shorter one follows a path that drifts faster, and knows less of one that stays.
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
    The path is believed to the controller's `secondary_path_uncertainty`, or to 0.3 of its rms if that is not set. The
    estimate has as many taps as the controller's, so make that with a path that is filled with zeros to the length of the
    longest path that may occur.

    A new start keeps the limiter, and the uncertainty and the rated power that were assigned; what was changed inside the
    controller is lost.

    `simulate` calls it from Python sample by sample. The posterior is the core's: see `controllers.PowerBudgetController`.

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
        super().__init__(controller)
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
        self.name = f"{getattr(controller, 'name', type(controller).__name__)} with a verified path"
        self.events: list[PathEvent] = []
        path = self._paths()
        J, M = path.shape[1:]
        n_references = getattr(controller, "n_references", 1)
        self._amplifiers = amplifier_functions(amplifier, J)
        uncertainty = getattr(controller, "secondary_path_uncertainty", None)
        self._observer = PathObserver(
            controller.n_taps,
            path,
            n_references=n_references,
            spread=relative_spread(DEFAULT_UNCERTAINTY if uncertainty is None else uncertainty, path) or LEAST_SPREAD,
            fs=self.fs,
            memory_s=self.memory_s,
        )
        self._fresh = deepcopy(controller)
        # The samples of a block and those before it, of which the paths have the oldest first: x, and what the controller
        # asks for but does not get.
        self._block = self._observer.block
        self._x = np.zeros((n_references, self._observer.primary_path.shape[-1] - 1 + self._block))
        self._withheld = np.zeros((J, M - 1 + self._block))
        self._n = self._samples = 0  # of this block, and of all
        self._awaits_error = False
        self.volume, self._pause_s = 0.0, FIRST_PAUSE_S
        self._wait = 0  # samples until the volume is next changed
        self._alarms, self._held_for = 0, 0  # alarms so far; samples until the controller may adapt
        self._rate = -math.expm1(-1.0 / (AVERAGE_S * self.fs))
        self._error = self._disturbance = self._alone = 0.0  # powers over AVERAGE_S; `alone`: at full volume
        self._excess = 0.0  # power of noise that is not p * x, found in silence
        self._sums, self._silent_for = (
            np.zeros(3),
            0,
        )  # energies and number of samples at this volume; samples of silence
        self._use_posterior()

    def __repr__(self) -> str:
        return f"<{self.name}: volume {self.volume:g}, {len(self.events)} event(s), {self.controller!r}>"

    @property
    def alarms(self) -> int:
        """Number of times so far that the errors contradicted the secondary path."""
        return self._observer.alarms

    @property
    def primary_path(self) -> np.ndarray:
        """Posterior mean of the primary path, (N,), or with several channels (K, I, N); N = L + M - 1."""
        paths = self._observer.primary_path
        return paths if self.multichannel else paths[0, 0]

    def _paths(self) -> np.ndarray:
        """Return the secondary paths in use, (K, J, M)."""
        path = np.asarray(self.controller.secondary_path, dtype=np.float64)
        return path if self.multichannel else path.reshape(1, 1, -1)

    def _use_posterior(self) -> None:
        """Set the paths by which samples are judged, the oldest sample first."""
        self._p = self._observer.primary_path[..., ::-1].copy()
        self._s = self._paths()[..., ::-1].copy()
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
        """Return the control signal y(n), turned down if it must be, for the newest reference sample x(n).

        With several channels, x(n) is (I,), and the control signal is (J,).
        """
        x = self._channels(reference, len(self._x), "reference", "references")
        own = np.reshape(self.controller.control_signal(reference), -1)
        if self._awaits_error:
            self._take(None)
        if not np.all(np.abs(own) <= LOUDEST):
            self._stop("not finite")
            own = np.zeros(len(self._withheld))
        y = self.volume * own
        self._push(x, y, own - y)
        return self._shaped(y)

    def update(self, error: Any) -> None:
        """Let the controller adapt to the error e(n), or (K,), as it would be at full volume."""
        errors = self._channels(error, len(self._p), "error", "microphones")
        alone = errors
        if self.volume < 1.0 or self._withheld.any():
            newest = self._withheld[:, self._n : self._n + self._s.shape[-1]]
            alone = errors - np.einsum("kjm,jm->k", self._s, newest)
        if not self._held_for:
            self.controller.update(self._shaped(alone))
        self._take(errors, alone)

    def listen(self, references: Any, errors: Any) -> None:
        """Follow `references` and `errors` before the control is switched on, with silent output."""
        x, e = (np.atleast_2d(as_channels(s, n)) for s, n in ((references, "references"), (errors, "errors")))
        listening(self.controller).listen(references, errors)
        if self._awaits_error:
            self._take(None)
        silence = np.zeros(len(self._withheld))
        for sample, heard in zip(x.T, e.T, strict=True):
            self._push(sample, silence, silence)
            self._take(heard, heard)

    def _channels(self, value: Any, count: int, name: str, what: str) -> np.ndarray:
        """Return a checked sample, of which the observer refuses none."""
        sample = channel_sample(value, count, name, what) if self.multichannel else np.array([as_number(value, name)])
        if np.any(np.abs(sample) > LOUDEST):
            raise ValueError(f"{name} is too loud, above {LOUDEST:g}: scale the signals; nothing was changed")
        return sample

    def _push(self, x: np.ndarray, y: np.ndarray, withheld: np.ndarray) -> None:
        """Take the signals of a sample whose error is still to come."""
        self._x[:, self._x.shape[1] - self._block + self._n] = x
        self._withheld[:, self._withheld.shape[1] - self._block + self._n] = withheld
        self._silent_for = 0 if y.any() else self._silent_for + 1
        if self._amplifiers is not None:
            y = np.array([amplifier(float(one)) for amplifier, one in zip(self._amplifiers, y, strict=True)])
        self._observer.control_signal(np.concatenate((x, y)))
        self._awaits_error = True

    def _take(self, errors: np.ndarray | None, alone: np.ndarray | None = None) -> None:
        """Take the errors of the sample, or None if they are not known, and decide how loud to play."""
        self._awaits_error = False
        if errors is not None and alone is not None:
            self._observer.update(errors)
            newest = self._x[:, self._n : self._n + self._p.shape[-1]]
            expected = np.einsum("kin,in->k", self._p, newest)
            self._judge(float(errors @ errors), float(expected @ expected) + self._noise, float(alone @ alone))
        self._n += 1
        self._samples += 1
        self._held_for = max(self._held_for - 1, 0)
        if self._n == self._block:
            self._end_block()

    # ---- Decisions

    def _judge(self, error: float, disturbance: float, alone: float) -> None:
        """Compare powers: silence follows at once if the control makes the noise louder."""
        if not self._observer.fits:
            return
        self._error += self._rate * (error - self._error)
        self._disturbance += self._rate * (disturbance - self._disturbance)
        self._alone += self._rate * (alone - self._alone)
        if self.volume > 0.0 or self._silent_for >= self._s.shape[-1]:  # otherwise the room still rings
            self._sums += error, disturbance, 1.0
        expected = self._disturbance + self._excess
        if self.volume > 0.0 and self._error > (SUSPECT if self._held_for else LOUD) * expected:
            self._stop("louder")
        elif self.volume < 1.0 and self._alone > UNSTABLE * expected:
            self._stop("unstable")

    def _end_block(self) -> None:
        """Use what the posterior has learned, and change the volume if it is time."""
        for line in (self._x, self._withheld):
            line[:, : -self._block] = line[:, self._block :].copy()
        self._n = 0
        if self._observer.alarms > self._alarms:
            self._alarms = self._observer.alarms
            self._held_for = round(HOLD_S * self.fs)
            self._note("alarm")
        if self._observer.fits and not self._held_for:
            new, old = self._observer.identified_path, self._paths()
            if np.sum((new - old) ** 2) > LEAST_CHANGE * np.sum(old**2):
                self.controller.secondary_path = self._shaped_path(new)
        self._use_posterior()
        self._excess *= math.exp(-self._block / (self.memory_s * self.fs))
        if self.volume < 1.0 and self._observer.fits:
            self._wait -= self._block
            if self._wait <= 0:
                self._turn_up()

    def _shaped_path(self, path: np.ndarray) -> np.ndarray:
        return path if self.multichannel else path[0, 0]

    def _turn_up(self) -> None:
        """Play louder, unless the noise has become louder at this volume."""
        error, disturbance, samples = self._sums
        self._sums = np.zeros(3)
        if self.volume > 0.0 and error > SUSPECT * (disturbance + samples * self._excess):
            self._stop("louder")
            return
        if self.volume == 0.0 and samples:
            self._excess = max(float(error - disturbance) / samples, 0.0)
        started = any(event.what not in ("alarm", "full volume") for event in self.events)
        self.volume = min(max(2.0 * self.volume, LEAST_VOLUME), 1.0) if started else 1.0
        self._wait = round(STEP_S * self.fs)
        if self.volume == 1.0 and started:
            self._note("full volume")

    def _stop(self, what: str) -> None:
        """Be silent, and let a fresh controller adapt in silence, with the path and the limiter in use."""
        self._note(what)
        before, self.controller = self.controller, deepcopy(self._fresh)
        self.controller.secondary_path = before.secondary_path
        if hasattr(before, "limiter"):
            self.controller.limiter = before.limiter
        self.volume, self._wait = 0.0, round(self._pause_s * self.fs)
        self._pause_s = min(2.0 * self._pause_s, LONGEST_PAUSE_S)
        self._error = self._alone = self._disturbance + self._excess
        self._sums = np.zeros(3)

    def _note(self, what: str) -> None:
        self.events.append(PathEvent(self._samples / self.fs, what))

    def _rates(self) -> dict[str, float | None]:
        return {"verification": self.fs}
