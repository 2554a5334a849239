"""Supervise a controller in a real-time process: its output stays finite and within limits."""

from __future__ import annotations

from collections import deque
from copy import deepcopy
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._types import PerLoudspeaker
from .._validate import as_count, as_number, as_positive, as_real_array, as_sample_count, per_loudspeaker
from ..checkpoint import Checkpointed
from ..controllers.base import Controller, WrappedController, checked_controller
from ..controllers.channel_samples import through
from ..controllers.core_controller import CoreController
from ..controllers.processing import process_steps
from ..paths.uncertainty import GUARD_TAPS
from ..power.limiter import OutputLimiter
from .adaptation import Adaptation
from .faults import GOOD, KINDS, NOT_FINITE, REPEATED, STUCK, Inspector, is_repeated
from .health import Health
from .loudness import Loudness

LONGEST_PAUSE = 64  # of the first pause
FORGOTTEN_S = 600.0  # without a divergence, after which the pauses are short again
MOST_LOST = 2**53  # samples at once; many times as many are still a number that converts to a time
MOST_DB = 100.0  # of louder noise: the square of a ratio of powers is still a number
ABSENT = (NOT_FINITE, STUCK, REPEATED)  # kinds of samples that say nothing of how loud it is


class Supervisor(Checkpointed):
    """Run a controller block by block, and keep faults from the loudspeakers.

    Three things hold, whatever the inputs are. The control signal is finite and within `amplitude_limit`. A bad sample
    is never adapted to: weights, covariance and running powers stay as they are. Every event is counted in `health`.

    A bad sample of a reference also spoils the filtered reference for as long as the control filter and the secondary
    path remember it. The controller therefore adapts again `recovery_samples` after the last bad reference. After a bad
    error, it adapts to the next sample, unless an internal model makes a reference of the error.

    An internal model relies on the control signals being played as they are. So a controller with an internal model
    gets the errors that it would hear without fades and limits. In place of a missing error, it gets the one that it
    would hear without noise.

    Parameters
    ----------
    controller : Controller
        Any controller that can be copied. A fresh copy of its present state replaces it after a divergence. A feedback
        controller (`controllers.with_internal_model`) has no references: its blocks are ``process(None, errors)``.
    fs : float
        Sample rate in Hz.
    amplitude_limit : float or array_like, shape (J,)
        Largest magnitude of the control signal, of all loudspeakers or of each. The controller does not know about this
        last resort: give it a limiter with a smaller `amplitude_limit`.
    full_scale : float, optional
        Magnitude at which the converters of the microphones clip; by default, clipping is not detected.
    stuck_s : float, default 0.01
        Time of equal samples after which a microphone is stuck, in seconds. Digital silence is stuck too.
    fade_s : float, default 0.05
        Time in seconds over which the control fades in and out.
    mute_after_s : float, default 10
        Time in seconds without a usable sample after which the control fades out; with the next usable one it fades in.
    pause_s : float, default 2
        Pause in seconds after a divergence: the control fades out, and begins again with a fresh copy of the controller.
        Each pause is twice the last one, until there was none for ten minutes.
    window_s : float, default 0.25
        Time over which the divergence monitor averages, in seconds.
    largest_gain : float, default 1e6
        Largest sum of the magnitudes of a control filter's weights.
    louder_db : float, default 2
        How much louder than before control the noise may become, in dB.
    louder_s : float, optional
        Time over which that is averaged, in seconds, by default 1. With silent loudspeakers, the supervisor listens for
        as long at the start, to know the level before control. None: the loudness is not watched, and the control
        begins at once.
    blocks_can_repeat : bool, default True
        Whether a block that equals the last one in all channels is a fault of the driver. Switch it off for simulated
        noise whose period divides the block.

    Attributes
    ----------
    controller : Controller
        Controller that is running now.
    health : Health
        What was noticed.
    muted : bool
        Whether the loudspeakers are silent now.
    recovery_samples : int
        Samples after a bad reference before the controller adapts again: the taps of its filter and its secondary path,
        and a guard filter; 0 if the controller does not state its memory.
    divergence_times_s : deque of float
        Times of the latest divergences, at most three.

    Raises
    ------
    TypeError, ValueError
        An object that is not a controller; a limit, time or choice that is out of range; virtual microphones around
        a controller with an internal model.

    Notes
    -----
    The divergence monitor looks at each window for

    - weights that are not finite, or larger than `largest_gain`;
    - in three windows in a row, a control signal of more than four times the controller's rated power, or one at its
      limit for a tenth of the time, from a control filter whose gain has grown;
    - noise that is louder than before control, for example because a loudspeaker has the wrong polarity.

    An exception of the controller, such as a refused update, is a divergence too.

    To notice louder noise, the monitor compares the power of the errors, the sum over the microphones, with that of the
    last silence. If the references have become louder or softer since then, as much is expected of the errors, but no
    fall of more than 10 dB. If the mean over `louder_s` is `louder_db` above that, where each window counts at most
    twice as many dB, the loudspeakers fade out, and the supervisor listens for as long. If the noise is now softer by
    at least half of `louder_db`, that was a divergence. Otherwise the noise itself has become louder, and the same
    controller fades in again. Without a reference microphone, noise that becomes louder by itself costs such a silence
    each time. The loudness is not watched with virtual microphones: it may rightly rise where the microphones are.

    `save` and `load` include the controller, its copies, the fades and pauses under way, and the health record. Call
    `save` between two blocks.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import fx_lms
    >>> from kfopc_filterpy.realtime import Supervisor
    >>> path = np.zeros(33)
    >>> path[32] = 1.0  # the delay of a block is part of the secondary path
    >>> supervisor = Supervisor(fx_lms(8, path, step_size=0.01), fs=8000, amplitude_limit=0.5)
    >>> reference = np.sin(np.arange(32.0))
    >>> error = reference.copy()
    >>> error[[3, 4]] = np.nan, np.inf
    >>> y = supervisor.process(reference, error)
    >>> supervisor.health
    <Health: 1 not finite>
    """

    def __init__(
        self,
        controller: Controller,
        *,
        fs: float,
        amplitude_limit: PerLoudspeaker,
        full_scale: float | None = None,
        stuck_s: float = 0.01,
        fade_s: float = 0.05,
        mute_after_s: float = 10.0,
        pause_s: float = 2.0,
        window_s: float = 0.25,
        largest_gain: float = 1e6,
        louder_db: float = 2.0,
        louder_s: float | None = 1.0,
        blocks_can_repeat: bool = True,
    ) -> None:
        self._controller: Any = checked_controller(controller)
        remembered = _modelled_samples(controller)
        self.fs = as_positive(fs, "fs", unit="Hz")
        if hasattr(controller, "require_sample_rate"):
            controller.require_sample_rate(self.fs)
        counts = [int(getattr(controller, f"n_{what}", 1)) for what in ("references", "microphones", "loudspeakers")]
        self.n_references, self.n_microphones, self.n_loudspeakers = counts
        self.multichannel = bool(getattr(controller, "multichannel", max(counts) > 1))
        self.amplitude_limit = per_loudspeaker(amplitude_limit, self.n_loudspeakers, "amplitude_limit")
        self.largest_gain = as_positive(largest_gain, "largest_gain")
        self.recovery_samples = _remembered(controller)
        most_equal, rate = as_sample_count(stuck_s, fs, "stuck_s"), 1.0 / (0.1 * self.fs)
        loudest = np.inf if full_scale is None else as_positive(full_scale, "full_scale")
        self._inspectors = [
            Inspector(n, most_equal=most_equal, rate=rate, full_scale=loudest)
            for n in (self.n_references, self.n_microphones)
        ]
        self.health = Health()
        self._fresh = deepcopy(controller)
        self._fade = as_sample_count(fade_s, fs, "fade_s")
        self._mute_after = as_sample_count(mute_after_s, fs, "mute_after_s")
        self._window = as_sample_count(window_s, fs, "window_s")
        self._pause = self._first_pause = as_sample_count(pause_s, fs, "pause_s")
        self.blocks_can_repeat = blocks_can_repeat
        self.divergence_times_s: deque[float] = deque(maxlen=3)
        n_windows = 1 if louder_s is None else round(as_sample_count(louder_s, fs, "louder_s") / self._window)
        if as_positive(louder_db, "louder_db", unit="dB") > MOST_DB:
            raise ValueError(
                f"louder_db must be at most {MOST_DB:g} dB, got {louder_db:g}; louder_s=None never listens"
            )
        watched = louder_s is not None and not hasattr(controller, "physical")
        self._loudness = Loudness(self._window, max(n_windows, 1), 10.0 ** (louder_db / 10.0) if watched else np.inf)
        self._listening = watched  # with silent loudspeakers, to know how loud the noise is
        self._suspected: np.ndarray | None = None  # windows that were louder than before control
        self._samples = 0  # since the start, lost ones included
        self._gain = 0.0 if watched else 1.0  # of the control signal
        self._wanted = True  # whether the user wants control
        self._waiting = 0  # samples left of a pause
        self._replacement_due = False  # a fresh controller takes over when the loudspeakers are silent
        self._since_bad_reference = self._since_fade = self.recovery_samples
        self._dies_away = max(self.recovery_samples, self._fade)
        self._silent_for = self._dies_away  # samples; nothing was played
        self._watched = ""  # what the present window is: "silence", "control", or nothing
        self._unusable = 0  # samples since the last usable one
        self._paused_for_input = False
        self._last_block: Any = None
        # The last samples that the controller wanted to play, and those that were played, as far as an internal model
        # remembers them.
        self._wanted_y, self._played_y = np.zeros((2, self.n_loudspeakers, remembered))
        self._adaptation = Adaptation(self.n_loudspeakers, self._window)

    @property
    def controller(self) -> Any:
        """Controller that is running now.

        What was played so far counts for the limiter of one that is assigned. One with an internal model must not have
        played anything yet.
        """
        return self._controller

    @controller.setter
    def controller(self, controller: Controller) -> None:
        controller = checked_controller(controller)
        remembered = _modelled_samples(controller)
        for new, old in zip(_limiters(controller), _limiters(self._controller), strict=False):
            if new is not old:
                new.follow(old)
        self._controller = controller
        self._wanted_y = np.zeros((self.n_loudspeakers, remembered))  # it has played nothing as yet
        self._played_y = np.pad(self._played_y, ((0, 0), (remembered, 0)))[:, self._played_y.shape[1] :]

    @property
    def _modelled(self) -> bool:
        """Whether the controller has an internal model."""
        return bool(getattr(self._controller, "internal_model", False))

    def _restart(self) -> None:
        """Go on with a fresh copy of the controller, and with the limiter in use, which knows what was played."""
        fresh = deepcopy(self._fresh)
        for limiter in _limiters(fresh):
            limiter.reset()
        if _limiters(self.controller) and isinstance(fresh, CoreController | WrappedController):
            fresh.limiter = self.controller.limiter
        self.controller = fresh

    @property
    def _target(self) -> float:
        """Gain that the control signal fades to."""
        held_back = self._waiting > 0 or self._paused_for_input or self._replacement_due or self._listening
        return 1.0 if self._wanted and not held_back else 0.0

    @property
    def muted(self) -> bool:
        """Whether the loudspeakers are silent now."""
        return self._gain == 0.0 and self._target == 0.0

    def __repr__(self) -> str:
        state = "listening" if self._listening else "muted" if self.muted else "running"
        return f"<Supervisor of {getattr(self.controller, 'name', type(self.controller).__name__)}: {state}, {self.health!r}>"

    def fade_in(self) -> None:
        """Let the control fade in over `fade_s`."""
        self._wanted = True

    def fade_out(self) -> None:
        """Let the control fade out over `fade_s`; the controller listens while it is silent."""
        self._wanted = False

    def listen(self, references: ArrayLike, errors: ArrayLike) -> None:
        """Take a recording of the silence before the first block, in place of listening at the start; then fade in.

        The controller hears it too, if it has `listen`.

        Parameters
        ----------
        references, errors : array_like
            Signals as for `process`, of at least `window_s`.

        Raises
        ------
        TypeError, ValueError
            Signals of other shapes, or that are not numbers, or that come after the first block.
        """
        if self._samples:
            raise ValueError("listen takes what was heard before the first block, but there were blocks already")
        x, e = self._read(references, errors)
        wanted, self._wanted, self._gain = self._wanted, False, 0.0
        self._samples = -x.shape[1]
        for begin in range(0, x.shape[1], self._window):
            part = slice(begin, begin + self._window)
            self._process(x[:, part], e[:, part])
        self._wanted = wanted
        self._listening = self._listening and self._loudness.before is None
        self._since_bad_reference = 0  # what comes next does not follow it at once

    def note(self, what: str, n_samples: int = 1) -> None:
        """Record an event of the interface in `health`, at the present time.

        Parameters
        ----------
        what : str
            What happened, for example "output underflow".
        n_samples : int, default 1
            Number of samples concerned.
        """
        self._note(what, n_samples=as_count(n_samples, "n_samples"))

    def process(self, references: ArrayLike, errors: ArrayLike, *, lost: int = 0) -> np.ndarray:
        """Return the control signals of a block.

        Parameters
        ----------
        references : array_like, shape (n_samples,) or (I, n_samples), or None
            References x. A value that is None, NaN or infinite is a missing sample; None in place of the array means
            that all are missing. A controller without a reference microphone takes None only.
        errors : array_like, shape (n_samples,) or (K, n_samples), or None
            Errors e, of as many samples; None as for the references, but not for both.
        lost : int, default 0
            Number of samples that the interface lost before this block.

        Returns
        -------
        ndarray, shape (n_samples,) or (J, n_samples)
            Control signals y.

        Raises
        ------
        TypeError, ValueError
            Signals of other shapes, or that are not numbers, or a negative number of lost samples: nothing was changed.
        """
        lost = as_count(lost, "lost", minimum=0)
        as_number(lost, "lost")  # an integer of Python can be too large for a time
        if lost > MOST_LOST:
            raise ValueError(f"lost must be at most {MOST_LOST} samples, got {lost}")
        x, e = self._read(references, errors)
        if lost:
            self._note("lost", n_samples=lost)
            self._samples += lost
            self._since_bad_reference = 0
        y = self._process(x, e)
        return y if self.multichannel else y[0]

    def _process(self, x: np.ndarray, e: np.ndarray) -> np.ndarray:
        """Return the control signals (J, n) of a block (I, n), (K, n), whose bad samples are replaced."""
        absent, usable = self._inspect(x, e)
        wanted, y = self._control(x, self._as_wanted(e, absent[len(x) :]) if self._modelled else e, usable)
        self._limit(y)
        if self._modelled:
            self._wanted_y, self._played_y = (
                np.concatenate((before, now), axis=1)[:, now.shape[1] :]
                for before, now in ((self._wanted_y, wanted), (self._played_y, y))
            )
        self._samples += y.shape[1]
        heard = ~np.any(absent, axis=0)
        self._watch(x[:, heard], e[:, heard], y)
        return y

    # ---- What comes in

    def _read(self, references: Any, errors: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return copies of references (I, n) and errors (K, n); what is missing is NaN."""
        if references is None and errors is None:
            raise ValueError("references or errors must be given: without both, the length of the block is not known")
        x = None if references is None else _channels(references, self.n_references, "references")
        e = None if errors is None else _channels(errors, self.n_microphones, "errors")
        lengths = {block.shape[1] for block in (x, e) if block is not None}
        if len(lengths) != 1 or 0 in lengths:
            found = " and ".join(map(str, sorted(lengths)))
            raise ValueError(f"references and errors must have the same number of samples, at least 1, got {found}")
        n = lengths.pop()
        return (
            np.full((self.n_references, n), np.nan) if x is None else x,
            np.full((self.n_microphones, n), np.nan) if e is None else e,
        )

    def _inspect(self, x: np.ndarray, e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what is missing of references and errors, (I + K, n), and which samples can be learned from, (n,).

        The bad ones are noted.
        """
        block = np.concatenate((x, e))
        repeated = self.blocks_can_repeat and is_repeated(block, self._last_block)
        self._last_block = block
        kinds = [inspector(block) for inspector, block in zip(self._inspectors, (x, e), strict=True)]
        for name, kind in zip(("reference", "error"), kinds, strict=True):
            if repeated:
                kind[kind == GOOD] = REPEATED
            self._note_kinds(name, kind)
        bad_x, bad_e = (np.any(kind != GOOD, axis=0) for kind in kinds)
        if self._modelled:  # the error is the next reference
            bad_x = bad_x | bad_e
        since, self._since_bad_reference = _samples_since(bad_x, self._since_bad_reference)
        usable = ~bad_x & ~bad_e & (since >= self.recovery_samples)
        self._count_unusable(usable)
        return np.isin(np.concatenate(kinds), ABSENT), usable

    def _as_wanted(self, e: np.ndarray, missing: np.ndarray) -> np.ndarray:
        """Return the errors (K, n) if all that the controller wanted had been played.

        The sound of this block does not count yet: an estimated path begins with at least a block of zeros. Where an
        error is missing, the disturbance is zero.
        """
        path = np.reshape(self.controller.secondary, (self.n_microphones, self.n_loudspeakers, -1))
        wanted, withheld = (
            through(path, np.pad(y, ((0, 0), (0, e.shape[1]))))
            for y in (self._wanted_y, self._wanted_y - self._played_y)
        )
        return np.where(missing, -wanted, e - withheld)

    def _note_kinds(self, name: str, kinds: np.ndarray) -> None:
        """Record the bad samples of a block."""
        for channel in np.flatnonzero(np.any(kinds != GOOD, axis=1)):
            for kind in sorted(set(kinds[channel].tolist()) - {GOOD}):
                where = np.flatnonzero(kinds[channel] == kind)
                begin, end = ((self._samples + int(n)) / self.fs for n in (where[0], where[-1] + 1))
                self.health.note(KINDS[kind], f"{name} {channel}", time_s=begin, n_samples=where.size, until_s=end)

    def _count_unusable(self, usable: np.ndarray) -> None:
        """Fade out if nothing was usable for long, and in again afterwards."""
        good = np.flatnonzero(usable)
        self._unusable = usable.size - 1 - int(good[-1]) if good.size else self._unusable + usable.size
        if self._unusable > self._mute_after and not self._paused_for_input and self._wanted:
            self._note("silent: no usable input")
            self._paused_for_input = True
        elif self._paused_for_input and self._unusable == 0:
            self._paused_for_input = False
            if self._target == 1.0:
                self._note("running again")

    # ---- The control signal

    def _control(self, x: np.ndarray, e: np.ndarray, usable: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the control signals of a block, (J, n), as the controller wants them, and faded."""
        n = x.shape[1]
        gains = self._gains(n)
        # The controller does not know that its output is faded: it must forget that before it adapts.
        since, self._since_fade = _samples_since(gains < 1.0, self._since_fade)
        self._silent_for = 0 if np.any(gains) else self._silent_for + n
        if not np.any(gains):
            self._listen(x, e, usable)
            wanted = np.zeros((self.n_loudspeakers, n))
        else:
            wanted = self._adapted(x, e, usable & (since >= self.recovery_samples))
        return np.where(np.isfinite(wanted), wanted, 0.0), self._finite(wanted * gains)

    def _gains(self, n: int) -> np.ndarray:
        """Return the gains of a block, which approach the target at a constant rate."""
        if self._gain == self._target:
            return np.full(n, self._gain)
        step = (1.0 if self._target > self._gain else -1.0) / self._fade
        gains = np.clip(self._gain + step * np.arange(1, n + 1), 0.0, 1.0)
        self._gain = float(gains[-1])
        return gains

    def _listen(self, x: np.ndarray, e: np.ndarray, usable: np.ndarray) -> None:
        """Let the controller follow the noise with silent loudspeakers, and count the pause."""
        if self._replacement_due:
            self._restart()
            self._replacement_due = False
        signals = [self._shaped(block) for block in (x, e)]
        try:
            if isinstance(self.controller, CoreController):
                self.controller.listen(*signals, adapt=usable)
            elif np.all(usable) and hasattr(self.controller, "listen"):
                self.controller.listen(*signals)
        except ValueError:
            self._note("refused", n_samples=x.shape[1])
        if self._waiting > 0:
            self._waiting = max(self._waiting - x.shape[1], 0)
            if self._target == 1.0:
                self._note("running again")

    def _adapted(self, x: np.ndarray, e: np.ndarray, adapt: np.ndarray) -> np.ndarray:
        """Return the controller's outputs, (J, n): zeros if it cannot go on."""
        y = np.zeros((self.n_loudspeakers, x.shape[1]))
        process: Any = getattr(self.controller, "process", None) or partial(process_steps, self.controller)
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                process(self._shaped(x), self._shaped(e), adapt=adapt, out=self._shaped(y))
        except Exception as error:  # noqa: BLE001 - whatever it is, the loudspeakers must not be left with it
            self._stop(f"diverged: {type(error).__name__}: {error}", at_once=True)
            return np.zeros_like(y)
        return y

    def _finite(self, y: np.ndarray) -> np.ndarray:
        """Return the control signals, with zeros from a value that is not finite on."""
        finite = np.isfinite(y).all(axis=0)
        if not finite.all():
            y[:, finite.argmin() :] = 0.0
            self._stop("diverged: not finite", at_once=True)
        return y

    def _limit(self, y: np.ndarray) -> None:
        """Clip the control signals to their limits."""
        limit = self.amplitude_limit[:, np.newaxis]
        counts = np.count_nonzero(np.abs(y) > limit, axis=1)
        self._adaptation.limited += counts
        np.clip(y, -limit, limit, out=y)
        for j in np.flatnonzero(counts):
            self._note("limited", f"loudspeaker {j}", n_samples=int(counts[j]))

    # ---- What comes of it

    def _watch(self, x: np.ndarray, e: np.ndarray, y: np.ndarray) -> None:
        """Add a block to the window; at its end, act if the adaptation has diverged, or if the noise is louder.

        `x` and `e` have the samples that were heard; `y` has all.
        """
        silent, running = self._silent_for - y.shape[1] >= self._dies_away, self._gain == self._target == 1.0
        watched = "silence" if silent else "control" if running else ""
        if watched != self._watched:
            self._watched = watched
            self._adaptation.begin()
            self._loudness.begin()
        if watched == "silence":
            self._hear_silence(x, e)
        elif watched == "control" and not self._hear_control(x, e) and self._adaptation.play(y):
            what = self._adaptation.judged(self.controller, self.largest_gain)
            if what:
                self._stop(f"diverged: {what}")

    def _hear_silence(self, x: np.ndarray, e: np.ndarray) -> None:
        """Note how loud the noise is without control; end the listening when that is known."""
        if not self._loudness.hear(x, e):
            return
        self._loudness.note_silence()
        if not (self._listening and self._loudness.full):
            return
        self._listening, suspected, self._suspected = False, self._suspected, None
        if suspected is not None and self._loudness.is_louder(suspected, self._loudness.ratio**0.5):
            self._stop("diverged: louder than without control")
        elif suspected is not None:
            self._note("the noise itself is louder")

    def _hear_control(self, x: np.ndarray, e: np.ndarray) -> bool:
        """Return whether the noise is louder than before control, and begin to listen without control if it is."""
        loudness = self._loudness
        if not (loudness.hear(x, e) and loudness.full and loudness.is_louder(loudness.windows, loudness.ratio)):
            return False
        self._note("louder than before control")
        self._listening, self._suspected = True, loudness.windows
        return True

    def _stop(self, why: str, at_once: bool = False) -> None:
        """Act on a divergence."""
        now = self._samples / self.fs
        if self.divergence_times_s and now - self.divergence_times_s[-1] > FORGOTTEN_S:
            self._pause = self._first_pause
        self.divergence_times_s.append(now)
        self._note(why)
        self._note("muted")
        self._waiting = self._pause
        self._replacement_due = True  # it goes on until it is silent
        if at_once:
            self._gain = 0.0
        self._pause = min(2 * self._pause, LONGEST_PAUSE * self._first_pause)
        self._since_bad_reference = 0
        self._listening, self._suspected = False, None
        self._adaptation.restart()

    def _note(self, what: str, channel: str = "", *, n_samples: int = 1) -> None:
        begin = self._samples / self.fs
        self.health.note(what, channel, time_s=begin, n_samples=n_samples, until_s=begin + n_samples / self.fs)

    def _shaped(self, block: np.ndarray) -> Any:
        """Return a block as the controller takes it: None for no channels."""
        if not len(block):
            return None
        return np.ascontiguousarray(block) if self.multichannel else block[0]


def _channels(value: Any, n_channels: int, name: str) -> np.ndarray:
    """Return a copy of a block as (n_channels, n_samples); None becomes NaN."""
    block = np.array(as_real_array(value, name))
    block = block[np.newaxis] if block.ndim == 1 and n_channels == 1 else block
    if block.ndim != 2 or len(block) != n_channels:
        wanted = {0: "None", 1: "(n_samples,)"}.get(n_channels, f"({n_channels}, n_samples)")
        raise ValueError(f"{name} must be {wanted} for this controller, got shape {block.shape}")
    return np.ascontiguousarray(block)


def _samples_since(bad: np.ndarray, before: int) -> tuple[np.ndarray, int]:
    """Return the number of good samples between the last bad one and each sample, and the number after the last.

    `before` is the number at the start.
    """
    index = np.arange(bad.size)
    last_bad = np.maximum.accumulate(np.where(bad, index, -1))
    since = np.where(last_bad < 0, before + index, index - last_bad - 1)
    return since, 0 if bad[-1] else int(since[-1]) + 1


def _limiters(controller: Any) -> tuple[OutputLimiter, ...]:
    """Return the limiters of a controller, one for each loudspeaker, or nothing."""
    limiter = getattr(controller, "limiter", None)
    limiters = limiter if isinstance(limiter, tuple) else (limiter,)
    return tuple(one for one in limiters if isinstance(one, OutputLimiter))


def _modelled_samples(controller: Any) -> int:
    """Return how many of its last control signals an internal model remembers, 0 without one."""
    if not getattr(controller, "internal_model", False):
        return 0
    if hasattr(controller, "physical"):
        raise ValueError(
            "controller must not have virtual microphones and an internal model: its paths are not those to the error "
            "microphones; let it run by its own process, without a supervisor"
        )
    return int(np.shape(controller.secondary)[-1]) - 1


def _remembered(controller: Any) -> int:
    """Return the number of samples for which a reference has an effect on what a controller learns."""
    path, n_taps = getattr(controller, "secondary", None), getattr(controller, "n_taps", None)
    if path is None or n_taps is None:
        return 0
    primary = getattr(controller, "primary_path", None)
    longest = n_taps if primary is None else max(n_taps, np.shape(primary)[-1])
    return int(longest + np.shape(path)[-1] + GUARD_TAPS)
