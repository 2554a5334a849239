"""KF-ANC (eq. 2-8) and KF-OPC (eq. 9-13) for any number of channels: all weights as one state."""

from __future__ import annotations

from typing import Any

import numpy as np

from .._types import NumberOrArray, PerLoudspeaker, PerMicrophone
from ..core.triangle import OWED, full_covariance
from ..plant import Secondary
from ..power.amplifiers import Amplifiers
from ..power.constraint import Constraints
from ..power.limiter import Limiters
from .core_controller import CoreController
from .making import controller_maker, require_rated_power


class KalmanInCore(CoreController):
    """KF-ANC, KF-OPC and FxRLS: what can be read of their state, and assigned."""

    @property
    def state_noise(self) -> float:
        """State noise variance r; can be assigned."""
        return self._of_setting("state_noise")

    @state_noise.setter
    def state_noise(self, value: float) -> None:
        self._take_setting("state_noise", value)

    @property
    def measurement_noise(self) -> NumberOrArray:
        """Measurement noise variance q, or with several channels that of each microphone, (K,); can be assigned."""
        return self._of_setting("measurement_noise")

    @measurement_noise.setter
    def measurement_noise(self, value: PerMicrophone) -> None:
        self._take_setting("measurement_noise", value)

    @property
    def covariance(self) -> np.ndarray:
        """State covariance P, (J I L, J I L), in the order of ``weights.ravel()``; a new array."""
        fields = {name: self._block.fields[name].ravel() for name in ("owed", "triangle", "gain_direction")}
        scale, diagonal, pending, *_ = fields["owed"].view(OWED).item()
        direction = fields["gain_direction"][: self._by_channel("weights").size]
        return full_covariance(fields["triangle"], direction, scale, diagonal, -scale * pending)

    def _after_new_path(self, before: np.ndarray) -> None:
        """Let P grow by the variance that the new paths give to the weights."""
        self._block.fields["owed"].ravel().view(OWED)["diagonal"] += self._variance_by_new_path(before)


@controller_maker
def kf_anc(
    n_taps: int,
    secondary: Secondary,
    *,
    state_noise: float,
    measurement_noise: PerMicrophone,
    initial_variance: float = 1.0,
    n_references: int = 1,
    amplifier: Amplifiers = None,
    limiter: Limiters = None,
) -> KalmanInCore:
    """Return KF-ANC, the Kalman filter of eq. 2-8 without a constraint.

    The state has the control filters of all loudspeakers for all references, (J, I, L), and the filtered references of
    a microphone are its observation row. The K measurements of a sample have independent noises, so they correct the
    weights one after the other, in O(K (J I L)^2) operations.

    Parameters
    ----------
    n_taps : int
        Taps L of the control filter, or of each of them.
    secondary : array_like, shape (n_path,) or (K, J, n_path), control system, Recording or Plant
        Estimated secondary path, or those from J loudspeakers to K microphones.
    state_noise : float
        State noise variance r (eq. 4), zero or above.
    measurement_noise : float or array_like, shape (K,)
        Measurement noise variance q (eq. 7) of all microphones or of each, zero or above. The larger its q, the less a
        microphone counts.
    initial_variance : float, default 1
        P(0|0) of each tap. It has the unit of a squared weight, so 1 may be far too much; `suggest_settings` computes
        the three from a silent run.
    n_references : int, default 1
        Number of references I.
    amplifier : amplifier model or sequence of J of them, optional
        Known amplifier model: the disturbance is then estimated with s^ * amplifier(y), not s^ * y as published.
    limiter : OutputLimiter or sequence of J of them, optional
        Limiter of the control signal, or one for each loudspeaker, not shared with another controller.

    Returns
    -------
    CoreController
        A controller named KF-ANC. With several channels, its signals and weights have channel axes.

    Raises
    ------
    ValueError, TypeError
        A setting that is out of range, or that does not fit the number of channels.

    See Also
    --------
    KFOPC : The same equations as a filterpy filter, ``dim_z=K``.
    KalmanController : The same structure around any filterpy filter.

    Notes
    -----
    With ``measurement_noise=0``, a sample that carries no information, such as a silent one, corrects nothing.

    Examples
    --------
    >>> from kfopc_filterpy import kf_anc
    >>> kf_anc(8, [1.0], state_noise=1e-6, measurement_noise=0.1).name
    'KF-ANC'

    With settings from a silent run:

    >>> import numpy as np
    >>> from kfopc_filterpy import Plant, suggest_settings
    >>> plant = Plant([1.0], np.eye(12)[9], fs=16000)
    >>> suggested = suggest_settings(np.random.default_rng(0).standard_normal(16000), plant)
    >>> kf_anc(suggested.n_taps, plant, **suggested.noises).n_taps
    16
    """
    return KalmanInCore(
        "KF-ANC",
        "kalman",
        n_taps,
        secondary,
        settings=kalman_settings(state_noise, measurement_noise, initial_variance),
        n_references=n_references,
        amplifier=amplifier,
        limiter=limiter,
    )


@controller_maker
def kf_opc(
    n_taps: int,
    secondary: Secondary,
    *,
    rated_power: PerLoudspeaker | None = None,
    constraint: Constraints = None,
    fs: float | None = None,
    state_noise: float,
    measurement_noise: PerMicrophone,
    initial_variance: float = 1.0,
    n_references: int = 1,
    amplifier: Amplifiers = None,
    limiter: Limiters = None,
) -> KalmanInCore:
    r"""Return KF-OPC, the Kalman filter with output power constraint (eq. 9-13).

    KF-OPC scales all measurements by one factor. Eq. 13 gives a factor for each loudspeaker as if it were alone; the
    smallest of them is used:

    .. math::

       \alpha = \min_j \min\{\sqrt{\rho_j G_j / \delta_d^2},\ 1\},

       G_j = \frac{\sum_{k,i} E[x_{kji}'^2]}{\sum_i E[x_i^2]},

       \delta_d^2 = \sum_k E[\hat d_k^2]

    This extension is the package's, not the paper's. With one loudspeaker, microphone and reference it is eq. 13. A
    loudspeaker that no microphone hears, :math:`G_j = 0`, is left out: its control filters stay zero.

    Parameters
    ----------
    n_taps, secondary, state_noise, measurement_noise, initial_variance, n_references, amplifier, limiter
        As for `kf_anc`.
    rated_power : float or array_like, shape (J,), optional
        Rated output power rho_o of all loudspeakers, or of each.
    constraint : OutputPowerConstraint or sequence of J of them, optional
        Given instead of `rated_power`: a rated power with the settings of its power estimates. A copy is kept.
    fs : float, optional
        Sample rate in Hz of the power estimates; a system, a recording or a plant as `secondary` brings it.

    Returns
    -------
    CoreController
        A controller named KF-OPC. With several loudspeakers, `constraint_factor` is (J,), each loudspeaker's own
        factor; the smallest one is applied.

    Raises
    ------
    ValueError, TypeError
        Neither a rated power nor a constraint, or both; a rated power without a sample rate; a setting that is out of
        range, or that does not fit the number of channels.

    See Also
    --------
    kf_pb : A filter that learns the plant, and spends the rated power where it reduces the noise most.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import kf_opc
    >>> kf_opc(8, [1.0], rated_power=0.5, fs=16000, state_noise=1e-6, measurement_noise=0.1).rated_power
    0.5
    >>> paths = np.zeros((2, 2, 8))  # two loudspeakers, two microphones
    >>> paths[:, :, 1] = [[1.0, 0.3], [0.2, 1.0]]
    >>> kf_opc(32, paths, rated_power=[0.5, 0.2], fs=16000, state_noise=1e-8, measurement_noise=0.01)
    <KF-OPC: 2 microphones, 2 loudspeakers, 1 reference, 32 taps, rated power 0.5, 0.2, constraint factor 1, 1>
    """
    require_rated_power(rated_power, constraint)
    return KalmanInCore(
        "KF-OPC",
        "kalman",
        n_taps,
        secondary,
        settings=kalman_settings(state_noise, measurement_noise, initial_variance),
        n_references=n_references,
        rated_power=rated_power,
        constraint=constraint,
        fs=fs,
        amplifier=amplifier,
        limiter=limiter,
    )


def kalman_settings(
    state_noise: float, measurement_noise: PerMicrophone, initial_variance: float, fading: float = 1.0
) -> dict[str, Any]:
    """Return the settings of the core's Kalman filter.

    `fading` is the factor of P in each sample, filterpy's alpha squared.
    """
    return {
        "state_noise": state_noise,
        "measurement_noise": measurement_noise,
        "initial_variance": initial_variance,
        "fading": fading,
    }
