"""The Kalman filter with only the diagonal of its covariance, in O(L) per sample."""

from __future__ import annotations

import numpy as np

from .._types import PathModels, PerLoudspeaker
from .._validate import as_nonnegative
from ..power.amplifiers import Amplifiers
from ..power.constraint import Constraints
from ..power.limiter import Limiters
from .core_controller import CoreController, setting


class DiagonalKalman(CoreController):
    r"""Reduced-complexity Kalman filter: eq. 2-9 with P reduced to its diagonal p, an NLMS with a step for each tap.

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
    n_taps, secondary_path, n_references, limiter
        As for `FxLMS`.
    state_noise, measurement_noise, initial_variance
        r, q and P(0|0) as for `kf_anc`; q is that of all microphones.
    rated_power : float or array_like, shape (J,), optional
        Rated output power rho_o, or that of each loudspeaker: the measurement is scaled by the constraint factor alpha
        of eq. 13. By default there is no constraint, alpha = 1.
    constraint : OutputPowerConstraint or sequence of J of them, optional
        Given instead of `rated_power`: a rated power with the settings of its power estimates. A copy is kept.
    amplifier : callable or sequence of J of them, optional
        Known amplifier model: the disturbance estimate is then e + s^ * amplifier(y); by default e + s^ * y.

    Attributes
    ----------
    variances : ndarray
        (L,) diagonal of P, with several channels (J, I, L); a copy.

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
    >>> from kfopc_filterpy import DiagonalKalman
    >>> controller = DiagonalKalman(4, [1.0], state_noise=0.0, measurement_noise=1.0)
    >>> controller.control_signal(1.0)
    0.0
    >>> controller.update(2.0)
    >>> float(controller.weights[0]), float(controller.variances[0])  # K = 1 / (1 + 1)
    (1.0, 0.5)
    """

    name = "diagonal KF"
    algorithm = "diagonal"
    checks = dict.fromkeys(("state_noise", "measurement_noise", "initial_variance"), as_nonnegative)
    state_noise = setting("State noise variance r.")
    measurement_noise = setting("Measurement noise variance q.")

    def __init__(
        self,
        n_taps: int,
        secondary_path: PathModels,
        *,
        state_noise: float,
        measurement_noise: float,
        initial_variance: float = 1.0,
        rated_power: PerLoudspeaker | None = None,
        constraint: Constraints = None,
        amplifier: Amplifiers = None,
        n_references: int = 1,
        limiter: Limiters = None,
    ) -> None:
        super().__init__(
            n_taps,
            secondary_path,
            settings={
                "state_noise": state_noise,
                "measurement_noise": measurement_noise,
                "initial_variance": initial_variance,
            },
            n_references=n_references,
            amplifier=amplifier,
            rated_power=rated_power,
            constraint=constraint,
            limiter=limiter,
        )
        if self._constrained:
            self.name = "diagonal KF-OPC"

    @property
    def variances(self) -> np.ndarray:
        """Diagonal of P, (L,), with several channels (J, I, L); a copy."""
        return self._by_channel("variances").copy()

    def _after_new_path(self, before: np.ndarray) -> None:
        """Let the variances grow by that which the new path gives to the weights."""
        self._block.fields["variances"][:] += self._variance_by_new_path(before)
