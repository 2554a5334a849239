"""Settings of a Kalman controller from a recording made while the loudspeakers are silent."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._validate import as_count, as_positive
from ..paths.least_squares import RANK_TOLERANCE
from ..plant import Plant, as_constant_plant, checked_signals, has_one_channel
from .power_constrained import record_of_any
from .wiener import ERROR_THAT_MATTERS, Record, mean_square, reduction_db

# A longer memory leaves less error in a steady noise, and a shorter one follows changes: of a motor's speed, and of the
# constraint factor when the noise gets louder or softer. This one costs less than half a decibel, see
# tests/bounds/test_settings.py.
DEFAULT_MEMORY_S = 0.25
LONGEST = 256
GAIN_THAT_MATTERS_DB = 0.1
MULTIPLE = 8  # lengths are rounded up to it
SAMPLES_PER_TAP = 10  # of the record, at least; fewer would fit too much by chance
SMALLEST_POWER = 1e-60  # of a signal; the settings of softer and of louder ones would not be numbers
BURST_S = 0.01  # powers over this time show whether a noise is impulsive
LITTLE = 0.5  # if a larger share of the disturbance's power is left, the reasons say where to look for the cause
NOTABLY_LONGER = 1.2


@dataclass(frozen=True)
class SuggestedSettings:
    """Settings of `kf_anc`, `kf_opc` and `kf_pb`, with the reason for each; made by `suggest_settings`.

    ``print(suggested)`` explains all of them.

    Attributes
    ----------
    n_taps : int
        Taps L of the control filter.
    measurement_noise, state_noise, initial_variance : float
        q, r and P0.
    fs : float
        Sample rate of the signals in Hz.
    reasons : mapping of str to str
        A sentence on each of the four settings, by its name.
    """

    n_taps: int
    measurement_noise: float
    state_noise: float
    initial_variance: float
    fs: float
    reasons: Mapping[str, str]

    @property
    def noises(self) -> dict[str, float]:
        """Keyword arguments r, q and P0 of a filter: ``kf_opc(s.n_taps, plant, rated_power=1.0, **s.noises)``."""
        return {name: getattr(self, name) for name in ("state_noise", "measurement_noise", "initial_variance")}

    def __repr__(self) -> str:
        values = ", ".join(f"{name}={value:.3g}" for name, value in self.noises.items())
        return f"<SuggestedSettings: n_taps={self.n_taps}, {values}, at {self.fs:g} Hz>"

    def __str__(self) -> str:
        lines = []
        for name, value in {"n_taps": self.n_taps, **self.noises}.items():
            lines.append(f"{name} = {value:.3g}")
            lines += textwrap.wrap(self.reasons[name], 100, initial_indent="    ", subsequent_indent="    ")
        return "\n".join(lines)


def suggest_settings(
    reference: ArrayLike,
    plant: Plant,
    *,
    disturbance: ArrayLike | None = None,
    memory_s: float = DEFAULT_MEMORY_S,
    n_taps: int | None = None,
    max_taps: int = LONGEST,
) -> SuggestedSettings:
    r"""Return the length L and the settings q, r and P0 that suit a noise, with the reason for each.

    The signals are those of a silent run: the noise runs, the loudspeakers do not. A few seconds are enough if they
    contain what the noise usually does.

    Parameters
    ----------
    reference : array_like, shape (n_samples,) or (I, n_samples)
        Reference x of the silent run.
    plant : Plant
        Plant with the estimated secondary path. Its sensor noise counts, too: it is part of q.
    disturbance : array_like, shape (n_samples,) or (K, n_samples), optional
        Signal of the error microphone, the disturbance d, in place of the plant's primary path. Leave out its start-up
        transient. It contains the microphone's noise.
    memory_s : float, default 0.25
        Memory of the filter in seconds. A longer one leaves less error, a shorter one follows changes of the noise and
        of the paths faster.
    n_taps : int, optional
        Length L of the control filter, if you have chosen it. By default it follows from the signals.
    max_taps : int, default 256
        Longest control filter to consider. The cost per sample grows with the square of the length.

    Returns
    -------
    SuggestedSettings
        The settings: `n_taps` and `noises` are arguments of `kf_anc` and `kf_opc`.

    Raises
    ------
    TypeError, ValueError
        If the signals differ in length, are too short, silent or not finite; if their channels do not fit the plant;
        if a setting is out of range.

    See Also
    --------
    fit_noise : noises of any filter by maximum likelihood. That is for models whose noises are real; the settings here
        are for a control filter, whose state noise r is chosen for a memory.
    wiener_solution : the best fixed filter.
    causality_margin : whether the paths leave enough time.
    coherence_bound : how much the reference explains.

    Notes
    -----
    :math:`J(L)` is the error power of the best fixed filter of L taps over the N samples of the record, and M the memory
    in samples.

    - L is the shortest length, rounded up to a multiple of 8, at which
      :math:`J'(L)\, \frac{N}{N - L}\, (1 + \frac{L}{M})` is within 0.1 dB of its least value. :math:`J' = J` plus
      :math:`q/(M P_0)\, \|w\|^2` at the best w (with q and :math:`P_0` of the longest filter), because a Kalman filter
      does not learn within M samples what needs larger weights. The first fraction corrects for what L weights fit by
      chance. The second one is the price of forgetting: for a white filtered reference, P settles at
      :math:`\sqrt{rq/E[x'^2]}` in each direction, and so the error power is :math:`qL/M` above q.
    - :math:`q = J(L)\, N / (N - L)`, but at least -60 dB of the disturbance, because a microphone is hardly ever
      quieter, and at least the power of the plant's sensor noise. If the plant's primary path gives d, that power is
      added to J and to :math:`E[d^2]`.
    - :math:`r = q / (k\, E[x'^2] M^2)`. If the noise comes in bursts, so does what no filter explains, and it disturbs
      the weights when the filter's gain is largest. The memory is then lengthened by :math:`\sqrt{k}`: k is the mean
      square of the power over 10 ms, divided by that of the power over the memory. It is 1 for a steady noise.
    - :math:`P_0 = E[d^2] / (L\, E[x'^2])`: with independent weights of this variance and a white filtered reference,
      the anti-noise is as strong as the disturbance.

    With several channels, J and :math:`E[d^2]` are means over the K microphones and :math:`E[x'^2]` is the mean over
    loudspeakers and references of the sum over microphones, whose measurements inform the same weights. The fractions
    of L are multiplied by J I / K, the weights per tap and microphone. :math:`P_0` then is
    :math:`K E[d^2] / (J I L\, E[x'^2])`. `kf_pb` takes only the length and the sample
    rate.

    Directions of the weights with less than 1e-11 of the energy do not count, as in `wiener_solution`. q contains
    neither what a clipping amplifier cuts off nor the errors of the path estimate, which a silent run does not show.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import Plant, kf_opc, suggest_settings
    >>> rng = np.random.default_rng(0)
    >>> x = rng.standard_normal(32000)
    >>> d = np.convolve(x, [0.0] * 19 + [1.0, 0.5])[:32000] + 0.1 * rng.standard_normal(32000)
    >>> plant = Plant([0.0, 0.0, 0.8], fs=16000)
    >>> suggested = suggest_settings(x, plant, disturbance=d)
    >>> suggested
    <SuggestedSettings: n_taps=24, state_noise=9.77e-10, measurement_noise=0.01, initial_variance=0.0821, at 16000 Hz>
    >>> print(suggested.reasons["state_noise"])
    the filter averages over 0.25 s; that costs up to 0.03 dB, and a shorter memory follows changes faster
    >>> kf_opc(suggested.n_taps, plant, rated_power=1.0, **suggested.noises).name
    'KF-OPC'
    """
    as_constant_plant(plant, "suggest_settings")
    fs = plant.fs
    memory = as_positive(memory_s, "memory_s", unit="s") * fs
    fit = _Fits(*checked_signals(plant, reference, disturbance), plant, n_taps, max_taps)
    sensor_noise = plant.sensor_noise_std**2
    unheard = sensor_noise if disturbance is None else 0.0  # a recording has it
    longest, d_power, filtered_power = fit.stretch.n_taps, mean_square(fit.stretch.d) + unheard, fit.filtered_power
    errors, quietest = fit.error_powers(0.0) + unheard, max(ERROR_THAT_MATTERS * d_power, sensor_noise)
    if n_taps is None:
        learned = max(float(errors[-1]), quietest) * longest * fit.per_tap * filtered_power  # q / (M P0), and below
        reached = np.maximum(fit.error_powers(learned / (memory * d_power * fit.n_microphones)) + unheard, quietest)
        costs = reached * (1 + fit.crowding * np.arange(1, longest + 1) / memory)
        enough = int(np.argmax(costs <= costs.min() * 10 ** (GAIN_THAT_MATTERS_DB / 10))) + 1  # the shortest length
        taps = min(-(-enough // MULTIPLE) * MULTIPLE, longest)
    else:
        taps = longest
    q = max(float(errors[taps - 1]), quietest)
    lengthened = memory * np.sqrt(_burstiness(fit.stretch.filtered, fs, memory))
    initial_variance = d_power / (taps * fit.crowding * filtered_power)
    return SuggestedSettings(
        n_taps=taps,
        measurement_noise=q,
        state_noise=float(q / (filtered_power * lengthened**2)),
        initial_variance=initial_variance,
        fs=fs,
        reasons={
            "n_taps": _why_length(errors, taps, d_power, n_taps, max_taps),
            "measurement_noise": _why_noise(
                errors[taps - 1], taps, d_power, fit.stretch.d.shape[-1] / fs, sensor_noise
            ),
            "state_noise": _why_memory(memory / fs, lengthened / fs, fit.crowding * taps / lengthened),
            "initial_variance": (
                f"{fit.variance_rule} with E[d^2] = {d_power:.3g} and E[x'^2] = {filtered_power:.3g}: independent "
                "weights of this variance would make an anti-noise as strong as the disturbance"
            ),
        },
    )


class _Fits:
    """Fixed filters of 1, 2, ... taps, fitted to one record."""

    def __init__(self, x: np.ndarray, d: np.ndarray, plant: Plant, n_taps: int | None, max_taps: int) -> None:
        K, J, n_path = plant.secondary.shape
        self.n_microphones, self.per_tap = K, J * len(x)
        longest = _longest(x.shape[-1], n_path, n_taps, max_taps, self.crowding)
        self.stretch: Record = record_of_any(x, d, plant, longest).full(n_path)
        one = has_one_channel(plant, x)
        self.variance_rule = "E[d^2] / (L E[x'^2])" if one else "K E[d^2] / (J I L E[x'^2])"
        self.filtered_power = self.stretch.filtered_power / self.per_tap
        powers = {"the filtered reference": self.filtered_power, "disturbance": mean_square(self.stretch.d)}
        for name, power in powers.items():
            if not SMALLEST_POWER <= power <= 1.0 / SMALLEST_POWER:
                raise ValueError(
                    f"{name} must have a mean square from {SMALLEST_POWER:g} to {1.0 / SMALLEST_POWER:g}, got {power:.3g}: "
                    "scale the signals"
                )
        correlations: Any = self.stretch.correlations()
        size, shape = correlations.cross.size, (self.per_tap, self.stretch.n_taps)
        # Taps of one delay side by side: then the matrix of a shorter filter is the first part of that of a longer one.
        self._filtered = correlations.filtered.reshape(*shape, *shape).transpose(1, 0, 3, 2).reshape(size, size)
        self._cross = correlations.cross.reshape(shape).T.ravel()

    @property
    def crowding(self) -> float:
        """Weights per tap and microphone: 1 for one channel."""
        return self.per_tap / self.n_microphones

    def error_powers(self, ridge: float) -> np.ndarray:
        """Return the error power of the best filter of 1, 2, ... taps, per microphone, corrected for what fits by chance.

        With a ridge, the error power includes ridge |w|^2. All lengths are fitted to the same samples, so each
        correlation matrix is the first part of the largest, and its Cholesky factor too: one triangular system solves
        all lengths.
        """
        from scipy.linalg import cholesky, solve_triangular

        n_taps, n_samples = self.stretch.n_taps, self.stretch.d.shape[-1]
        matrix = self._filtered.copy()
        least = RANK_TOLERANCE * n_taps * self.stretch.filtered_power  # the trace bounds the largest eigenvalue
        matrix.flat[:: len(matrix) + 1] += max(ridge, least)
        factor = cholesky(matrix, lower=True, overwrite_a=True)
        parts = solve_triangular(factor, self._cross, lower=True) ** 2
        explained = np.cumsum(parts)[self.per_tap - 1 :: self.per_tap] / self.n_microphones
        left = np.maximum(mean_square(self.stretch.d) - explained, 0.0)
        return left * n_samples / (n_samples - self.crowding * np.arange(1, n_taps + 1))


def _longest(n_samples: int, n_path: int, n_taps: int | None, max_taps: int, crowding: float) -> int:
    """Return the longest control filter to fit: the given one, or the longest that the record supports."""
    max_taps = as_count(max_taps, "max_taps")
    per_tap = math.ceil(SAMPLES_PER_TAP * max(crowding, 1.0)) + 1  # samples with full delay lines for each weight
    supported = (n_samples - n_path + 2) // per_tap
    wanted = 1 if n_taps is None else as_count(n_taps, "n_taps")
    if supported < wanted:
        needed = n_path - 2 + per_tap * wanted
        raise ValueError(
            f"reference must have at least {needed} samples for {wanted} control and {n_path} path taps, got {n_samples}; "
            f"{f'choose at most {supported} control taps, or ' if supported > 0 else ''}record a longer silent run"
            f"{', or cut the impulse response' if 2 * n_path > n_samples else ''}"
        )
    return min(max_taps, supported) if n_taps is None else wanted


def _burstiness(filtered: np.ndarray, fs: float, memory: float) -> float:
    """Return the mean square of the power over 10 ms, divided by that of the power over the memory; at least 1."""
    block = max(round(BURST_S * fs), 1)
    blocks = max(min(round(memory / block), filtered.shape[-1] // block), 1)  # in a memory
    squares = np.sum(filtered.reshape(-1, filtered.shape[-1]) ** 2, axis=0)
    whole = squares[: squares.size // (blocks * block) * blocks * block]
    if not np.any(whole):
        return 1.0
    powers = np.mean(whole.reshape(-1, blocks, block), axis=2)
    return float(np.mean(powers**2) / np.mean(powers.mean(axis=1) ** 2))


def _why_length(errors: np.ndarray, taps: int, d_power: float, n_taps: int | None, max_taps: int) -> str:
    def reach(n: int) -> str:
        return f"{max(reduction_db(errors[n - 1], d_power), 0.0):.1f} dB"

    reached = f"the best fixed filter of this length reduces the noise by {reach(taps)}"
    if n_taps is not None:
        reason = f"as given; {reached}"
    elif taps < errors.size:
        reason = f"{reached}, and a longer one of up to {errors.size} taps gains less than {GAIN_THAT_MATTERS_DB:g} dB"
    else:
        limit = "the longest that is tried" if errors.size == max_taps else "as long as this record supports"
        reason = f"{limit}; {reached}, one of half the length by {reach(-(-taps // 2))}"
    if errors[taps - 1] > LITTLE * d_power:
        reason += "; if that is too little, the causality margin and the coherence tell the cause"
    return reason


def _why_noise(error_power: float, taps: int, d_power: float, record_s: float, sensor_noise: float) -> str:
    if max(error_power, ERROR_THAT_MATTERS * d_power) < sensor_noise:
        return f"the power of the plant's sensor noise, which is more than the {error_power:.3g} found in the record"
    if error_power < ERROR_THAT_MATTERS * d_power:
        level = -10 * np.log10(ERROR_THAT_MATTERS)
        return f"{level:.0f} dB below the disturbance's power of {d_power:.3g}: a microphone is hardly ever quieter"
    level = max(reduction_db(error_power, d_power), 0.0)
    noise = f", the plant's sensor noise of {sensor_noise:.3g} included" if sensor_noise else ""
    return (
        f"the power that the best fixed filter of {taps} taps leaves in {record_s:.3g} s of the record{noise}, "
        f"{level:.1f} dB below the disturbance's power of {d_power:.3g}"
    )


def _why_memory(memory_s: float, lengthened_s: float, taps_per_memory: float) -> str:
    reason = f"the filter averages over {memory_s:.3g} s"
    if lengthened_s > NOTABLY_LONGER * memory_s:
        reason += f", lengthened to {lengthened_s:.3g} s because the noise comes in bursts"
    return f"{reason}; that costs up to {10 * np.log10(1 + taps_per_memory):.2f} dB, and a shorter memory follows changes faster"
