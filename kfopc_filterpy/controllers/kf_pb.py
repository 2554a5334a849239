"""KF-PB: a posterior of the plant, and the control filter of least expected error within the rated power."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .._types import NumberOrArray, PerLoudspeaker
from .._validate import as_positive
from ..paths.uncertainty import Uncertainty, as_uncertainty, rms_relative_error
from ..plant import Secondary, estimated_secondary
from ..power.amplifiers import Amplifiers
from ..power.limiter import Limiters
from .base import Looped, as_run_rate
from .core_controller import CoreController
from .making import controller_maker

DEFAULT_AVERAGING_S = 10.0
LEAST_BLOCKS, MOST_BLOCKS = 20, 100_000  # in the averaging time
DEFAULT_UNCERTAINTY = 0.3  # relative rms error of a secondary path
LEAST_SPREAD, MOST_SPREAD = 1e-4, 1e3  # of a path that is not exact
WINDOWS, WINDOW_S = 8, 1.25  # windows of the references in the averaging time, and a window's longest time constant
BLOCK_S = 0.032  # from one posterior to the next, at least
MEMORY_S = 5.0  # time constant of what is known of the plant: it follows a drift of a tenth of the path in a second
# What is known about the plant: fields of the core's posterior.
POSTERIOR = (
    "posterior",
    "posterior_counts",
    "fits",
    "theta",
    "noise",
    "data",
    "data_of_errors",
    "error_energy",
    "before_data",
    "solution",
    "prior",
)


class PowerBudgetInCore(CoreController):
    """KF-PB: what can be read of its posterior and its account."""

    takes_guard = False  # the posterior knows how far the path may be off
    shares_gains = False  # it learns the plant, which differs from run to run
    _fs: float

    @property
    def alarms(self) -> int:
        """Number of times so far that the errors contradicted the paths."""
        return int(self._block.fields["alarms"].item())

    @property
    def primary_path(self) -> np.ndarray:
        """Posterior mean of the primary path, (N,), or with several channels (K, I, N); N = L + M - 1."""
        return self._by_count(self._means()[0]).copy()

    @property
    def identified_path(self) -> np.ndarray:
        """Posterior mean of the secondary path, of the shape of `secondary`; the given path if it is exact."""
        return self._by_count(self._means()[1]).copy()

    @property
    def measurement_noise(self) -> Any:
        """Power that the plant's model does not explain, or with several channels that at each microphone, (K,).

        It is 0 before the first posterior.
        """
        return self._number_of_each("noise")

    def _means(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the posterior means as the core has them, (K, I, N) and (K, J, M)."""
        fields = self._block.fields
        theta, given = fields["theta"][0], fields["secondary_path"][0]
        learned = self.n_loudspeakers if fields["spread"].item() > 0.0 else 0  # the last signals in theta
        references = theta.shape[1] - learned
        return theta[:, :references], theta[:, references:, : given.shape[-1]] if learned else given

    def _after_new_path(self, before: np.ndarray) -> None:
        """Begin the posterior anew around the new path; the control filter, the account and the signals stay."""
        block = self._block
        spread = block.fields["spread"]
        if spread.item() > 0.0 and self._uncertainty is not None:  # measured paths: another distance from the new path
            spread[:] = relative_spread(self._uncertainty, self._estimated_path()) or LEAST_SPREAD
        fresh = block.fresh(block.shape)
        for name in POSTERIOR:
            block.fields[name][:] = fresh.fields[name]

    def _read_rated_power(self) -> Any:
        return self._of_setting("rated_power")

    def _take_rated_power(self, value: np.ndarray) -> None:
        """Use another rated power; what was spent before still counts relative to the old one."""
        self._block.fields["rated_power"].ravel()[:] = value

    @property
    def _powers_fs(self) -> float:
        return self._fs

    @property
    def averaging_s(self) -> float:
        """Time in seconds over which the mean power is kept to the rated power, in whole blocks."""
        fields = self._block.fields
        return float(fields["averaging"].item() * fields["block"].item() / self._fs)

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


@controller_maker
def kf_pb(
    n_taps: int,
    secondary: Secondary,
    *,
    rated_power: PerLoudspeaker,
    fs: float | None = None,
    secondary_path_uncertainty: Uncertainty | None = DEFAULT_UNCERTAINTY,
    averaging_s: float = DEFAULT_AVERAGING_S,
    n_references: int = 1,
    amplifier: Amplifiers = None,
    limiter: Limiters = None,
) -> PowerBudgetInCore:
    r"""Return KF-PB, the Kalman filter with a power budget: the least expected error within the rated power.

    It has no step size and no noise variances to tune.

    Block by block of 32 ms, it learns a Gaussian posterior of the primary paths p and the secondary paths s, from

    .. math:: e = p * x - s * y + \text{noise}

    and gives each loudspeaker the control filter v of least expected error at a price :math:`\lambda` of its power,

    .. math:: \min_v E[(p * x - s * v * x)^2] + \lambda E[(v * x)^2]

    where the expectation includes the uncertainty of p and s. The price follows from an account: over any
    `averaging_s`, the mean power is kept to the rated power (what goes beyond 1.04 times is clipped), and what is left
    over in a quiet time can be spent in a louder one. No power is spent where even the whole rated power would reduce
    the power of the error by less than half of the measurement noise.

    Both paths are verified while they are used. If the errors contradict the posterior, the plant has changed, and all
    that was learned is forgotten. Unless the control still reduces the noise by 8 dB, the loudspeakers are silent for a
    block or two, until the paths are learned again. If a new `secondary` is assigned, the posterior begins anew, too. The
    account stays, and the control filter stays until the first solution.

    Parameters
    ----------
    n_taps : int
        Taps L of each control filter.
    secondary : array_like, shape (n_path,) or (K, J, n_path), control system, Recording or Plant
        Estimated secondary path, or those from J loudspeakers to K microphones.
    rated_power : float or array_like, shape (J,)
        Rated output power of all loudspeakers or of each, the mean square of the control signal.
    n_references : int, default 1
        Number of references I.
    amplifier : amplifier model or sequence of J of them, optional
        Known amplifier model: the loudspeakers then play amplifier(y), not y.
    limiter : OutputLimiter or sequence of J of them, optional
        Limiter of the control signal, not shared with another controller.
    secondary_path_uncertainty : PathTolerance, float or array_like, optional
        How far the true secondary path may be from the estimate: a relative rms error, by default 0.3, or whatever
        `paths.path_uncertainty` takes, such as the `uncertainty` of an identification. None: the path is exact, and is
        not verified.
    fs : float, optional
        Sample rate in Hz; a system, a recording or a plant as `secondary` brings it.
    averaging_s : float, default 10
        Time in seconds over which the mean power is kept to the rated power, at least 20 blocks of 32 ms (0.64 s). It
        is rounded to whole blocks.

    Returns
    -------
    CoreController
        A controller named KF-PB. Besides what others have, it tells `alarms`, the number of times that the errors
        contradicted the paths, the posterior means `primary_path` and `identified_path`, and `averaging_s`.

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
    After each block, a few steps of conjugate gradients approach the posterior and the control filters of all
    loudspeakers, from those of the last block. Their products are fast Fourier transforms of at least 2N samples; a
    secondary path has M taps, and a primary one N = L + M - 1. The posterior forgets over 5 s. `listen` learns the
    primary paths before the control is switched on.

    References
    ----------
    S. M. Kay, "Fundamentals of statistical signal processing: estimation theory", 1993, section 12.5, for the
    posterior. S. J. Elliott, "Signal processing for active control", 2001, section 3.4, for the filter at a price of
    its power. W. James, C. Stein, "Estimation with quadratic loss", 1961, for what is significant. The account and the
    surprise are the package's.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import Plant, kf_pb, simulate
    >>> plant = Plant([0.0, 1.0, 0.3], [0.0, 0.0, 0.0, 1.0], fs=2000)
    >>> controller = kf_pb(16, plant, rated_power=0.25, averaging_s=2.0)
    >>> result = simulate(controller, np.random.default_rng(0).standard_normal(12000), plant)
    >>> bool(np.mean(result.control_signal[-4000:] ** 2) < 1.05 * 0.25)
    True
    >>> controller.alarms
    0
    >>> paths = np.zeros((2, 2, 8))  # two loudspeakers, two microphones
    >>> paths[:, :, 1] = [[1.0, 0.3], [0.2, 1.0]]
    >>> kf_pb(32, paths, rated_power=[0.5, 0.2], fs=16000)
    <KF-PB: 2 microphones, 2 loudspeakers, 1 reference, 32 taps, rated power 0.5, 0.2, constraint factor 1, 1>
    """
    paths, path_fs = estimated_secondary(secondary)
    fs = as_run_rate(fs, path_fs)
    samples, block = as_positive(averaging_s, "averaging_s", unit="s") * fs, block_of(fs)
    if samples > MOST_BLOCKS * block:
        raise ValueError(f"averaging_s must be at most {MOST_BLOCKS * block / fs:g} s, got {averaging_s:g} s")
    if round(samples / block) < LEAST_BLOCKS:
        raise ValueError(
            f"averaging_s must be at least {LEAST_BLOCKS * block / fs:g} s, {LEAST_BLOCKS} blocks of {block} samples, got "
            f"{averaging_s:g} s: to keep the power over a shorter time, give limiter=OutputLimiter(..., window_s=...)"
        )
    controller = PowerBudgetInCore(
        "KF-PB",
        "power_budget",
        n_taps,
        secondary,
        settings={
            "rated_power": rated_power,
            "block": block,
            "averaging": round(samples / block),
            "window": math.exp(-1.0 / min(samples / WINDOWS, WINDOW_S * fs)),
            "memory": math.exp(-1 / (MEMORY_S * fs)),
            "spread": relative_spread(secondary_path_uncertainty, paths),
        },
        n_references=n_references,
        amplifier=amplifier,
        limiter=limiter,
    )
    controller._fs, controller._uncertainty = fs, as_uncertainty(secondary_path_uncertainty)
    return controller


def block_of(fs: float) -> int:
    """Return the number of samples in a block at a sample rate."""
    return max(round(BLOCK_S * fs), 1)


def relative_spread(uncertainty: Any, secondary: Any) -> float:
    """Return the relative rms error of the path as the core takes it, 0 if the path is exact."""
    error = rms_relative_error(uncertainty, secondary)
    if error > MOST_SPREAD:
        raise ValueError(f"secondary_path_uncertainty must be at most {MOST_SPREAD:g}, got {error:g}")
    return max(error, LEAST_SPREAD) if error > 0.0 else 0.0
