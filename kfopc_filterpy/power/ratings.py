r"""Ratings as data sheets have them, and what they allow a control signal: a mean power, a peak, an excursion.

A control signal y is in units of its own; one unit is `volts_per_unit` volts at the amplifier's output. With the
impedance R in ohm, a power of P watts is the mean square

.. math:: \rho_o = \frac{P R}{\mathrm{volts\_per\_unit}^2}

of the control signal. This is the rated power of every controller. Data sheets state watts that were measured with
different signals:

========== ===================================================================== ============
rating     what it says                                                          crest factor
========== ===================================================================== ============
sine       power of a continuous sine                                            sqrt(2)
noise      power of band-limited, shaped noise that is clipped to its crest      2
           factor; IEC 60268-5 calls it rated noise power, AES2 the power
           rating
programme  twice the noise power: the size of amplifier that is recommended for  2
           music. It is a convention of manufacturers, not a test
peak volts largest voltage
========== ===================================================================== ============

The crest factor is peak over rms. An amplifier whose rating was measured with a sine clips at :math:`\sqrt{2 P R}`, and
one rated with noise at :math:`\sqrt{4 P R}`.

Sources: IEC 60268-5 (sound system equipment, loudspeakers) for rated noise power and rated sinusoidal power; AES2-2012
(methods of measuring and specifying the performance of loudspeakers) for noise of crest factor 2 and for power over the
smallest impedance of the band; IEC 60268-3 for amplifiers. The texts of these standards are sold, and their clauses
could not be read for this page: it rests on what data sheets and textbooks say of them, and gives no clause numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from .._types import NumberOrArray
from .._validate import as_positive, as_real_array, as_signal, require_finite
from .limiter import DEFAULT_WINDOW_S, OutputLimiter

SINE_CREST, NOISE_CREST = math.sqrt(2.0), 2.0
PROGRAMME_OVER_NOISE = 2.0
THERMAL_WINDOW_S = 10.0  # shorter than the seconds to minutes in which a voice coil and its magnet heat up


@dataclass(frozen=True)
class OutputLimits:
    """What a rating allows a control signal, in units of the control signal; see `output_limits`.

    Attributes
    ----------
    rated_power : float
        Rated power: largest mean square.
    amplitude_limit : float or None
        Largest magnitude; None if there is no limit.
    window_s : float
        Time in seconds over which the mean square counts.
    decided_by : str
        Which rating the rated power comes from.
    """

    rated_power: float
    amplitude_limit: float | None = None
    window_s: float = DEFAULT_WINDOW_S
    decided_by: str = "rated power"

    def limiter(self, fs: float) -> OutputLimiter:
        """Return a limiter that keeps these limits at a sample rate `fs` in Hz, whatever the controller asks for."""
        return OutputLimiter(self.rated_power, fs=fs, window_s=self.window_s, amplitude_limit=self.amplitude_limit)


class _Rating:
    """What ratings of amplifiers and of loudspeakers have in common."""

    ohm: Any
    peak_volts: float | None
    volts_per_unit: float | None

    @property
    def volts(self) -> float:
        """Volts for a control signal of 1; 1 if they are not known."""
        return 1.0 if self.volts_per_unit is None else self.volts_per_unit

    def _check_optional(self, **units: str) -> None:
        """Raise an error if one of these, by its unit, is given and not a positive number."""
        for name, unit in units.items():
            if getattr(self, name) is not None:
                as_positive(getattr(self, name), name, unit=unit)

    def _given(self, *names: str) -> list[str]:
        """Return which of these are given."""
        return [name for name in names if getattr(self, name) is not None]

    def _mean_square(self, watts: float | None) -> float:
        """Return the rated power from the watts, or from the peak voltage if there are none; Inf if there is neither."""
        if watts is not None:
            return watts * self.ohm / self.volts**2
        return math.inf if self.peak_volts is None else (self.peak_volts / self.volts) ** 2 / 2.0

    def watt(self, power: NumberOrArray) -> NumberOrArray:
        """Return the watts of a mean square `power` of the control signal."""
        return power * self.volts**2 / self.ohm


@dataclass(frozen=True)
class AmplifierRating(_Rating):
    """Rating of an amplifier: a power into a resistance, a peak voltage, or both.

    Parameters
    ----------
    ohm : float
        Resistance in ohm that the power was measured with, or the loudspeaker's nominal impedance.
    sine_watt : float, optional
        Power of a continuous sine in W. Most amplifiers are rated so; take this one if the data sheet does not say.
    noise_watt : float, optional
        Power of noise with a crest factor of 2 in W, in place of `sine_watt`.
    peak_volts : float, optional
        Voltage at which the amplifier clips. By default it follows from the power and its crest factor. Without a power,
        the power is that of the sine that peaks at this voltage.
    volts_per_unit : float, optional
        Volts at the amplifier's output for a control signal of 1. If they are not known, 1 V is assumed, and a verdict
        does not state watts.

    Raises
    ------
    TypeError, ValueError
        Neither or both of the powers and no peak voltage; a number that is not above zero.

    Examples
    --------
    >>> from kfopc_filterpy.power import AmplifierRating
    >>> rating = AmplifierRating(ohm=8.0, sine_watt=20.0, volts_per_unit=10.0)
    >>> print(f"rated power {rating.rated_power:.2f}, clips at {rating.amplitude_limit:.3f}")
    rated power 1.60, clips at 1.789
    >>> AmplifierRating(ohm=8.0, noise_watt=20.0, volts_per_unit=10.0).amplitude_limit.__format__(".2f")
    '2.53'
    >>> rating.watt(0.8)
    10.0
    """

    ohm: float
    sine_watt: float | None = None
    noise_watt: float | None = None
    peak_volts: float | None = None
    volts_per_unit: float | None = None

    def __post_init__(self) -> None:
        as_positive(self.ohm, "ohm", unit="ohm")
        self._check_optional(sine_watt="W", noise_watt="W", peak_volts="V", volts_per_unit="V")
        given = self._given("sine_watt", "noise_watt")
        if len(given) > 1 or (not given and self.peak_volts is None):
            raise ValueError(
                f"an amplifier's rating must have sine_watt or noise_watt, or else peak_volts, got "
                f"{' and '.join(given) or 'none of them'}; if the data sheet does not say, give sine_watt"
            )

    @property
    def rated_power(self) -> float:
        """Rated power ρ_o, the largest mean square of the control signal."""
        return self._mean_square(self.noise_watt if self.sine_watt is None else self.sine_watt)

    @property
    def amplitude_limit(self) -> float:
        """Magnitude of the control signal at which the amplifier clips."""
        if self.peak_volts is not None:
            return self.peak_volts / self.volts
        crest = SINE_CREST if self.noise_watt is None else NOISE_CREST
        return crest * math.sqrt(self.rated_power)

    @property
    def limits(self) -> OutputLimits:
        """Limits of the control signal; the mean power counts over windows of 100 ms."""
        return OutputLimits(self.rated_power, self.amplitude_limit, DEFAULT_WINDOW_S, "amplifier")


@dataclass(frozen=True, eq=False)
class LoudspeakerRating(_Rating):
    r"""Rating of a loudspeaker: the heat that its voice coil bears, and how far its cone may move.

    The thermal rating is a mean over seconds. It becomes the rated power of a controller and a long window of the
    limiter. The excursion becomes a rated power too: the displacement is h * y, with the displacement response h, and
    `excursion_rated_power` says which power a control signal may have so that its displacement stays within the limit.
    KF-PB has no further constraint on h * y: it would need a second weight beside λ, and correlations of h * x for each
    pair of taps.

    Parameters
    ----------
    ohm : float or pair of array_like
        Nominal impedance in ohm, or a curve: frequencies in Hz and magnitudes in ohm, each (n_points,). Of a curve the
        smallest value counts, as AES2 has it; the actual power is never above this voltage squared over it.
    noise_watt : float, optional
        Rated noise power in W (IEC 60268-5, AES2).
    sine_watt : float, optional
        Rated sinusoidal power in W.
    programme_watt : float, optional
        Programme power in W. Its half counts as noise power.
    peak_volts : float, optional
        Largest voltage in V.
    x_max_mm : float, optional
        Largest excursion of the cone from its rest position in mm, one way.
    displacement_mm_per_volt : float or pair of array_like, optional
        Excursion per volt in mm/V: one number, or a curve: frequencies in Hz and magnitudes in mm/V, each (n_points,),
        constant beyond its ends. It is needed with `x_max_mm`.
    excursion_crest_factor : float, default 2
        Peak over rms of the displacement that is expected: sqrt(2) for a tone, 2 for noise that is clipped.
    thermal_window_s : float, default 10
        Time in seconds over which the mean power counts.
    volts_per_unit : float, optional
        Volts at the loudspeaker for a control signal of 1, as for an `AmplifierRating`.

    Raises
    ------
    TypeError, ValueError
        No rating or two powers; an excursion without a displacement response, or the reverse; a number that is not above
        zero; a curve whose frequencies do not rise.

    Examples
    --------
    A 30 W loudspeaker of 6 ohm at its minimum, with 3 mm of excursion and a resonance at 80 Hz:

    >>> import numpy as np
    >>> from kfopc_filterpy.power import LoudspeakerRating
    >>> f = np.array([20.0, 50.0, 80.0, 160.0, 320.0, 640.0])
    >>> rating = LoudspeakerRating(
    ...     ohm=(f, [7.0, 12.0, 40.0, 9.0, 6.0, 8.0]), noise_watt=30.0, x_max_mm=3.0,
    ...     displacement_mm_per_volt=(f, 0.4 / np.sqrt((1 - (f / 80) ** 2) ** 2 + (f / 80) ** 2)),
    ... )
    >>> rating.rated_power
    180.0
    >>> t = np.arange(16000) / 16000
    >>> for hz in (80, 320):  # what a tone may have before the cone moves too far
    ...     print(f"{hz} Hz: {rating.excursion_rated_power(np.sin(2 * np.pi * hz * t), 16000):.0f} V^2")
    80 Hz: 14 V^2
    320 Hz: 3389 V^2
    """

    ohm: Any
    noise_watt: float | None = None
    sine_watt: float | None = None
    programme_watt: float | None = None
    peak_volts: float | None = None
    x_max_mm: float | None = None
    displacement_mm_per_volt: Any = None
    excursion_crest_factor: float = NOISE_CREST
    thermal_window_s: float = THERMAL_WINDOW_S
    volts_per_unit: float | None = None
    _curve: tuple[np.ndarray, np.ndarray] | None = field(init=False, repr=False, compare=False, default=None)

    def __post_init__(self) -> None:
        object.__setattr__(self, "ohm", float(np.min(as_curve(self.ohm, "ohm", "ohm")[1])))
        units = {"noise_watt": "W", "sine_watt": "W", "programme_watt": "W", "peak_volts": "V", "x_max_mm": "mm"}
        self._check_optional(**units, volts_per_unit="V")
        for name in ("excursion_crest_factor", "thermal_window_s"):
            as_positive(getattr(self, name), name)
        powers = self._given("noise_watt", "sine_watt", "programme_watt")
        if len(powers) > 1 or not (powers or self.peak_volts is not None or self.x_max_mm is not None):
            raise ValueError(
                "a loudspeaker's rating must have one of noise_watt, sine_watt and programme_watt, or else peak_volts or "
                f"x_max_mm, got {' and '.join(powers) or 'none of them'}; take noise_watt if the data sheet has it"
            )
        if (self.x_max_mm is None) != (self.displacement_mm_per_volt is None):
            raise ValueError(
                "x_max_mm and displacement_mm_per_volt must be given together: the excursion limit needs to know how far "
                "a volt moves the cone"
            )
        if self.displacement_mm_per_volt is not None:
            curve = as_curve(self.displacement_mm_per_volt, "displacement_mm_per_volt", "mm/V")
            object.__setattr__(self, "_curve", curve)

    @property
    def rated_power(self) -> float:
        """Rated power ρ_o from the watts, or from the peak voltage if there are none; Inf if there is neither."""
        if self.programme_watt is not None:
            return self._mean_square(self.programme_watt / PROGRAMME_OVER_NOISE)
        return self._mean_square(self.noise_watt if self.sine_watt is None else self.sine_watt)

    @property
    def amplitude_limit(self) -> float | None:
        """Largest magnitude of the control signal, or None: a loudspeaker's watts do not limit its peaks."""
        return None if self.peak_volts is None else self.peak_volts / self.volts

    @property
    def limits(self) -> OutputLimits:
        """Limits of the control signal without the excursion; the mean power counts over `thermal_window_s`."""
        return OutputLimits(self.rated_power, self.amplitude_limit, self.thermal_window_s, "loudspeaker's power")

    def displacement_mm(self, control_signal: ArrayLike, fs: float) -> np.ndarray:
        """Return the displacement h * y of the cone in mm, (n_samples,), at a sample rate `fs` in Hz.

        The response of zero phase is applied to the whole `control_signal`, (n_samples,), as if it repeated: rms values
        are right for any phase, peaks nearly so.
        """
        if self._curve is None:
            raise ValueError("displacement_mm needs a rating with displacement_mm_per_volt")
        y = as_signal(control_signal, "control_signal")
        frequencies = np.fft.rfftfreq(y.size, 1.0 / as_positive(fs, "fs", unit="Hz"))
        response = np.interp(frequencies, *self._curve) * self.volts
        return np.fft.irfft(np.fft.rfft(y) * response, y.size)

    def excursion_rated_power(self, control_signal: ArrayLike, fs: float) -> float:
        """Return the largest mean square that a signal of this spectrum may have for the excursion; Inf without a limit.

        The mean square of h * y is then that of a displacement that peaks at `x_max_mm` with `excursion_crest_factor`.
        A silent signal has no limit.

        Parameters
        ----------
        control_signal : array_like, shape (n_samples,)
            Control signal y; only its spectrum counts, not its level.
        fs : float
            Sample rate in Hz.
        """
        if self.x_max_mm is None:
            return math.inf
        moved = float(np.mean(self.displacement_mm(control_signal, fs) ** 2))
        power = float(np.mean(np.asarray(control_signal, dtype=np.float64) ** 2))
        if moved == 0.0:
            return math.inf
        return power * (self.x_max_mm / self.excursion_crest_factor) ** 2 / moved


Rating: TypeAlias = float | AmplifierRating | LoudspeakerRating | OutputLimits  # a number is a rated power


def output_limits(rating: Rating | Sequence[Rating]) -> OutputLimits:
    """Return what a rating, or several together, allow a control signal: the strictest of each limit.

    The shortest window counts. A signal whose mean power keeps to a limit in every short window does so in long ones.

    Parameters
    ----------
    rating : float, AmplifierRating, LoudspeakerRating, OutputLimits, or a sequence of them
        A number is a rated power in squared units of the control signal.

    Returns
    -------
    OutputLimits
        The limits. The excursion of a loudspeaker is not among them, because it depends on the spectrum; see
        `LoudspeakerRating.excursion_rated_power`.

    Raises
    ------
    TypeError, ValueError
        Something else than a rating; no rating that limits the mean power; two ratings whose `volts_per_unit` differ.

    Examples
    --------
    >>> from kfopc_filterpy.power import AmplifierRating, LoudspeakerRating, output_limits
    >>> amplifier = AmplifierRating(ohm=8.0, sine_watt=100.0, volts_per_unit=10.0)
    >>> loudspeaker = LoudspeakerRating(ohm=6.4, noise_watt=30.0, volts_per_unit=10.0)
    >>> limits = output_limits([amplifier, loudspeaker])
    >>> print(f"{limits.rated_power:.2f} by the {limits.decided_by}, clipped at {limits.amplitude_limit:.1f}")
    1.92 by the loudspeaker's power, clipped at 4.0
    """
    ratings = list(rating) if isinstance(rating, list | tuple) else [rating]
    if not ratings:
        raise ValueError("rating must hold at least one rating, got none")
    scales = {one.volts for one in ratings if isinstance(one, AmplifierRating | LoudspeakerRating)}
    if len(scales) > 1:
        raise ValueError(
            f"all ratings must have the same volts_per_unit, got {', '.join(f'{scale:g}' for scale in sorted(scales))}: "
            "it belongs to the control signal"
        )
    each = [_limits(one) for one in ratings]
    least = min(each, key=lambda limits: limits.rated_power)
    if not math.isfinite(least.rated_power):
        raise ValueError("rating must limit the mean power: give watts, peak volts or a rated power")
    peaks = [limits.amplitude_limit for limits in each if limits.amplitude_limit is not None]
    peak, window_s = min(peaks, default=None), min(limits.window_s for limits in each)
    return OutputLimits(least.rated_power, peak, window_s, least.decided_by)


def _limits(rating: Any) -> OutputLimits:
    if isinstance(rating, OutputLimits):
        return rating
    if isinstance(rating, AmplifierRating | LoudspeakerRating):
        return rating.limits
    try:
        return OutputLimits(as_positive(rating, "rating"))
    except TypeError:
        wanted = "a rated power, an AmplifierRating or a LoudspeakerRating"
        raise TypeError(f"rating must be {wanted}, got {rating!r}") from None


def as_curve(value: float | Sequence[ArrayLike] | np.ndarray, name: str, unit: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a curve's frequencies and values; one number holds at all frequencies."""
    if not isinstance(value, list | tuple | np.ndarray):
        return np.array([0.0]), np.array([as_positive(value, name, unit=unit)])
    try:
        frequencies, values = (as_real_array(part, name) for part in value)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name} must be a number in {unit}, or frequencies in Hz and values in {unit}") from error
    if frequencies.ndim != 1 or frequencies.shape != values.shape or frequencies.size == 0:
        raise ValueError(f"{name} must have a value for each frequency, got {frequencies.shape} and {values.shape}")
    require_finite(frequencies, f"the frequencies of {name}")
    require_finite(values, name)
    if np.any(np.diff(frequencies) <= 0) or frequencies[0] < 0:
        raise ValueError(f"the frequencies of {name} must rise from 0 Hz or above")
    if np.any(values <= 0):
        raise ValueError(f"{name} must be greater than 0 {unit}, got {values.min():g} {unit}")
    return frequencies, values
