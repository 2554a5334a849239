"""The Kalman filter in O(L) per sample, by a fast array: growing or finite memory."""

from __future__ import annotations

import numpy as np

from .._types import PathModels
from .._validate import as_count
from ..power.amplifiers import Amplifier
from ..power.constraint import OutputPowerConstraint
from ..power.limiter import OutputLimiter
from .base import as_forgetting
from .core_controller import CoreController

ENERGY, LOST = 1, 4  # places in the records `array_numbers` and `turns` of fast_array.c
LEAST_MEMORY = 2  # in filter lengths


class FastArrayKalman(CoreController):
    r"""Fast-array Kalman filter: eq. 2-9 with r = 0 in O(L), using the shift of the filtered reference.

    With `forgetting` = 1 it is `kf_anc` with ``state_noise=0`` (or `kf_opc`, with a rated power), to rounding. Below 1
    it is `fx_rls` from P = `initial_variance` diag(lambda, ..., lambda^L), which the derivation requires. It has no
    state noise, which would break the structure that makes the filter fast. For a random walk that follows a changing
    path, use the O(L^2) filter.

    Rounding: without forgetting, the weights agree with those of the O(L^2) filter to about 1e-10 over a million
    samples, on white, coloured and band-limited noise. With forgetting, errors grow by 1/lambda per sample until the
    array is lost, after 10 to 20 memories of 1/(1 - lambda) samples: about ten seconds for lambda = 0.9999 at 16 kHz.
    `update` then raises ValueError, and the weights stay as they were. The next sample begins a new array at them, with
    P = `initial_variance`. A narrow band with an `initial_variance` far above `measurement_noise` can spoil the array
    without forgetting, too, and so can a reference sample a million times as loud as the others. A huge error leaves
    the array as it is, but moves the weights, and without forgetting its effect fades only as 1/n over n samples.

    With `memory` = N the filter forgets and still runs forever, at less than twice the cost. Two filters without
    forgetting take turns: every N samples one of them is restarted from the weights in use, with
    P = `initial_variance`. The weights are a mixture of both that is as accurate as least squares over the last N
    samples, or as `fx_rls` with lambda = 1 - 2/N. A sample counts for 2 N samples. After that it is known only through
    the weights that a restarted filter begins with, which it trusts as if they had explained its first L - 1 samples.
    An array that rounding spoils before its time is restarted with a hundredth of its P, and each later one with twice
    the last, up to `initial_variance`.

    Parameters
    ----------
    n_taps : int
        Taps L of the control filter.
    secondary_path : array_like or control.TransferFunction
        Estimated secondary path, taps or an FIR system.
    measurement_noise, initial_variance
        q and P(0|0) as for `kf_anc`, both above zero.
    forgetting : float, default 1
        Forgetting factor lambda, above 0 and at most 1.
    memory : int, optional
        Memory N in samples, at least 2 L and at most 2^23. The excess error is L/N of the measurement noise. Not with
        `forgetting` below 1. By default only `forgetting` limits the memory.
    rated_power : float, optional
        Rated output power rho_o: the measurement is scaled by the constraint factor of eq. 13. By default there is no
        constraint.
    constraint : OutputPowerConstraint, optional
        Given instead of `rated_power`: a rated power with the settings of its power estimates. A copy is kept.
    amplifier : callable, optional
        Known amplifier model: the disturbance estimate is then e + s^ * amplifier(y); by default e + s^ * y.
    limiter : OutputLimiter, optional
        Limiter of the control signal, not shared with another controller.

    Raises
    ------
    ValueError
        A variance, forgetting factor or memory out of range, a memory beside a forgetting factor, a rated power that is
        not positive and finite, both a rated power and a constraint, fewer than one tap, a path that is not FIR. In a
        run without `memory`: an array that rounding or too loud a reference has corrupted, once.
    TypeError
        An amplifier that is not one of the package's models.

    Notes
    -----
    The gains must follow the filtered reference from the first sample on. The filter therefore also adapts while it
    listens, before the control is switched on: it starts with weights learnt from the noise so far.

    It uses the shift of the row by one sample at a time. Let P be in units of the measurement noise, u(n) = x'(n)^T the
    row and :math:`\gamma^{-1}(n) = 1 + \lambda^{-1} u(n) P(n-1) u(n)^T`. Successive rows share all but one sample, so

    .. math::

       \lambda^{-1} &\left( \begin{bmatrix} P(n) & 0 \\ 0 & 0 \end{bmatrix} -
       \begin{bmatrix} 0 & 0 \\ 0 & P(n-1) \end{bmatrix} \right) \\
       &= B(n)\, \mathrm{diag}(1, -1)\, B(n)^T

    keeps its rank of two, which it has at the start if P(-1) = eta diag(lambda^2, ..., lambda^{L+1}). One orthogonal and
    one hyperbolic rotation, which zero the second and third entry of the first row below, then update gain g, gamma and
    B together:

    .. math::

       \begin{bmatrix} \gamma^{-1/2}(n) & \bar u(n+1) B(n) \\
       \begin{bmatrix} 0 \\ g(n) \gamma^{-1/2}(n) \end{bmatrix} & B(n) \end{bmatrix} \Theta \\
       = \begin{bmatrix} \gamma^{-1/2}(n+1) & 0 \\
       \begin{bmatrix} g(n+1) \gamma^{-1/2}(n+1) \\ 0 \end{bmatrix} & \lambda^{1/2} B(n+1) \end{bmatrix}

    with :math:`\bar u(n+1)` the L + 1 newest samples. With forgetting, rounding errors grow by the factor 1/lambda per
    sample, since the errors of P are not forgotten. Without it they grow slowly, but if P(-1) is large, the rotations
    cancel its digits. The last entry of the rotated gain column is zero in exact arithmetic, so it shows how far an
    array has gone astray (`stray`).

    An array can also begin in the middle of a signal if it takes the earlier samples for zeros: :math:`\bar u` then has
    fewer entries than L + 1 at first, and the structure holds.

    References
    ----------
    R. Fraanje, A. H. Sayed, M. Verhaegen, N. J. Doelman, "A fast-array Kalman filter solution to active noise control",
    Int. J. Adapt. Control Signal Process. 19, 2005; A. H. Sayed, Fundamentals of Adaptive Filtering, Wiley 2003, ch. 14
    (fast array RLS), from which these equations follow.

    S. van Ophem, A. P. Berkhoff, "A numerically stable, finite memory, fast array recursive least squares filter for
    broadband active noise control", Int. J. Adapt. Control Signal Process. 30, 2016: two growing memories, mixed so that
    the information used is always the same, and restarted in turn. Of this paper we had only the abstract; the mixture,
    the restart and what is done about a lost array are derived here (``core/fast_array.c``).

    Examples
    --------
    >>> from kfopc_filterpy import FastArrayKalman
    >>> controller = FastArrayKalman(4, [1.0], measurement_noise=1.0)
    >>> controller.control_signal(1.0)
    0.0
    >>> controller.update(2.0)
    >>> round(float(controller.weights[0]), 12)  # K = 1 / (1 + 1)
    1.0
    """

    name = "fast-array KF"
    algorithm = "fast_array"
    takes_guard = False

    def __init__(
        self,
        n_taps: int,
        secondary_path: PathModels,
        *,
        measurement_noise: float,
        initial_variance: float = 1.0,
        forgetting: float = 1.0,
        memory: int | None = None,
        rated_power: float | None = None,
        constraint: OutputPowerConstraint | None = None,
        amplifier: Amplifier | None = None,
        limiter: OutputLimiter | None = None,
    ) -> None:
        settings: dict[str, float] = {"measurement_noise": measurement_noise, "initial_variance": initial_variance}
        forgetting = as_forgetting(forgetting)
        if memory is not None:
            memory = as_count(memory, "memory")
            least = LEAST_MEMORY * as_count(n_taps, "n_taps")
            if memory < least:
                raise ValueError(f"memory must be {LEAST_MEMORY} n_taps = {least} samples at least, got {memory}")
            if forgetting < 1.0:
                raise ValueError(f"give either memory or a forgetting factor below 1, got {memory} and {forgetting:g}")
            self.algorithm = "finite_memory"
            settings["memory"] = memory
        else:
            settings["forgetting"] = forgetting
        super().__init__(
            n_taps,
            secondary_path,
            settings=settings,
            n_references=None,
            amplifier=amplifier,
            rated_power=rated_power,
            constraint=constraint,
            limiter=limiter,
        )
        self.name = ("" if memory is None else "finite-memory ") + self.name + ("-OPC" if self._constrained else "")

    @property
    def forgetting(self) -> float:
        """Forgetting factor lambda."""
        return self._of_setting("forgetting") if self.algorithm == "fast_array" else 1.0

    @property
    def memory(self) -> int | None:
        """Memory N in samples; None without a finite memory."""
        return int(self._of_setting("memory")) if self.algorithm == "finite_memory" else None

    @property
    def stray(self) -> float:
        """Relative size of what rounding adds to the array, 0 in exact arithmetic; with a finite memory, the larger."""
        fields = self._opened().fields
        last, energy = fields["gain"][0, 0, :, -1], fields["arrays"][0, 0, :, ENERGY]
        return float(np.max(np.abs(last) / np.sqrt(np.where(energy > 0.0, energy, np.inf))))

    @property
    def arrays_lost(self) -> int:
        """Number of arrays that a finite memory has restarted before their time, because rounding had spoilt them."""
        return int(self._opened().fields["turns"].flat[LOST]) if self.algorithm == "finite_memory" else 0

    def _filter_again(self) -> None:
        """Keep the filtered reference: the array needs each row to be the last one, shifted by a sample."""
        filtered = self._opened().fields["filtered_reference"]
        before = filtered.copy()
        super()._filter_again()
        filtered[:] = before
