"""A one-dimensional duct with reflecting ends: the built-in stand-in for a measured duct."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .._validate import as_count, as_nonnegative, as_number, as_positive
from .models import fir_path

if TYPE_CHECKING:
    import control

# Share of a response's energy that is cut off where the number of taps is chosen here (-50 dB), and that
# may be cut off by a given number (-40 dB).
_CHOSEN_CUT, _ALLOWED_CUT = 1e-5, 1e-4
# Length of the synthesis. A response that has not decayed by half of it is refused, so it does not alias.
_N_FFT = 2**16


@dataclass(frozen=True)
class DuctPaths:
    """A duct's primary and secondary path with its geometry; made by `duct_paths`.

    Attributes
    ----------
    primary : control.TransferFunction
        From the reference signal to the error microphone.
    secondary : control.TransferFunction
        From the control signal, through the loudspeaker, to the error microphone.
    fs : float
        Sampling rate in Hz.
    length_m, source_m, loudspeaker_m, error_m : float
        Length of the duct and positions along it, in m.
    reference_m : float or None
        Position of the reference microphone; None where the reference is the source's own signal.
    resonances_hz : numpy.ndarray
        Resonances of the lossless duct up to fs/2, in Hz: ``n c / 2L`` where both ends reflect with the same
        sign, ``(2n - 1) c / 4L`` where with opposite signs; empty where an end does not reflect.
    """

    primary: control.TransferFunction
    secondary: control.TransferFunction
    fs: float
    length_m: float
    source_m: float
    reference_m: float | None
    loudspeaker_m: float
    error_m: float
    resonances_hz: np.ndarray


def duct_paths(
    *,
    fs: float = 16000.0,
    length_m: float = 2.2,
    source_m: float = 0.05,
    reference_m: float | None = 0.25,
    loudspeaker_m: float = 1.4,
    error_m: float = 1.9,
    reflection: tuple[float, float] = (0.6, -0.4),
    attenuation_db_per_m: float = 1.0,
    loudspeaker_resonance_hz: float | None = 70.0,
    loudspeaker_q: float = 0.8,
    electronics_delay_s: float = 0.25e-3,
    speed_of_sound: float = 343.0,
    primary_taps: int | None = None,
    secondary_taps: int | None = None,
) -> DuctPaths:
    r"""Model a duct with reflecting ends in which plane waves travel, and return its two paths.

    All images of a source at :math:`x_s` sum up, at a microphone at :math:`x > x_s`, to

    .. math:: G(x, x_s) = \frac{(g(x - x_s) + r_0 g(x + x_s)) (1 + r_L g(2L - 2x))}{1 - r_0 r_L g(2L)},
              \quad g(l) = e^{-j 2\pi f l / c - (1 + j) a l \sqrt{f / 1\,\mathrm{kHz}}},

    where `g` carries the wave over a length: its delay, which need not be whole samples, and the loss at the
    walls with the dispersion that keeps it causal. The secondary path is G from the loudspeaker, times a
    second-order high-pass (the loudspeaker) and the delay of the electronics. The primary path is the ratio
    of G at the error and at the reference microphone; in it the source's position and the duct's own
    resonances cancel, and those of the section beyond the reference microphone stay. The responses are
    sampled with a band limit from 0.4 fs to 0.5 fs.

    Not modelled: cross modes (above ``0.586 c / diameter``) and feedback to the reference microphone.

    Parameters
    ----------
    fs : float
        Sampling rate in Hz.
    length_m : float
        Length L of the duct in m; positions count from the end near the noise source.
    source_m, reference_m, loudspeaker_m, error_m : float
        Positions in m, in this order along the duct. ``reference_m=None`` takes the source's own signal
        (a tachometer, say) as the reference: the primary path is then G from the source.
    reflection : (float, float)
        Reflection coefficients of sound pressure at 0 and L, between -1 (open) and 1 (rigid).
    attenuation_db_per_m : float
        Loss at the walls at 1 kHz in dB/m; it grows with the square root of frequency.
    loudspeaker_resonance_hz : float or None
        Resonance of the loudspeaker in Hz; None for an ideal one.
    loudspeaker_q : float
        Quality factor of that resonance.
    electronics_delay_s : float
        Delay of converters and filters in the secondary path in s.
    speed_of_sound : float
        Speed of sound c in m/s.
    primary_taps, secondary_taps : int, optional
        Lengths of the impulse responses; by default the least multiples of 64 that leave out no more than
        -50 dB of their energy: 832 and 640 for the default duct. Given lengths may leave out -40 dB.

    Returns
    -------
    DuctPaths
        Both paths as python-control systems, and the geometry.

    Raises
    ------
    TypeError, ValueError
        Positions out of order, coefficients out of range, or responses that have not decayed.

    References
    ----------
    .. [1] P. A. Nelson and S. J. Elliott, *Active Control of Sound*, Academic Press, 1992, ch. 5.
    .. [2] A. D. Pierce, *Acoustics*, 3rd ed., Springer, 2019, ch. 10 (losses at the walls of a duct).

    Examples
    --------
    >>> from kfopc_filterpy.paths.models import path_taps
    >>> duct = duct_paths()
    >>> path_taps(duct.primary).size, path_taps(duct.secondary).size
    (832, 640)
    >>> duct.resonances_hz[:3].round(1)
    array([ 39. , 116.9, 194.9])
    """
    fs = as_positive(fs, "fs", unit="Hz")
    length = as_positive(length_m, "length_m", unit="m")
    _check_positions(length, source_m, reference_m, loudspeaker_m, error_m)
    r0, r1 = _check_reflection(reflection)
    speed = as_positive(speed_of_sound, "speed_of_sound", unit="m/s")
    loss = as_nonnegative(attenuation_db_per_m, "attenuation_db_per_m", unit="dB/m") / (20 * np.log10(np.e))
    latency = as_nonnegative(electronics_delay_s, "electronics_delay_s", unit="s")
    f = np.fft.rfftfreq(_N_FFT, 1 / fs)

    def travel(distance: float) -> np.ndarray:
        return np.exp(-2j * np.pi * f * distance / speed - (1 + 1j) * loss * distance * np.sqrt(f / 1000))

    def pressure(x: float, source: float) -> np.ndarray:
        outgoing = travel(x - source) + r0 * travel(x + source)
        return outgoing * (1 + r1 * travel(2 * (length - x))) / (1 - r0 * r1 * travel(2 * length))

    if reference_m is None:
        primary = pressure(error_m, source_m)
    else:
        at_error, at_reference = (1 + r1 * travel(2 * (length - x)) for x in (error_m, reference_m))
        primary = travel(error_m - reference_m) * at_error / at_reference
    secondary = pressure(error_m, loudspeaker_m) * np.exp(-2j * np.pi * f * latency)
    if loudspeaker_resonance_hz is not None:
        relative = f / as_positive(loudspeaker_resonance_hz, "loudspeaker_resonance_hz", unit="Hz")
        secondary *= -(relative**2) / (1 - relative**2 + 1j * relative / as_positive(loudspeaker_q, "loudspeaker_q"))

    return DuctPaths(
        primary=fir_path(_sampled(primary, primary_taps, "primary_taps"), fs, "primary"),
        secondary=fir_path(_sampled(secondary, secondary_taps, "secondary_taps"), fs, "secondary"),
        fs=fs,
        length_m=length,
        source_m=source_m,
        reference_m=reference_m,
        loudspeaker_m=loudspeaker_m,
        error_m=error_m,
        resonances_hz=_resonances(r0 * r1, speed / length, fs),
    )


def _check_positions(length: float, source: float, reference: float | None, loudspeaker: float, error: float) -> None:
    """Check that source, reference, loudspeaker and error microphone follow each other along the duct."""
    positions = {"source_m": source, "reference_m": reference, "loudspeaker_m": loudspeaker, "error_m": error}
    placed = {name: as_number(x, name, unit="m") for name, x in positions.items() if x is not None}
    x = list(placed.values())
    # A reference microphone at the source is in order; only the error microphone must stand off.
    if not (x[0] >= 0 and x[-1] <= length and np.all(np.diff(x) >= 0) and x[-2] < x[-1]):
        found = ", ".join(f"{name} = {value:g}" for name, value in placed.items())
        raise ValueError(
            f"positions must satisfy 0 <= source_m <= reference_m <= loudspeaker_m < error_m <= length_m "
            f"= {length:g} m, got {found}"
        )


def _check_reflection(reflection: tuple[float, float]) -> tuple[float, float]:
    """Return both reflection coefficients, each strictly between -1 and 1."""
    try:
        near, far = (as_number(r, "reflection") for r in reflection)
    except (TypeError, ValueError) as error:
        raise ValueError(f"reflection must be a pair of numbers (at 0, at L), got {reflection!r}") from error
    if max(abs(near), abs(far)) >= 1:
        raise ValueError(
            f"reflection must lie strictly between -1 and 1 at both ends, got ({near:g}, {far:g}): "
            "without any loss the response never decays"
        )
    return near, far


def _sampled(response: np.ndarray, n_taps: int | None, name: str) -> np.ndarray:
    """Impulse response of a frequency response on the grid of `rfft`, band-limited and cut to `n_taps`."""
    position = np.linspace(0.0, 1.0, response.size)
    # Half a cosine from 0.4 fs to 0.5 fs: fractional delays then ring only briefly.
    band_limit = np.where(position < 0.8, 1.0, 0.5 + 0.5 * np.cos(np.pi * (position - 0.8) / 0.2))
    taps = np.fft.irfft(response * band_limit, _N_FFT)
    # Share of the energy from each sample on. What rings before time zero stands, by the circularity of
    # the FFT, at the end of `taps`, and so counts as left out.
    left_out = np.cumsum(taps[::-1] ** 2)[::-1] / np.sum(taps**2)
    enough = 64 * -(-int(np.count_nonzero(left_out > _CHOSEN_CUT)) // 64)
    chosen = enough if n_taps is None else as_count(n_taps, name)
    if chosen > _N_FFT // 2:
        raise ValueError(
            f"{name} must not exceed {_N_FFT // 2}, but {chosen} are needed: the response rings too long, or "
            "its wave arrives at once and rings before time zero; reflect less, attenuate more or delay more"
        )
    if left_out[chosen] > _ALLOWED_CUT:
        lost_db, allowed_db = 10 * np.log10(left_out[chosen]), 10 * np.log10(_ALLOWED_CUT)
        raise ValueError(
            f"{name} = {chosen} leaves out {lost_db:.1f} dB of the response's energy, more than "
            f"{allowed_db:.0f} dB; leave it to the default, which takes {enough}"
        )
    return taps[:chosen]


def _resonances(round_trip: float, spacing_hz: float, fs: float) -> np.ndarray:
    """Closed-form resonances of the lossless duct up to fs/2; `spacing_hz` is c / L."""
    if round_trip == 0:
        return np.array([])
    orders = np.arange(1, int(fs / spacing_hz) + 2)
    resonances = orders * spacing_hz / 2 if round_trip > 0 else (2 * orders - 1) * spacing_hz / 4
    return resonances[resonances <= fs / 2]
