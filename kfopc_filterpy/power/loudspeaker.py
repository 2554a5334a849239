"""A loudspeaker with memory: a cone whose excursion is limited."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import lfilter

from .._validate import as_positive, as_signal
from .amplifiers import Amplifier, HardClipAmplifier, SoftSaturationAmplifier


@dataclass(eq=False)
class ExcursionLimitedLoudspeaker:
    r"""Loudspeaker whose cone moves no further than its data sheet allows, as a Wiener-Hammerstein model.

    A second-order low-pass gives the excursion for the control signal, and a memoryless function limits it. The inverse of
    the low-pass then gives the control signal that would move a cone without a limit in the same way. It makes the same
    sound as the limited cone, so the secondary path remains the one measured with quiet signals. A signal whose excursion
    is within the limit passes unchanged.

    Use it as `amplifier` of `simulate`, of `paths.identify_secondary_path` or of `realtime.SimulatedInterface`. Each run
    and each loudspeaker works with a copy `at_rest`.

    The low-pass :math:`1 / (1 + s/(Q_{ts} \omega_s) + s^2/\omega_s^2)` is sampled with its exact poles and the exact
    gain at 0 Hz, but without zeros, so that its inverse has a finite impulse response. (The zeros of the bilinear
    transform would be poles at fs/2 of the inverse.) The gain is right within 0.12 dB up to fs/16 and 0.45 dB up to
    fs/8; the excursion comes one sample early, which the inverse makes up for. Above the resonance, the
    excursion falls by 12 dB per octave.

    Not modelled: the variation of force factor and inductance with the excursion, heating, and different limits
    inwards and outwards.

    Parameters
    ----------
    fs : float
        Sample rate in Hz.
    resonance_hz : float
        Resonance :math:`f_s`, in the cabinet if there is one, below fs/2.
    q_ts : float
        Total quality factor :math:`Q_{ts}` at the resonance.
    x_max_mm : float
        Largest excursion from the rest position in mm, one way.
    mm_per_volt : float
        Excursion per volt far below the resonance. From a data sheet: :math:`Bl \, C_{ms} / R_e`, with the force factor
        in N/A, the compliance in mm/N and the resistance of the voice coil in ohm.
    volts_per_unit : float, default 1
        Volts at the loudspeaker for a control signal of 1.
    sharpness : float, optional
        Exponent p of a limit that is approached smoothly, see `SoftSaturationAmplifier`. By default the excursion is
        clipped: the sound then has clicks, like those of a cone that hits a stop.

    Raises
    ------
    TypeError, ValueError
        If a value is not a number above 0, or the resonance is not below fs/2.

    References
    ----------
    R. H. Small, "Direct-radiator loudspeaker system analysis", J. Audio Eng. Soc. 20(5), 1972: the low-pass.

    Examples
    --------
    Five volts at 20 Hz move this cone as far as it goes, twenty volts at 400 Hz much less:

    >>> import numpy as np
    >>> from kfopc_filterpy.power import ExcursionLimitedLoudspeaker
    >>> woofer = ExcursionLimitedLoudspeaker(8000.0, resonance_hz=80.0, q_ts=0.6, x_max_mm=2.0, mm_per_volt=0.5)
    >>> t = np.arange(8000) / 8000
    >>> for volts, hz in ((1, 20), (5, 20), (20, 400)):
    ...     print(round(woofer.excursion_mm(volts * np.sin(2 * np.pi * hz * t))[4000:].max(), 2))
    0.49
    2.0
    0.4
    """

    fs: float
    resonance_hz: float
    q_ts: float
    x_max_mm: float
    mm_per_volt: float
    volts_per_unit: float = 1.0
    sharpness: float | None = None

    def __post_init__(self) -> None:
        units = {"fs": "Hz", "resonance_hz": "Hz", "x_max_mm": "mm", "mm_per_volt": "mm/V", "volts_per_unit": "V"}
        for name in ("fs", "resonance_hz", "q_ts", "x_max_mm", "mm_per_volt", "volts_per_unit"):
            setattr(self, name, as_positive(getattr(self, name), name, unit=units.get(name, "")))
        if self.resonance_hz >= self.fs / 2:
            raise ValueError(f"resonance_hz must be below fs/2 = {self.fs / 2:g} Hz, got {self.resonance_hz:g} Hz")
        self._limit: Amplifier = (
            HardClipAmplifier(self.x_max_mm)
            if self.sharpness is None
            else SoftSaturationAmplifier(self.x_max_mm, self.sharpness)
        )
        poles = np.exp(2 * np.pi * self.resonance_hz / self.fs * np.roots([1.0, 1.0 / self.q_ts, 1.0]))
        self._recursion = np.poly(poles).real
        self._gain = [float(self._recursion.sum()) * self.mm_per_volt * self.volts_per_unit]  # mm for a step of 1
        self._moving, self._lost = np.zeros(2), np.zeros(2)

    def at_rest(self) -> ExcursionLimitedLoudspeaker:
        """Return a copy whose cone is at rest."""
        return replace(self)

    def excursion_mm(self, control_signal: ArrayLike) -> np.ndarray:
        """Return the excursion of the cone in mm, (n_samples,), for a `control_signal`, (n_samples,), that starts at rest."""
        y = as_signal(control_signal, "control_signal")
        excursion: np.ndarray = self._limit(lfilter(self._gain, self._recursion, y))
        return excursion

    def __call__(self, signal: ArrayLike) -> Any:
        """Return what becomes of the next sample, or of the next samples, (n_samples,), of the control signal."""
        y = np.atleast_1d(np.asarray(signal, dtype=np.float64))
        free, self._moving = lfilter(self._gain, self._recursion, y, zi=self._moving)
        # What the limit takes away passes the inverse alone: a signal within the limit stays the same to the bit.
        lost, self._lost = lfilter(self._recursion, self._gain, self._limit(free) - free, zi=self._lost)
        played = y + lost
        return played if np.ndim(signal) else float(played[0])
