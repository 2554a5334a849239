"""KF-ANC (eq. 2-8), KF-OPC (eq. 9-13) and FxRLS for any number of channels: all weights as one state."""

from __future__ import annotations

import numpy as np

from .._types import NumberOrArray, PathModels, PerLoudspeaker, PerMicrophone
from .._validate import as_nonnegative
from ..core.triangle import OWED, full_covariance
from ..power.amplifiers import Amplifiers
from ..power.constraint import Constraints
from ..power.limiter import Limiters
from .core_controller import CoreController, setting


class DirectKalman(CoreController):
    r"""KF-ANC or KF-OPC: the paper's equations with the control filters of all loudspeakers as one state.

    `kf_anc`, `kf_opc` and `fx_rls` make it. The state has the control filters of all loudspeakers for all references,
    (J, I, L), and the filtered references of a microphone are its observation row. The K measurements of a sample have
    independent noises, so they correct the weights one after the other, in O(K (J I L)^2) operations.

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
    n_taps : int
        Taps L of each control filter.
    secondary_path : array_like, shape (n_path,) or (K, J, n_path), or control system
        Estimated secondary path, or those from loudspeaker j to microphone k.
    state_noise : float
        State noise variance r (eq. 4), zero or above.
    measurement_noise : float or array_like, shape (K,)
        Measurement noise variance q (eq. 7) of all microphones or of each, zero or above. The larger its q, the less a
        microphone counts.
    initial_variance : float, default 1
        Variance of each tap before the first sample.
    fading : float, default 1
        Factor of P in each sample, filterpy's ``alpha`` squared; 1 or above.
    n_references : int, default 1
        Number of references I; None: one channel only.
    rated_power : float or array_like, shape (J,), optional
        Rated output power of all loudspeakers, or of each, for KF-OPC; None for KF-ANC.
    constraint : OutputPowerConstraint or sequence of J of them, optional
        Alternative to `rated_power`: rated powers with the settings of their power estimates. Copies are kept.
    amplifier : callable or sequence of J of them, optional
        Known amplifier model: the disturbance is then estimated with s^ * amplifier(y), not s^ * y as published.
    limiter : OutputLimiter or sequence of J of them, optional
        Limiter of the control signal, or one for each loudspeaker, not shared with another controller.
    name : str, optional
        Name in results and legends; by default KF-OPC with a rated power, else KF-ANC.
    **settings
        Settings that the `algorithm` of a subclass adds to these.

    Raises
    ------
    ValueError, TypeError
        A setting that is out of range, or whose shape does not fit the secondary paths.

    See Also
    --------
    KFOPC : The same equations as a filterpy filter, ``dim_z=K``.
    KalmanController : The same structure around any filterpy filter.
    kf_pb : A filter that learns the plant, and spends the rated power where it reduces the noise most.

    Notes
    -----
    If the secondary path has channel axes, or if there are several references, `weights` is (J, I, L) and
    `constraint_factor` is (J,), each loudspeaker's own factor; the smallest one is applied.

    With ``measurement_noise=0``, a sample that carries no information, such as a silent one, corrects nothing.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import kf_opc
    >>> paths = np.zeros((2, 2, 8))
    >>> paths[:, :, 1] = [[1.0, 0.3], [0.2, 1.0]]
    >>> kf_opc(32, paths, rated_power=0.5, state_noise=1e-8, measurement_noise=0.01)
    <KF-OPC: 2 microphones, 2 loudspeakers, 1 reference, 32 taps, rated power 0.5, 0.5, constraint factor 1, 1>
    """

    algorithm = "kalman"
    checks = dict.fromkeys(("state_noise", "measurement_noise", "initial_variance"), as_nonnegative)
    state_noise = setting("State noise variance r; can be assigned.", assignable=True)
    measurement_noise = setting(
        "Measurement noise variance q, or with several channels that of each microphone, (K,); can be assigned.",
        assignable=True,
    )

    def __init__(
        self,
        n_taps: int,
        secondary_path: PathModels,
        *,
        state_noise: float,
        measurement_noise: PerMicrophone,
        initial_variance: float = 1.0,
        fading: float = 1.0,
        n_references: int | None = 1,
        rated_power: PerLoudspeaker | None = None,
        constraint: Constraints = None,
        amplifier: Amplifiers = None,
        limiter: Limiters = None,
        name: str | None = None,
        **settings: float,
    ) -> None:
        super().__init__(
            n_taps,
            secondary_path,
            settings={
                "state_noise": state_noise,
                "measurement_noise": measurement_noise,
                "initial_variance": initial_variance,
                "fading": fading,
                **settings,
            },
            n_references=n_references,
            rated_power=rated_power,
            constraint=constraint,
            amplifier=amplifier,
            limiter=limiter,
        )
        self.name = name or ("KF-OPC" if self._constrained else "KF-ANC")

    @property
    def innovation(self) -> NumberOrArray:
        """Innovation alpha d^ - w'x' of the last update; with several channels that of each microphone, (K,).

        The microphones are measured one after the other, each with the weights that those before it have corrected.
        """
        return self._number_of_each("innovation")

    @property
    def innovation_variance(self) -> NumberOrArray:
        """Predicted variance S of that innovation (eq. 7), 0 before the first sample; with several channels (K,)."""
        return self._number_of_each("innovation_variance")

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
