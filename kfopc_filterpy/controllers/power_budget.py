"""KF-PB: a posterior of the plant, and the control filter of least expected error within the rated power."""

from __future__ import annotations

import math
from typing import Any

from .._types import NumberOrArray, PathModels, PerLoudspeaker
from .._validate import as_positive
from ..bounds.settings import SuggestedSettings
from ..paths.uncertainty import Uncertainty, as_uncertainty
from ..power.amplifiers import Amplifiers
from ..power.constraint import DEFAULT_FS
from ..power.limiter import Limiters
from .base import Looped
from .kalman import at_suggested_rate, rate_of
from .posterior import DEFAULT_UNCERTAINTY, PosteriorController, block_of, relative_spread

DEFAULT_AVERAGING_S = 10.0
LEAST_BLOCKS, MOST_BLOCKS = 20, 100_000  # in the averaging time


class PowerBudgetController(PosteriorController):
    r"""KF-PB, the Kalman filter with a power budget: the least expected error within the rated power.

    Block by block of 32 ms, it learns a Gaussian posterior of the primary paths p and the secondary paths s, from

    .. math:: e = p * x - s * y + \text{noise}

    and gives each loudspeaker the control filter v of least expected error at a price :math:`\lambda` of its power,

    .. math:: \min_v E[(p * x - s * v * x)^2] + \lambda E[(v * x)^2]

    where the expectation includes the uncertainty of p and s. The price follows from an account: over any
    `averaging_s`, the mean power is kept to the rated power (what goes beyond 1.04 times is clipped), and what is left over in a quiet time can be spent in a
    louder one. Power is not spent where a whole rating of it would save less than half of the measurement noise.

    The secondary path is verified while it is used. If the errors contradict the posterior, an alarm resets it to the
    given path with a large uncertainty. The loudspeakers play little until the path has been learned again. If no
    secondary path explains the errors half a second later, the primary path has changed, and both are learned anew. If
    a new `secondary_path` is assigned, the whole posterior begins anew, including that of the primary paths. The
    account stays, and the control filter stays until the first solution.

    `kf_pb` makes it, with the same parameters, and takes suggested settings too.

    Parameters
    ----------
    n_taps : int
        Taps L of each control filter.
    secondary_path : array_like, shape (n_path,) or (K, J, n_path), or control system
        Estimated secondary path, or those from J loudspeakers to K microphones.
    rated_power : float or array_like, shape (J,)
        Rated output power of all loudspeakers or of each, the mean square of the control signal.
    n_references : int, default 1
        Number of references I.
    amplifier : callable or sequence of J of them, optional
        Known amplifier model: the loudspeakers then play amplifier(y), not y.
    limiter : OutputLimiter or sequence of J of them, optional
        Limiter of the control signal, not shared with another controller.
    secondary_path_uncertainty : PathTolerance, float or array_like, optional
        How far the true secondary path may be from the estimate: a relative rms error, by default 0.3, or whatever
        `paths.path_uncertainty` takes, such as the `uncertainty` of an identification. None: the path is exact, and is
        not verified.
    fs : float, default 16000
        Sample rate in Hz.
    averaging_s : float, default 10
        Time in seconds over which the mean power is kept to the rated power, at least 20 blocks of 32 ms.

    Raises
    ------
    ValueError, TypeError
        A setting that is out of range, or whose shape does not fit the secondary paths.

    See Also
    --------
    power_constrained_wiener : The best fixed filter within a rated power.
    kf_opc : The paper's constraint, by one factor.

    Notes
    -----
    The posterior is computed again when an eighth of the data is new, or earlier if the error is large. This takes
    :math:`O((IN + JM)^3)` operations, which are spread over as many blocks as they need; a secondary path has M taps,
    and a primary one N = L + M - 1. The posterior forgets over twice `averaging_s`. `listen` learns the primary paths
    before the control is switched on.

    References
    ----------
    S. M. Kay, "Fundamentals of statistical signal processing: estimation theory", 1993, section 12.5, for the
    posterior. S. J. Elliott, "Signal processing for active control", 2001, section 3.4, for the filter at a price of
    its power. The account and the alarm are the package's.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import simulate
    >>> from kfopc_filterpy.controllers import PowerBudgetController
    >>> path = [0.0, 1.0, 0.3]
    >>> controller = PowerBudgetController(16, path, rated_power=0.25, fs=2000.0, averaging_s=2.0)
    >>> x = np.random.default_rng(0).standard_normal(12000)
    >>> result = simulate(controller, x, primary_path=[0.0, 0.0, 0.0, 1.0], secondary_path=path, fs=2000.0)
    >>> bool(np.mean(result.control_signal[-4000:] ** 2) < 1.05 * 0.25)
    True
    >>> controller.alarms
    0
    """

    name = "KF-PB"
    algorithm = "power_budget"

    def __init__(
        self,
        n_taps: int,
        secondary_path: PathModels,
        *,
        rated_power: PerLoudspeaker,
        n_references: int = 1,
        amplifier: Amplifiers = None,
        limiter: Limiters = None,
        secondary_path_uncertainty: Uncertainty | None = DEFAULT_UNCERTAINTY,
        fs: float = DEFAULT_FS,
        averaging_s: float = DEFAULT_AVERAGING_S,
    ) -> None:
        self._fs = as_positive(fs, "fs", unit="Hz")
        samples = as_positive(averaging_s, "averaging_s", unit="s") * self._fs
        block = block_of(self._fs)
        if samples > MOST_BLOCKS * block:
            raise ValueError(f"averaging_s must be at most {MOST_BLOCKS * block / self._fs:g} s, got {averaging_s:g}")
        super().__init__(
            n_taps,
            secondary_path,
            settings={
                "rated_power": rated_power,
                "block": block,
                "averaging": max(round(samples / block), LEAST_BLOCKS),
                "window": math.exp(-1.0 / samples),
                "spread": relative_spread(secondary_path_uncertainty, secondary_path),
            },
            n_references=n_references,
            amplifier=amplifier,
            limiter=limiter,
        )
        self._uncertainty = as_uncertainty(secondary_path_uncertainty)

    def _read_rated_power(self) -> Any:
        return self._of_setting("rated_power")

    def _take_rated_power(self, value: Any) -> None:
        """Use another rated power; what was spent before still counts relative to the old one."""
        self._block.fields["rated_power"].ravel()[:] = value

    @property
    def _powers_fs(self) -> float:
        return self._fs

    @property
    def power_weight(self) -> NumberOrArray:
        """Price of power of the last block, or with several channels that of each loudspeaker, (J,)."""
        return self._number_of_each("price")

    def looped(self) -> Looped | None:
        """Return what the core's loop needs to run this controller; None if Python must call the steps."""
        looped = super().looped()
        if looped is None:
            return None
        return looped._replace(recorded={**looped.recorded, "power_weight": self._block.fields["price"].ravel()})


def kf_pb(
    n_taps: int | SuggestedSettings,
    secondary_path: PathModels,
    *,
    rated_power: PerLoudspeaker,
    n_references: int = 1,
    amplifier: Amplifiers = None,
    limiter: Limiters = None,
    secondary_path_uncertainty: Uncertainty | None = DEFAULT_UNCERTAINTY,
    fs: float | None = None,
    averaging_s: float = DEFAULT_AVERAGING_S,
) -> PowerBudgetController:
    """Return KF-PB, the Kalman filter with a power budget, which has the least error within the rated power.

    It has no step size and no noise variances to tune. With one channel or several, it learns the primary and secondary
    paths while it controls; see `controllers.PowerBudgetController`.

    Parameters
    ----------
    n_taps : int or SuggestedSettings
        Taps L of a control filter. Or pass the result of `suggest_settings`, of which KF-PB takes the taps and the
        sample rate.
    secondary_path : array_like, shape (n_path,) or (K, J, n_path), or control system
        Estimated secondary path, or those from J loudspeakers to K microphones.
    rated_power : float or array_like, shape (J,)
        Rated output power, of all loudspeakers or of each.
    n_references, amplifier, limiter
        As for `kf_anc`.
    secondary_path_uncertainty : PathTolerance, float or array_like, optional
        How far the true secondary path may be from the estimate: a relative rms error, by default 0.3, or whatever
        `paths.path_uncertainty` takes. If you have identified the path, pass the `uncertainty` of the result. None:
        the path is exact, and is not verified.
    fs : float, optional
        Sample rate in Hz; by default that of suggested settings, or 16 kHz.
    averaging_s : float, default 10
        Time in seconds over which the mean power is kept to the rated power.

    Returns
    -------
    PowerBudgetController
        A controller named KF-PB. With several channels, its signals and weights have channel axes.

    Raises
    ------
    ValueError, TypeError
        A setting that is out of range, or whose shape does not fit the secondary paths; another sample rate than that
        of the suggested settings.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import kf_pb
    >>> kf_pb(8, [1.0], rated_power=0.5).rated_power
    0.5
    >>> paths = np.zeros((2, 2, 8))  # two loudspeakers, two microphones
    >>> paths[:, :, 1] = [[1.0, 0.3], [0.2, 1.0]]
    >>> kf_pb(32, paths, rated_power=[0.5, 0.2])
    <KF-PB: 2 microphones, 2 loudspeakers, 1 reference, 32 taps, rated power 0.5, 0.2, constraint factor 1, 1>
    """
    controller = PowerBudgetController(
        n_taps.n_taps if isinstance(n_taps, SuggestedSettings) else n_taps,
        secondary_path,
        rated_power=rated_power,
        n_references=n_references,
        amplifier=amplifier,
        limiter=limiter,
        secondary_path_uncertainty=secondary_path_uncertainty,
        fs=rate_of(n_taps, fs),
        averaging_s=averaging_s,
    )
    return at_suggested_rate(controller, n_taps)
