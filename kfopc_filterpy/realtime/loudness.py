"""Whether the noise is louder under control than it was in silence, and the references do not explain it."""

from __future__ import annotations

import numpy as np

UNHEARD = 0.1  # of the noise in silence: as much may come from sources that no reference hears, and stay


class Loudness:
    r"""Compare the power of the errors with that of the last silence.

    If a noise changes its level by itself, the references change with it. With the powers X of the references and E of
    the errors, and X_0 and E_0 in silence, the power to be expected without control is

    .. math:: D = E_0 \max(X / X_0, 0.1)

    The floor is for noise that no reference hears: it stays if the rest falls. Without a reference, D is E_0.

    Parameters
    ----------
    window : int
        Samples of a window.
    n_windows : int
        Windows in a row that are compared.
    ratio : float
        Ratio of E to D, above 1, from which on the noise is louder; infinite: it never is.

    Attributes
    ----------
    windows : ndarray, shape (n, 2)
        Powers X and E, sums over the channels, of the windows since `begin`, at most of the last `n_windows`.
    before : ndarray, shape (2,), or None
        Powers X_0 and E_0: the means over the loudest `n_windows` of the last silence; None before the first one.
    """

    def __init__(self, window: int, n_windows: int, ratio: float) -> None:
        self.window, self.n_windows, self.ratio = window, n_windows, ratio
        self.before: np.ndarray | None = None
        self.begin()

    def begin(self) -> None:
        """Forget the windows, but not how loud the last silence was."""
        self.windows, self._sums = np.zeros((0, 2)), np.zeros(3)

    @property
    def full(self) -> bool:
        """Whether `n_windows` have been heard."""
        return len(self.windows) == self.n_windows

    def hear(self, x: np.ndarray, e: np.ndarray) -> bool:
        """Add a block of references (I, n) and errors (K, n); return whether it completes a window."""
        self._sums += x.shape[1], np.sum(x * x), np.sum(e * e)
        if self._sums[0] < self.window:
            return False
        self.windows = np.append(self.windows, self._sums[np.newaxis, 1:] / self._sums[0], axis=0)[-self.n_windows :]
        self._sums = np.zeros(3)
        return True

    def note_silence(self) -> None:
        """Take the windows, heard with silent loudspeakers, for the level before control, unless others were louder."""
        powers = np.mean(self.windows, axis=0)
        if self.before is None or not self.full or powers[1] > self.before[1]:
            self.before = powers

    def is_louder(self, windows: np.ndarray, ratio: float) -> bool:
        """Return whether the mean of windows (n, 2) is louder than expected, by a ratio of powers.

        A window counts as the square of `Loudness.ratio` at most, twice as many decibels, so one bang is not enough.
        """
        if self.before is None or np.isinf(self.ratio):
            return False
        x, e = windows.T
        x_0, e_0 = self.before
        expected = e_0 * np.maximum(x / x_0, UNHEARD) if x_0 > 0.0 else np.full_like(e, e_0)
        return bool(np.sum(np.minimum(e, self.ratio**2 * expected)) > ratio * np.sum(expected))
