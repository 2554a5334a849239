"""A guard against an adaptation that makes the noise louder, for a controller whose secondary path may be wrong."""

from __future__ import annotations

import numpy as np

LOWEST_GAIN = 1e-3  # at which the control is not heard
GAIN_STEP = 10 ** (2 / 20)  # by which it changes from frame to frame
FIRST_AVERAGE = 1 / 8  # of the memory: all frames count alike in the averages until then


class DivergenceGuard:
    """Powers of the signals at the microphones, and what follows from them: whether to adapt, and how loud to play.

    All powers are sums over the microphones. Each is compared, over frames of some milliseconds, with the power of the
    disturbance that is expected.

    Parameters
    ----------
    n_references : int
        Number of references I.
    frame : int
        Number of samples in a frame.
    memory : float
        Memory of the averages in samples.
    share : float
        Power of the error, relative to the expected power of the disturbance, that is too loud; above 2.

    Attributes
    ----------
    held : bool
        Whether the controller must not adapt.
    """

    def __init__(self, n_references: int, frame: int, memory: float, share: float) -> None:
        self._frame, self._memory, self._share = frame, memory, share
        self.held = False
        self._gain = 1.0  # of the control signal, at the beginning of this frame
        self._is_heard = False  # whether the control was heard in this frame
        self._samples = 0  # of this frame that were added
        self._energies = np.zeros(3 + n_references)  # of error, alone, disturbance, references, in this frame
        self._last_references = np.zeros(n_references)  # their powers in the frame before
        self._mean = np.zeros(1 + n_references)  # of the powers of disturbance and references
        self._frames = 0
        self._harmless = np.inf  # energy of an error in a frame that is not too loud, whatever the references are
        self._recovering_from = 0.0  # power of the error when a path was taken over, until it has fallen

    @property
    def gain(self) -> float:
        """Factor of the control signal. It falls within a frame once the error has more energy than a frame may have."""
        energy = self._energies[0]
        if energy <= self._harmless:
            return self._gain
        most = self._frame * self._share * self._expected(self._energies[3:] / self._frame)
        return max(float(self._gain * min(most / energy, 1.0)), LOWEST_GAIN)

    def allows(self, alone: np.ndarray, references: np.ndarray) -> bool:
        """Return whether the controller may adapt to the newest error, after the newest references, (I,).

        `alone` is the error, (K,), that the controller would hear if it played alone and with a gain of 1.
        """
        energy = self._energies[1] + alone @ alone
        if not self.held and energy > self._harmless:
            expected = self._expected((self._energies[3:] + references**2) / self._frame)
            self.held = self._is_too_loud(energy / self._frame, expected)
        return not self.held

    def add(self, error: np.ndarray, alone: np.ndarray, disturbance: np.ndarray, references: np.ndarray) -> None:
        """Add a sample of each signal, (K,), (K,), (K,) and (I,)."""
        self._energies[:2] += error @ error, alone @ alone
        self._is_heard |= self._gain > LOWEST_GAIN
        self.follow(disturbance, references)

    def follow(self, disturbance: np.ndarray, references: np.ndarray) -> None:
        """Add a sample that was heard while nothing was played: no loudness is the control's fault."""
        self._samples += 1
        self._energies[2] += disturbance @ disturbance
        self._energies[3:] += references**2

    def end_frame(self) -> None:
        """Decide for the next frame, and take this frame into the averages, unless no sample of it was added."""
        if not self._samples:
            return
        (error, alone, disturbance), references = np.split(self._energies / self._samples, [3])
        self._samples = 0
        expected = self._expected(references)
        if not self._is_heard and disturbance > 0.5 * self._share * expected:  # then the noise itself is louder
            self._mean[0] *= disturbance / expected
            expected = disturbance
        if alone <= self._share * expected:
            self._recovering_from = 0.0
        self._gain = self.gain
        is_soft = bool(error <= 0.5 * self._share * expected)
        self._decide(is_soft, self._is_too_loud(alone, expected))
        suspect = self.held or not is_soft
        # A wrong path makes the disturbance estimate louder, so a frame raises the average little, or not at all.
        self._average(min(disturbance, expected if suspect else self._share * expected), references)
        self._last_references = references
        self._energies, self._is_heard = np.zeros_like(self._energies), False
        self._harmless = self._frame * self._share * self._expected(np.zeros_like(references))

    def begin_anew(self, alone: float = 0.0) -> None:
        """Adapt again, with another path, by which the error alone had this power in the last frame."""
        self.held, self._recovering_from = False, alone
        self._energies[1] = 0.0  # it was by the path before

    def _decide(self, is_soft: bool, is_too_loud: bool) -> None:
        """Set whether to adapt in the next frame, and the gain at its beginning.

        `is_soft` says whether the error was 3 dB below the limit, `is_too_loud` whether the error alone was above it.
        """
        if not self.held:
            self.held = is_too_loud
        elif is_soft and self._gain == 1.0:
            self.held = False
        # Whoever is to blame, it comes to rest: at 3 dB below the limit, or at 1 once louder noise is expected.
        if is_soft:
            self._gain = min(GAIN_STEP * self._gain, 1.0)
        elif self.held or self._gain < 1.0:
            self._gain = max(self._gain / GAIN_STEP, LOWEST_GAIN)

    def _average(self, disturbance: float, references: np.ndarray) -> None:
        """Take the powers of a frame into the averages."""
        self._frames += 1
        is_first = self._frames * self._frame <= FIRST_AVERAGE * self._memory
        rate = 1.0 / self._frames if is_first else self._frame / self._memory
        self._mean += rate * (np.concatenate(([disturbance], references)) - self._mean)

    def _is_too_loud(self, power: float, expected: float) -> bool:
        return bool(power > max(self._share * expected, 2.0 * self._recovering_from))

    def _expected(self, references: np.ndarray) -> float:
        """Return the power of the disturbance that is expected with these powers of the references, (I,).

        It is the mean power of the disturbance estimates, times the ratio of a reference's power, in this frame or the
        one before, to its own mean if that is above 1, for the reference whose ratio is largest.
        """
        disturbance, usual = self._mean[0], self._mean[1:]
        known = usual > 0.0
        # Before anything was heard, nothing is expected: the noise may reach the microphones later than the reference.
        if not (disturbance > 0.0 and known.any()):
            return np.inf
        ratios = np.maximum(references, self._last_references)[known] / usual[known]
        return float(disturbance * max(ratios.max(), 1.0))
