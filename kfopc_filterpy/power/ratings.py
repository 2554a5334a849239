r"""Ratings as data sheets have them, and what they allow a control signal: a mean power and a peak.

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
from dataclasses import dataclass
from typing import Any, TypeAlias

from .._types import NumberOrArray
from .._validate import as_positive
from .limiter import DEFAULT_WINDOW_S, OutputLimiter

SINE_CREST, NOISE_CREST = math.sqrt(2.0), 2.0
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

    ohm: float
    sine_watt: float | None
    noise_watt: float | None
    peak_volts: float | None
    volts_per_unit: float | None

    def __post_init__(self) -> None:
        units = {"sine_watt": "W", "noise_watt": "W", "peak_volts": "V", "volts_per_unit": "V"}
        given = [name for name in units if getattr(self, name) is not None]
        for name in given:
            as_positive(getattr(self, name), name, unit=units[name])
        as_positive(self.ohm, "ohm", unit="ohm")
        powers = [name for name in given if name.endswith("watt")]
        if len(powers) > 1 or not (powers or self.peak_volts is not None):
            raise ValueError(
                f"a rating must have sine_watt or noise_watt, or else peak_volts, got {' and '.join(powers) or 'none of them'}; "
                "if the data sheet of an amplifier does not say, give sine_watt"
            )

    @property
    def volts(self) -> float:
        """Volts for a control signal of 1; 1 if they are not known."""
        return 1.0 if self.volts_per_unit is None else self.volts_per_unit

    @property
    def rated_power(self) -> float:
        """Rated power ρ_o, the largest mean square of the control signal.

        Without watts, that of a sine at the peak voltage.
        """
        watts = self.noise_watt if self.sine_watt is None else self.sine_watt
        if watts is None:
            assert self.peak_volts is not None
            return (self.peak_volts / self.volts) ** 2 / 2.0
        return watts * self.ohm / self.volts**2

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
        Voltage at which the amplifier clips. By default it follows from the power and its crest factor. Without a
        power, the power is that of the sine that peaks at this voltage.
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


@dataclass(frozen=True)
class LoudspeakerRating(_Rating):
    r"""Rating of a loudspeaker: the heat that its voice coil bears, and its largest voltage.

    The thermal rating is a mean over seconds. It becomes the rated power of a controller and a window of ten seconds of
    the limiter. The excursion of the cone is not limited: where it counts, at low frequencies, state `peak_volts`.

    Parameters
    ----------
    ohm : float
        Nominal impedance in ohm, or the smallest of its curve, as AES2 has it.
    noise_watt : float, optional
        Rated noise power in W (IEC 60268-5, AES2). Of a programme power, it is the half.
    sine_watt : float, optional
        Rated sinusoidal power in W.
    peak_volts : float, optional
        Largest voltage in V. Without a power, the power is that of the sine that peaks at this voltage.
    volts_per_unit : float, optional
        Volts at the loudspeaker for a control signal of 1, as for an `AmplifierRating`.

    Raises
    ------
    TypeError, ValueError
        No rating or two powers; a number that is not above zero.

    Examples
    --------
    >>> from kfopc_filterpy.power import LoudspeakerRating
    >>> LoudspeakerRating(ohm=6.0, noise_watt=30.0).rated_power
    180.0
    """

    ohm: float
    noise_watt: float | None = None
    sine_watt: float | None = None
    peak_volts: float | None = None
    volts_per_unit: float | None = None

    @property
    def amplitude_limit(self) -> float | None:
        """Largest magnitude of the control signal, or None: a loudspeaker's watts do not limit its peaks."""
        return None if self.peak_volts is None else self.peak_volts / self.volts

    @property
    def limits(self) -> OutputLimits:
        """Limits of the control signal; the mean power counts over ten seconds."""
        return OutputLimits(self.rated_power, self.amplitude_limit, THERMAL_WINDOW_S, "loudspeaker's power")


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
        The limits.

    Raises
    ------
    TypeError, ValueError
        Something else than a rating; two ratings whose `volts_per_unit` differ.

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
