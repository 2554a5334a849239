"""A one-dimensional duct with reflecting ends: the built-in stand-in for a measured duct."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .._validate import as_nonnegative, as_number, as_positive
from ..plant import Plant

_CUT = 1e-5  # share of a response's energy that may be cut off: -50 dB
# Length of the synthesis. A response that has not decayed by half of it is refused, so it does not alias.
_N_FFT = 2**16


@dataclass(frozen=True)
class Duct:
    """Geometry and acoustics of a duct with its loudspeaker, from which `duct_plant` computes the paths.

    Positions count from the end near the noise source, in the order source, reference microphone, loudspeaker, error
    microphone.

    Attributes
    ----------
    length_m : float, default 2.2
        Length L of the duct in m.
    source_m : float, default 0.05
        Position of the noise source in m.
    reference_m : float or None, default 0.25
        Position of the reference microphone in m. None takes the source's own signal (a tachometer, say) as the
        reference.
    loudspeaker_m : float, default 1.4
        Position of the loudspeaker in m.
    error_m : float, default 1.9
        Position of the error microphone in m.
    reflection : (float, float), default (0.6, -0.4)
        Reflection coefficients of sound pressure at 0 and L, between -1 (open) and 1 (rigid).
    attenuation_db_per_m : float, default 1.0
        Loss at the walls at 1 kHz in dB/m; it grows with the square root of frequency.
    loudspeaker_resonance_hz : float or None, default 70.0
        Resonance of the loudspeaker in Hz; None for an ideal one.
    loudspeaker_q : float, default 0.8
        Quality factor of that resonance.
    electronics_delay_s : float, default 0.25e-3
        Delay of converters and filters in the secondary path in s.
    speed_of_sound : float, default 343.0
        Speed of sound c in m/s.

    Raises
    ------
    TypeError, ValueError
        If positions are out of order, or a value is out of range.

    Examples
    --------
    >>> duct_plant(Duct(length_m=2.6), fs=8000)
    <Plant at 8000 Hz: secondary path of 384 taps, primary path of 512 taps>
    """

    length_m: float = 2.2
    source_m: float = 0.05
    reference_m: float | None = 0.25
    loudspeaker_m: float = 1.4
    error_m: float = 1.9
    reflection: tuple[float, float] = (0.6, -0.4)
    attenuation_db_per_m: float = 1.0
    loudspeaker_resonance_hz: float | None = 70.0
    loudspeaker_q: float = 0.8
    electronics_delay_s: float = 0.25e-3
    speed_of_sound: float = 343.0

    def __post_init__(self) -> None:
        as_positive(self.length_m, "length_m", unit="m")
        as_positive(self.speed_of_sound, "speed_of_sound", unit="m/s")
        as_nonnegative(self.attenuation_db_per_m, "attenuation_db_per_m", unit="dB/m")
        as_nonnegative(self.electronics_delay_s, "electronics_delay_s", unit="s")
        as_positive(self.loudspeaker_q, "loudspeaker_q")
        if self.loudspeaker_resonance_hz is not None:
            as_positive(self.loudspeaker_resonance_hz, "loudspeaker_resonance_hz", unit="Hz")
        positions = {name: getattr(self, name) for name in ("source_m", "reference_m", "loudspeaker_m", "error_m")}
        placed = {name: as_number(x, name, unit="m") for name, x in positions.items() if x is not None}
        x = list(placed.values())
        # The reference microphone may be at the source; only the error microphone must be apart from the loudspeaker.
        if not (x[0] >= 0 and x[-1] <= self.length_m and np.all(np.diff(x) >= 0) and x[-2] < x[-1]):
            found = ", ".join(f"{name} = {value:g}" for name, value in placed.items())
            raise ValueError(
                f"positions must satisfy 0 <= source_m <= reference_m <= loudspeaker_m < error_m <= length_m "
                f"= {self.length_m:g} m, got {found}"
            )
        try:
            near, far = (as_number(r, "reflection") for r in self.reflection)
        except (TypeError, ValueError) as error:
            raise ValueError(f"reflection must be a pair of numbers (at 0, at L), got {self.reflection!r}") from error
        if max(abs(near), abs(far)) >= 1:
            raise ValueError(
                f"reflection must lie strictly between -1 and 1 at both ends, got ({near:g}, {far:g}): "
                "without any loss the response never decays"
            )


def duct_plant(duct: Duct | None = None, *, fs: float) -> Plant:
    r"""Return the two paths of a duct with reflecting ends, in which plane waves travel.

    All images of a source at :math:`x_s` sum up, at a microphone at :math:`x > x_s`, to

    .. math::

       G(x, x_s) &= \frac{1 + r_L g(2L - 2x)}{1 - r_0 r_L g(2L)}\, h(x, x_s),

       h(x, x_s) &= g(x - x_s) + r_0 g(x + x_s),

       g(l) &= e^{-j 2\pi f l / c - (1 + j) a l \sqrt{f / 1\,\mathrm{kHz}}},

    where `g` carries the wave over a length: its delay, which need not be whole samples, and the loss at the walls with
    the dispersion that keeps it causal. The secondary path is G from the loudspeaker, times a second-order high-pass
    (the loudspeaker) and the delay of the electronics. The primary path is the ratio of G at the error microphone to G
    at the reference microphone; the source's position and the duct's own resonances cancel in it, and those of the
    section beyond the reference microphone stay. Without a reference microphone it is G from the source. The responses
    are sampled with a band limit from 0.4 fs to 0.5 fs.

    Not modelled: cross modes (above ``0.586 c / diameter``) and feedback to the reference microphone.

    Parameters
    ----------
    duct : Duct, optional
        The duct, by default ``Duct()``.
    fs : float
        Sample rate in Hz.

    Returns
    -------
    Plant
        Primary and secondary path, with linear amplifiers. Their lengths are the smallest multiples of 64 taps that
        leave out no more than -50 dB of the energy.

    Raises
    ------
    TypeError, ValueError
        If an argument is out of range, or a response rings too long.

    References
    ----------
    .. [1] P. A. Nelson and S. J. Elliott, *Active Control of Sound*, Academic Press, 1992, ch. 5.
    .. [2] A. D. Pierce, *Acoustics*, 3rd ed., Springer, 2019, ch. 10 (losses at the walls of a duct).

    Examples
    --------
    >>> duct_plant(fs=16000)
    <Plant at 16000 Hz: secondary path of 640 taps, primary path of 832 taps>
    """
    fs = as_positive(fs, "fs", unit="Hz")
    duct = Duct() if duct is None else duct
    length, (r0, r1) = duct.length_m, duct.reflection
    loss = duct.attenuation_db_per_m / (20 * np.log10(math.e))
    f = np.fft.rfftfreq(_N_FFT, 1 / fs)

    def travel(distance: float) -> np.ndarray:
        return np.exp(-2j * np.pi * f * distance / duct.speed_of_sound - (1 + 1j) * loss * distance * np.sqrt(f / 1000))

    def pressure(x: float, source: float) -> np.ndarray:
        outgoing = travel(x - source) + r0 * travel(x + source)
        return outgoing * (1 + r1 * travel(2 * (length - x))) / (1 - r0 * r1 * travel(2 * length))

    if duct.reference_m is None:
        primary = pressure(duct.error_m, duct.source_m)
    else:
        at_error, at_reference = (1 + r1 * travel(2 * (length - x)) for x in (duct.error_m, duct.reference_m))
        primary = travel(duct.error_m - duct.reference_m) * at_error / at_reference
    secondary = pressure(duct.error_m, duct.loudspeaker_m) * np.exp(-2j * np.pi * f * duct.electronics_delay_s)
    if duct.loudspeaker_resonance_hz is not None:
        relative = f / duct.loudspeaker_resonance_hz
        secondary *= -(relative**2) / (1 - relative**2 + 1j * relative / duct.loudspeaker_q)
    return Plant(_sampled(secondary, "secondary"), _sampled(primary, "primary"), fs=fs)


def _sampled(response: np.ndarray, name: str) -> np.ndarray:
    """Return the impulse response of a response on the grid of `rfft`, band-limited and cut where it has decayed."""
    position = np.linspace(0.0, 1.0, response.size)
    # With half a cosine from 0.4 fs to 0.5 fs, fractional delays ring only briefly.
    band_limit = np.where(position < 0.8, 1.0, 0.5 + 0.5 * np.cos(np.pi * (position - 0.8) / 0.2))
    taps = np.fft.irfft(response * band_limit, _N_FFT)
    # Share of the energy from each sample on. Ringing before time zero wraps around to the end of `taps`, and so counts
    # as left out.
    left_out = np.cumsum(taps[::-1] ** 2)[::-1] / np.sum(taps**2)
    enough = 64 * -(-int(np.count_nonzero(left_out > _CUT)) // 64)
    if enough > _N_FFT // 2:
        raise ValueError(
            f"the {name} path must not exceed {_N_FFT // 2} taps, but {enough} are needed: the response rings too long, or "
            "its wave arrives at once and rings before time zero; reflect less, attenuate more or delay more"
        )
    return taps[:enough]
