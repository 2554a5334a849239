"""A limiter behind any controller: the mean square of the output over a sliding window never exceeds the rated power.

Its energies are in units of the budget N rho_o, so that any rated power and any input stay within the range of a float.
A window's energy is this lap's sum and what the last lap still has in the window, as in `constraint`: sums of squares
only, started anew every N samples, so that rounding never accumulates.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from .._validate import as_number, as_positive, as_signal
from ..kernels.compiling import compiled, part
from ..kernels.records import new_record
from .constraint import DEFAULT_FS

DEFAULT_WINDOW_S = 0.1
LONGEST_WINDOW = 10**7  # samples, for which the margin for rounding is still 2e-9
# Found by search over tones, noises, bursts and level jumps, for the least mean (u - y)^2 with little distortion.
HORIZONS = 16  # spans ahead that the gain is planned for, evenly up to N
RESERVE = 0.02  # of the power; with it a tone whose periods do not fill the window keeps a constant gain
MEAN_TIME, LOUD_TIME, RELEASE_TIME, MEMORY = 1 / 40, 1 / 5, 1 / 8, 20.0  # time constants in windows
OVERSHOOT = 1.1  # the gain rises towards this much more than its aim and stops at it, so that it does reach 1
LOUDEST = 100.0  # amplitude planned for, over the most that can leave: what is louder is clipped, and soon forgotten
FLOOR = 1e-200  # of the budget: keeps estimates from denormal numbers, which are slow


class LimiterState(NamedTuple):
    """What `limit_sample` reads and advances.

    A lap is N samples. At position i of it, `laps_out` holds minus this lap's energy up to k for k < i, the last lap's
    energy from k on for k > i, and 0 at k = N: for any m <= N the energy of the last m samples is one sum. `laps_in`
    holds the same of what comes in.
    """

    numbers: np.ndarray  # record: settings, then what the samples change; see `_silent_state`
    horizons: np.ndarray  # (K,) samples, the last one N
    held: np.ndarray  # (K,) largest energy that lately came in a span of each horizon
    room: np.ndarray  # (K,) and the most that may leave in it
    laps_out: np.ndarray  # (N + 1,)
    laps_in: np.ndarray  # (N + 1,)
    squares: np.ndarray  # (N + 1,) this lap's output energies


@part()
def _aim(state, i, size):
    """The largest constant gain with which every horizon fits, if what comes is as bad as foreseen.

    In the next h samples comes at most what lately came in any h samples; no more than h times what is loud now;
    and, while the window is none worse than those known, no more than keeps it so.
    """
    numbers, held = state.numbers[0], state.held
    known = (1.0 + RESERVE) * numbers.known
    if numbers.arrived + state.laps_in[i + 1] > known:
        known = np.inf
    room = 1.0
    for j in range(held.size):
        h = state.horizons[j]
        before = i - h if i >= h else i - h + size + 1
        held[j] = max(held[j] * numbers.fade, numbers.arrived + state.laps_in[before], FLOOR)
        kept = i + h if i + h <= size else i + h - size - 1  # where the last N - h samples begin
        coming = min(held[j], h * numbers.loud, known - (numbers.arrived + state.laps_in[kept]))
        left = min(1.0 - (numbers.spent + state.laps_out[kept]), state.room[j])
        room = min(room, left / max(coming, FLOOR))
    return math.sqrt(max(room, 0.0))


@part()
def limit_sample(state, u):
    """Output y for the next input; NaN, with nothing changed, where u is not finite."""
    if not np.isfinite(u):
        return np.nan
    numbers = state.numbers[0]
    size, i = state.laps_out.size - 1, numbers.position
    energy = (min(abs(u), numbers.planned) * numbers.scale) ** 2
    numbers.arrived += energy
    state.laps_in[i] = -numbers.arrived
    numbers.mean = max(numbers.mean + numbers.attack * (energy - numbers.mean), FLOOR)
    numbers.loud = max(numbers.loud * numbers.calm, numbers.mean)
    aim, gain = _aim(state, i, size), numbers.gain
    numbers.gain = min(aim, gain + numbers.release * max(OVERSHOOT * aim - gain, 0.0))
    wanted = numbers.gain * u
    y = min(max(wanted, -numbers.limit), numbers.limit)
    square = (y * numbers.scale) ** 2
    left = numbers.budget - (numbers.spent + state.laps_out[i + 1])
    if square > left:  # the guarantee; all before is there to make this rare
        y = math.copysign(numbers.peak * math.sqrt(max(left, 0.0)), u)
        square = (y * numbers.scale) ** 2
    if y != wanted:
        numbers.clipped += 1
    numbers.spent += square
    state.laps_out[i], state.squares[i] = -numbers.spent, square
    numbers.position = i + 1
    if i + 1 == size:
        _start_lap(state, size)
    return y


@part()
def _start_lap(state, size):
    """The lap just done becomes the last one."""
    numbers = state.numbers[0]
    rest = 0.0
    for k in range(size - 1, 0, -1):
        rest += state.squares[k]  # summed anew, no differences: the guarantee rests on it
        state.laps_out[k] = rest
        state.laps_in[k] = numbers.arrived + state.laps_in[k - 1]
    numbers.position = 0
    numbers.spent = numbers.arrived = 0.0
    numbers.known = state.held[-1]


@compiled()
def _limit_one(state, u):
    return limit_sample(state, u)


@compiled(nogil=True)
def _limit_all(state, signal, out):
    for n in range(signal.size):
        out[n] = limit_sample(state, signal[n])


class OutputLimiter:
    r"""Limiter that keeps the output power of any controller within a hard rating, whatever comes in.

    Over every window of N = round(window_s fs) samples, zeros before the first one,

    .. math:: \frac{1}{N} \sum_{k=0}^{N-1} y^2(n-k) \le \rho_o, \qquad |y(n)| \le A.

    What plainly fits passes unchanged. What does not is scaled, before the budget of the window is used up, by a gain that
    keeps a tone a tone; only what even then does not fit is clipped. One sample in, one out, without delay: call it
    with a sample, or a compiled loop ``limit_sample(limiter.state, u)``.

    Parameters
    ----------
    rated_power : float
        Rated output power :math:`\rho_o` of the amplifier, a mean square: the average (thermal) rating.
    fs : float, default 16000
        Sample rate in Hz.
    window_s : float, default 0.1
        Averaging time of the rating in seconds, 1 to 10^7 samples.
    amplitude_limit : float, optional
        Peak rating A, where the amplifier has one; none by default. Noise is clipped at it; tones are scaled to it.

    Raises
    ------
    TypeError, ValueError
        A setting that is not a number in its range; NaN or Inf as input, with nothing changed.

    Notes
    -----
    *Bound.* With :math:`v = y^2 / (N \rho_o)` each output keeps to :math:`v(n) \le 1 - \sum_{k=1}^{N-1} v(n-k)`, or is
    zero where rounding makes the right side negative; then its window holds no more than the one before. So, by
    induction, no window exceeds 1. In floating point, of unit roundoff :math:`\epsilon = 2^{-53}`, the sum used has at
    most N terms, none negative, none kept for more than two laps, and no differences: it is at least
    :math:`(1-\epsilon)^{N-1}` times the exact one, after any number of samples. v comes of at most 11 roundings, the
    right side of one more. It begins with :math:`1 - 2 (N + 16) \epsilon` instead of 1, which is more than all that, so
    that the exact sum stays below 1. Squares that underflow add less than :math:`2^{-1000}`.

    *Gain.* Let :math:`B_h` be what the outputs still in the window h samples from now leave of the budget, and
    :math:`P_h` the energy to come by then. The largest gain that can be kept up is the least
    :math:`\sqrt{B_h / P_h}`, or 1. Foreseen is that the worst of some 20 windows comes again, but not louder than now.
    The gain falls at once and rises in an eighth of a window.

    *Transparency.* A signal none of whose windows has more than half of the rated power passes bit for bit (where there
    is an amplitude limit, it has to be :math:`4 \sqrt{\rho_o}` or more for this): then :math:`P_h \le 1/2 \le B_h`. So
    does a steady tone of up to 0.9 of the rated power, with five periods or more in a window. A louder one leaves with
    0.98 of it, less its ripple from window to window.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import OutputLimiter
    >>> from kfopc_filterpy.signals import tone
    >>> limiter = OutputLimiter(rated_power=1.0)
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
        fs: float = DEFAULT_FS,
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
        """Arrays that `limit_sample` advances."""
        return self._state

    @property
    def rated_power(self) -> float:
        """Rated output power. Another one takes another limiter: what has left was kept to this one."""
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
        """Peak rating, None where there is none."""
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
        """Output for the next input sample `u`."""
        return float(_limit_one(self._state, as_number(u, "u")))

    def process(self, signal: Any) -> np.ndarray:
        """Output (n,) for a whole signal (n,), or the next piece of one: as sample by sample, to the bit."""
        signal = as_signal(signal, "signal", min_length=0)
        out = np.empty(signal.size)
        _limit_all(self._state, signal, out)
        return out

    def reset(self) -> None:
        """Forget the past: what comes next is taken to follow zeros."""
        fresh = dict(position=0, clipped=0, spent=0.0, arrived=0.0, known=0.0, mean=FLOOR, loud=FLOOR, gain=1.0)
        for name, value in fresh.items():
            self._state.numbers[name] = value
        self._state.held[:] = FLOOR
        for lap in (self._state.laps_out, self._state.laps_in, self._state.squares):
            lap[:] = 0.0


def _silent_state(size: int, rated_power: float, amplitude_limit: float | None) -> LimiterState:
    """The settings of a limiter whose windows have `size` samples; the rest is left to `reset`."""
    peak = math.sqrt(size) * math.sqrt(rated_power)  # two roots: their product does not overflow
    limit = 2.0 * peak if amplitude_limit is None else min(amplitude_limit, 2.0 * peak)  # finite, for finite squares
    numbers = new_record(
        scale=1.0 / peak,
        peak=peak * (1.0 - 2.0**-50),  # so that a clipped sample's square, rounded, is within what was left
        budget=1.0 - (size + 16) * 2.0**-52,
        limit=limit,
        planned=LOUDEST * min(limit, peak),
        attack=1.0 - _kept(MEAN_TIME, size),
        calm=_kept(LOUD_TIME, size),
        fade=_kept(MEMORY, size),
        release=1.0 - _kept(RELEASE_TIME, size),
        position=0,
        spent=0.0,  # this lap's energy out
        arrived=0.0,  # and in
        mean=0.0,  # running mean of the energies in
        loud=0.0,  # its slowly falling maximum
        known=0.0,  # the largest energy of a window as it was held when the lap began
        gain=1.0,
        clipped=0,
    )
    spans = min(HORIZONS, size)
    horizons = np.arange(1, spans + 1) * size // spans
    room = np.ones(spans)
    if amplitude_limit is not None:
        sine = (limit / peak) ** 2 / 2.0  # power of one that peaks at the limit; a short span may have more of it
        room = np.clip(sine * (horizons + size / 16), FLOOR, 1.0)
        room[-1] = max(sine * size, FLOOR)
    room[-1] = min(room[-1], 1.0 - RESERVE)
    laps_out, laps_in, squares = np.zeros((3, size + 1))
    return LimiterState(numbers, horizons, np.zeros(spans), room, laps_out, laps_in, squares)


def _kept(windows: float, size: int) -> float:
    """Return the share that a time constant of so many windows keeps a sample."""
    return math.exp(-1.0 / (windows * size))
