"""The Kalman filter with only the diagonal of its covariance, in O(L) per sample."""

from __future__ import annotations

import numpy as np

from .._types import PerLoudspeaker
from ..plant import Secondary
from ..power.amplifiers import Amplifiers
from ..power.constraint import Constraints
from ..power.limiter import Limiters
from .core_controller import CoreController
from .making import controller_maker


class DiagonalInCore(CoreController):
    """The diagonal Kalman filter: what can be read of its state."""

    @property
    def variances(self) -> np.ndarray:
        """Diagonal of P, (L,), with several channels (J, I, L); a copy."""
        return self._by_channel("variances").copy()

    def _after_new_path(self, before: np.ndarray) -> None:
        """Let the variances grow by that which the new path gives to the weights."""
        self._block.fields["variances"][:] += self._variance_by_new_path(before)


@controller_maker
def diagonal_kf(
    n_taps: int,
    secondary: Secondary,
    *,
    state_noise: float,
    measurement_noise: float,
    initial_variance: float = 1.0,
    rated_power: PerLoudspeaker | None = None,
    constraint: Constraints = None,
    fs: float | None = None,
    n_references: int = 1,
    amplifier: Amplifiers = None,
    limiter: Limiters = None,
) -> DiagonalInCore:
    r"""Return the diagonal Kalman filter: eq. 2-9 with P reduced to its diagonal p, an NLMS with a step for each tap.

    .. math::

       p \leftarrow p + r,

       S = \sum_i p_i x_i'^2 + q,

       K_i = p_i x'_i / S,

       w \leftarrow w + K (\alpha \hat d - w^T x'),

       p_i \leftarrow (1 - K_i x'_i) p_i

    It ignores the correlation between neighbouring taps of a coloured reference. It therefore converges like NLMS: the
    narrower the band, the slower it is than the full filter. On a white reference it comes close to the full filter
    after a dozen samples per tap.

    With several channels, p belongs to the weights of all loudspeakers, and the microphones measure them one after the
    other. The measurements are scaled by the least of the loudspeakers' constraint factors.

    Parameters
    ----------
    n_taps, secondary, n_references, limiter
        As for `fx_lms`.
    state_noise, measurement_noise, initial_variance
        r, q and P(0|0) as for `kf_anc`; q is that of all microphones.
    rated_power : float or array_like, shape (J,), optional
        Rated output power rho_o, or that of each loudspeaker: the measurement is scaled by the constraint factor alpha
        of eq. 13. By default there is no constraint, alpha = 1.
    constraint : OutputPowerConstraint or sequence of J of them, optional
        Given instead of `rated_power`: a rated power with the settings of its power estimates. A copy is kept.
    fs : float, optional
        Sample rate in Hz of the power estimates; a system, a recording or a plant as `secondary` brings it.
    amplifier : amplifier model or sequence of J of them, optional
        Known amplifier model: the disturbance estimate is then e + s^ * amplifier(y); by default e + s^ * y.

    Returns
    -------
    CoreController
        A controller named diagonal KF, or diagonal KF-OPC with a rated power. Its `variances` are the diagonal of P.

    Raises
    ------
    ValueError
        A variance that is negative or above 1e50, a rated power that is not positive and finite, both a rated power and
        a constraint, fewer than one tap or reference, a path that is not FIR.
    TypeError
        An amplifier that is not one of the package's models.

    References
    ----------
    After J. Fabry, S. Liebich, P. Vary, P. Jax, "Active noise control with reduced-complexity Kalman filter", IWAENC
    2018. The text was not available; the equations are derived from eq. 2-9.

    Examples
    --------
    >>> from kfopc_filterpy import diagonal_kf
    >>> controller = diagonal_kf(4, [1.0], state_noise=0.0, measurement_noise=1.0)
    >>> controller.control_signal(1.0)
    0.0
    >>> controller.update(2.0)
    >>> float(controller.weights[0]), float(controller.variances[0])  # K = 1 / (1 + 1)
    (1.0, 0.5)
    """
    return DiagonalInCore(
        "diagonal KF" if rated_power is None and constraint is None else "diagonal KF-OPC",
        "diagonal",
        n_taps,
        secondary,
        settings={
            "state_noise": state_noise,
            "measurement_noise": measurement_noise,
            "initial_variance": initial_variance,
        },
        n_references=n_references,
        amplifier=amplifier,
        rated_power=rated_power,
        constraint=constraint,
        fs=fs,
        limiter=limiter,
    )
