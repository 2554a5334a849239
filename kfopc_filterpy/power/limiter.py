"""A limiter for any controller: the mean square of the output over a sliding window never exceeds the rated power.

Energies are in units of the budget N rho_o, so that any rated power and any input stay within the range of a float. The
energy of a window is the sum over this lap plus the part of the last lap that is still in the window, as in
`constraint`. Only squares are summed, and the sums restart every N samples, so rounding errors do not accumulate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from .._validate import as_number, as_positive, as_signal
from ..core.calls import in_parts, limit, limit_all
from ..core.library import constant

DEFAULT_WINDOW_S = 0.1
LONGEST_WINDOW = 10**7  # samples; the margin for rounding is then 2e-9 of the budget
# Found by a search over tones, noises, bursts and level jumps for the least mean (u - y)^2 with little distortion.
HORIZONS = 16  # future spans that the gain is planned for, evenly spaced up to N
RESERVE, FLOOR = constant("limiter_reserve"), constant("limiter_floor")  # of the budget, see limiter.c
MEAN_TIME, LOUD_TIME, RELEASE_TIME, MEMORY = 1 / 40, 1 / 5, 1 / 8, 20.0  # time constants in windows
LOUDEST = 100.0  # times the largest output: louder input is planned for as if it were this loud, to be forgotten soon


_SETTINGS = ("scale", "peak", "budget", "limit", "planned", "attack", "calm", "fade", "release", "size", "spans")
_CHANGING = ("position", "spent", "arrived", "average", "loud", "known", "gain", "clipped")
# The structure of the core, see anc.h. Spans of the window, by horizon: their length, the largest recent input energy
# in one, and the largest output energy allowed in one.
NUMBERS = np.dtype(
    [(name, np.float64) for name in (*_SETTINGS, *_CHANGING)]
    + [(f"{name}_{i}", np.float64) for name in ("horizon", "held", "room") for i in range(HORIZONS)]
)


class LimiterState(NamedTuple):
    """State that the core reads and updates.

    A lap is N samples. The rows of `laps`, N + 1 each, are the output energies, the input energies and this lap's
    output energies one by one; limiter.c says how they are used.
    """

    numbers: np.ndarray  # (1,) of NUMBERS: settings, then values that each sample updates
    laps: np.ndarray  # (3, N + 1)


class OutputLimiter:
    r"""Limiter that keeps the output power of any controller within a hard rating, for any input.

    Over every window of N = round(window_s fs) samples, with zeros before the first one,

    .. math:: \frac{1}{N} \sum_{k=0}^{N-1} y^2(n-k) \le \rho_o, \qquad |y(n)| \le A.

    A signal well within the rating passes unchanged. Any other is scaled before the budget of the window is used up, by
    a gain that leaves tones undistorted. Only samples that would still exceed the rating are clipped. There is no
    delay. Call the limiter with each sample.

    Parameters
    ----------
    rated_power : float
        Rated output power :math:`\rho_o` of the amplifier, a mean square: the average (thermal) rating.
    fs : float
        Sample rate in Hz.
    window_s : float, default 0.1
        Averaging time of the rating in seconds, 1 to 10^7 samples.
    amplitude_limit : float, optional
        Peak rating A of the amplifier; by default none. Noise is clipped at it; tones are scaled to it.

    Raises
    ------
    TypeError, ValueError
        A setting that is not a number in its range; NaN or Inf as input, with nothing changed.

    Notes
    -----
    *Bound.* Let :math:`v = y^2 / (N \rho_o)`. Each output satisfies :math:`v(n) \le 1 - \sum_{k=1}^{N-1} v(n-k)`. If
    rounding makes the right side negative, the output is zero, and its window holds no more than the one before. By
    induction, no window exceeds 1. In floating point with unit roundoff :math:`\epsilon = 2^{-53}`, the computed sum
    has at most N terms, none negative, none kept for more than two laps, and no differences. After any number of
    samples it is therefore at least :math:`(1-\epsilon)^{N-1}` times the exact sum. v results from at most 11 roundings
    and the right side from one more. The budget is :math:`1 - 2 (N + 16) \epsilon` instead of 1, a margin larger than
    all of these errors, so the exact sum stays below 1. Squares that underflow add less than :math:`2^{-1000}`.

    ``nox -s prove``, in a clone, has this checked by machines. For every window length, input and setting in range,
    Frama-C/WP proves that the limiter's algorithm, over real numbers, keeps the ring of the last N energies within its
    budget; that the ring is the last N outputs follows by hand, because each call overwrites the oldest one. A second
    machine-checked lemma and Gappa bound the rounding of IEEE arithmetic within the margin that the budget leaves, apart
    from underflow. Eva shows for a window of 16 samples and any bit pattern as input that the C has no undefined behaviour.

    *Gain.* Let :math:`B_h` be the part of the budget that is not used by the outputs still in the window h samples from
    now, and :math:`P_h` the input energy until then. The largest gain that can be sustained is the minimum of
    :math:`\sqrt{B_h / P_h}` over h, at most 1. The prediction of :math:`P_h` is the worst of some 20 past windows, but
    not louder than the present input. The gain falls at once and rises within an eighth of a window.

    *Transparency.* A signal passes bit for bit if no window of it has more than half of the rated power, because then
    :math:`P_h \le 1/2 \le B_h` (an amplitude limit, if there is one, must be at least :math:`4 \sqrt{\rho_o}`). So does
    a steady tone of up to 0.9 of the rated power that has at least five periods per window. A louder tone comes out
    with 0.98 of the rated power, less its ripple from window to window.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import OutputLimiter
    >>> from kfopc_filterpy.signals import tone
    >>> limiter = OutputLimiter(rated_power=1.0, fs=16000)
    >>> limiter(0.5)
    0.5
    >>> limiter.reset()
    >>> y = limiter.process(tone(400, 2.0, fs=16000, amplitude=8**0.5))  # four times the rated power
    >>> powers = np.mean(y.reshape(-1, 1600) ** 2, axis=1)
    >>> bool(np.all(powers <= 1.0)), round(float(powers[-1]), 3), round(limiter.gain, 3)
    (True, 0.98, 0.495)
    """

    def __init__(
        self,
        rated_power: float,
        *,
        fs: float,
        window_s: float = DEFAULT_WINDOW_S,
        amplitude_limit: float | None = None,
    ) -> None:
        self._rated_power = as_positive(rated_power, "rated_power")
        self._fs = as_positive(fs, "fs", unit="Hz")
        self._window_s = as_positive(window_s, "window_s", unit="s")
        self._amplitude_limit = None if amplitude_limit is None else as_positive(amplitude_limit, "amplitude_limit")
        size = round(min(self._window_s * self._fs, 2.0 * LONGEST_WINDOW))
        if not 1 <= size <= LONGEST_WINDOW:
            raise ValueError(
                f"window_s must be 1 to {LONGEST_WINDOW} samples, got {self._window_s:g} s, "
                f"{self._window_s * self._fs:.3g} at {self._fs:g} Hz; {'lengthen' if size < 1 else 'shorten'} it"
            )
        self._state = _silent_state(size, self._rated_power, self._amplitude_limit)
        self.reset()

    @property
    def state(self) -> LimiterState:
        """Arrays that the core updates."""
        return self._state

    @property
    def rated_power(self) -> float:
        """Rated output power; read-only, because past outputs were limited to it. Make a new limiter to change it."""
        return self._rated_power

    @property
    def fs(self) -> float:
        """Sample rate in Hz."""
        return self._fs

    @property
    def window_s(self) -> float:
        """Averaging time of the rated power in seconds."""
        return self._window_s

    @property
    def amplitude_limit(self) -> float | None:
        """Peak rating, or None."""
        return self._amplitude_limit

    @property
    def gain(self) -> float:
        """Gain last used, 0 to 1, before any clipping."""
        return float(self._state.numbers["gain"][0])

    @property
    def clipped(self) -> int:
        """Number of samples clipped since the start or the last `reset`."""
        return int(self._state.numbers["clipped"][0])

    def __call__(self, u: float) -> float:
        """Return the output for the next input sample `u`."""
        return limit(*self._places(), as_number(u, "u"))

    def process(self, signal: ArrayLike) -> np.ndarray:
        """Return the output (n,) for a `signal` (n,), or for its next piece; the same bits as sample by sample."""
        signal = as_signal(signal, "signal", min_length=0)
        out = np.empty(signal.size)
        in_parts(limit_all, self._places(), signal, out)
        return out

    def _places(self) -> tuple[int, int]:
        """Return where the core finds the arrays."""
        return self._state.numbers.ctypes.data, self._state.laps.ctypes.data

    def live_in(self, numbers: np.ndarray, laps: np.ndarray) -> None:
        """Go on in the arrays `numbers` and `laps` of a controller's block, which get the present numbers."""
        places = LimiterState(numbers.view(NUMBERS).reshape(1), laps)
        for own, place in zip(self._state, places, strict=True):
            place[...] = own
        self._state = places

    def move_out(self) -> None:
        """Go on in arrays of its own."""
        self._state = LimiterState(*(array.copy() for array in self._state))

    def follow(self, other: OutputLimiter) -> None:
        """Take over from another limiter of the same output: what that one has let through counts from now on.

        A limiter that has let nothing through itself goes on as the other one if its settings are the same. Otherwise
        the louder one of both counts in each sample, and if that exceeds the rated power, the output is zero until it
        does not.

        Parameters
        ----------
        other : OutputLimiter
            Limiter that was in use so far; it stays as it is. What it let through before its own window is not known.

        Raises
        ------
        TypeError
            An object that is not an `OutputLimiter`.
        """
        if not isinstance(other, OutputLimiter):
            raise TypeError(f"other must be an OutputLimiter, got {other!r}")
        own, played = self._state, self._played(other)
        if not np.any(played):
            return
        before = self._played(self)
        settings = [[one.numbers[name] for name in _SETTINGS] for one in (own, other.state)]
        if settings[0] == settings[1] and not np.any(before):
            for array, theirs in zip(own, other.state, strict=True):
                array[...] = theirs
            return
        # A complete lap of the louder ones; its sums, from each sample on, are those that `start_lap` in limiter.c
        # makes.
        squares = np.maximum(before, played)
        own.laps[2, :-1] = squares
        own.laps[:2, 1:-1] = np.cumsum(squares[::-1])[::-1][1:]
        own.laps[:2, [0, -1]] = 0.0
        own.numbers["position"] = own.numbers["spent"] = own.numbers["arrived"] = 0.0

    def _played(self, other: OutputLimiter) -> np.ndarray:
        """Return the energies that another limiter let through, (N,), oldest first, in units of this one's budget."""
        numbers, size = other.state.numbers, self._state.laps.shape[1] - 1
        squares = np.roll(other.state.laps[2, :-1], -int(numbers["position"][0]))[-size:]
        squares = squares * (self._state.numbers["scale"] / numbers["scale"]) ** 2
        return np.pad(squares, (size - squares.size, 0))

    def reset(self) -> None:
        """Forget the past, as if only zeros had come in."""
        numbers = self._state.numbers
        for name in _CHANGING:
            numbers[name] = 0.0
        numbers["average"] = numbers["loud"] = FLOOR
        numbers["gain"] = 1.0
        spans_of(numbers)[1, : int(numbers["spans"][0])] = FLOOR
        self._state.laps[:] = 0.0


def _silent_state(size: int, rated_power: float, amplitude_limit: float | None) -> LimiterState:
    """Return the state of a limiter with windows of `size` samples; `reset` completes it."""
    peak = math.sqrt(size) * math.sqrt(rated_power)  # two roots: their product does not overflow
    limit = 2.0 * peak if amplitude_limit is None else min(amplitude_limit, 2.0 * peak)  # squares stay finite
    spans = min(HORIZONS, size)
    settings = dict(
        scale=1.0 / peak,
        peak=peak * (1.0 - 2.0**-50),  # so that the rounded square of a clipped sample fits into what is left
        budget=1.0 - (size + 16) * 2.0**-52,
        limit=limit,
        planned=LOUDEST * min(limit, peak),
        attack=1.0 - _kept(MEAN_TIME, size),
        calm=_kept(LOUD_TIME, size),
        fade=_kept(MEMORY, size),
        release=1.0 - _kept(RELEASE_TIME, size),
        size=size,
        spans=spans,
    )
    numbers = np.zeros(1, NUMBERS)
    for name, value in settings.items():
        numbers[name] = value
    horizons = np.arange(1, spans + 1) * size // spans
    room = np.ones(spans)
    if amplitude_limit is not None:
        sine = (limit / peak) ** 2 / 2.0  # power of a sine that peaks at the limit; a short span may have more
        room = np.clip(sine * (horizons + size / 16), FLOOR, 1.0)
        room[-1] = max(sine * size, FLOOR)
    room[-1] = min(room[-1], 1.0 - RESERVE)
    spans_of(numbers)[0, :spans], spans_of(numbers)[2, :spans] = horizons, room
    return LimiterState(numbers, np.zeros((3, size + 1)))


def spans_of(numbers: np.ndarray) -> np.ndarray:
    """Return the lengths of the horizons, the energies held and the energies allowed, (3, HORIZONS), as a view."""
    return numbers.view(np.ndarray).view(np.float64).reshape(-1)[-3 * HORIZONS :].reshape(3, HORIZONS)


def _kept(windows: float, size: int) -> float:
    """Return the factor per sample of a decay whose time constant is `windows` windows."""
    return math.exp(-1.0 / (windows * size))


Limiters: TypeAlias = OutputLimiter | Sequence[OutputLimiter] | None  # with several loudspeakers one for each
