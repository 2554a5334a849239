"""Whether a controller's adaptation has diverged: large weights, a power that grows with the gain."""

from __future__ import annotations

from typing import Any

import numpy as np

OVER_POWER = 4.0  # times the rated power over a window: no algorithm exceeds its rating so much after its first blocks
PATIENCE = 3  # windows in a row that must be too loud: after a jump of the noise, the power needs some time
OFTEN_LIMITED = 0.1  # of a window's samples at the limit
GROWN = 1.5  # times the last normal gain: a filter that is louder with the same gain hears louder noise


class Adaptation:
    """Watch the control signals of a controller, window by window.

    Parameters
    ----------
    n_loudspeakers : int
        Number of loudspeakers J.
    window : int
        Samples of a window.

    Attributes
    ----------
    limited : ndarray, shape (J,)
        Samples of this window at the limit.
    """

    def __init__(self, n_loudspeakers: int, window: int) -> None:
        self.n_loudspeakers, self.window = n_loudspeakers, window
        self.restart()

    def restart(self) -> None:
        """Forget everything, as for another controller."""
        self._loud_windows, self._normal_gain = 0, np.inf
        self.begin()

    def begin(self) -> None:
        """Begin another window."""
        self._counted, self._energy = 0, np.zeros(self.n_loudspeakers)
        self.limited = np.zeros(self.n_loudspeakers)

    def play(self, y: np.ndarray) -> bool:
        """Add control signals (J, n); return whether they complete a window, which is then to be judged."""
        self._counted += y.shape[1]
        self._energy += np.sum(y * y, axis=1)
        return self._counted >= self.window

    def judged(self, controller: Any, largest_gain: float) -> str:
        """Return what shows a divergence in this window, empty if nothing does, and begin the next one."""
        power, often = self._energy / self._counted, np.any(self.limited > OFTEN_LIMITED * self._counted)
        self.begin()
        weights = getattr(controller, "control_filter", getattr(controller, "weights", np.zeros(1)))
        gain = float(np.max(np.abs(np.atleast_1d(weights)).sum(axis=-1)))
        if not gain <= largest_gain:
            return "weights"
        rated = getattr(controller, "rated_power", None)
        over = rated is not None and np.any(power > OVER_POWER * np.asarray(rated))
        if not over and not often:
            self._loud_windows, self._normal_gain = 0, gain
            return ""
        self._loud_windows += 1
        grown = not gain <= GROWN * self._normal_gain < np.inf
        return "power" if self._loud_windows >= PATIENCE and grown else ""
