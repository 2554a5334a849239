"""Virtual microphones: a controller reduces the noise where no microphone is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from .._types import NumberOrArray, PerMicrophone
from .._validate import as_channels, as_count, as_real_array, per_channel, require_finite
from ..core.block import LOUDEST
from ..paths.observation import ObservationFilters
from ..plant import Secondary, estimated_secondary
from ..power.amplifiers import Amplifiers
from .base import Controller, WrappedController, differing_counts, listening
from .channel_samples import ChannelFilters, PlayedSound, require_moderate

if TYPE_CHECKING:
    import control


class FilterObserver:
    """Observation filters, sample by sample: the remote-microphone technique."""

    def __init__(self, taps: np.ndarray) -> None:
        self.n_virtual, self.n_physical, _ = taps.shape
        self._now = np.ascontiguousarray(taps[:, :, 0])
        self._past = ChannelFilters(taps[:, :, 1:])

    def estimate(self, disturbance: np.ndarray) -> np.ndarray:
        """Return (O * d_p)(n)."""
        return self._now @ disturbance + self._past.output()

    def advance(self, disturbance: np.ndarray) -> None:
        """Add d_p(n) to the delay lines."""
        self._past.push(disturbance)


class KalmanObserver:
    r"""Kalman filter that estimates the disturbance at virtual microphones from that at physical ones.

    The noise sources are white, and a state-space model leads from them to all microphones:

    .. math::

       z(n+1) = A z(n) + B v(n),

       d_p(n) = C_p z(n) + D_p v(n) + \eta(n),

       d_v(n) = C_v z(n) + D_v v(n)

    With the covariances Q of v and R of the microphones' own noise :math:`\eta`, and the solution P of the Riccati
    equation, the best estimate from the present and the past is

    .. math::

       \epsilon = d_p - C_p \hat z,

       \hat d_v = C_v \hat z + M \epsilon,

       \hat z \leftarrow A \hat z + K \epsilon

    .. math::

       S = C_p P C_p^T + D_p Q D_p^T + R,

       K = (A P C_p^T + B Q D_p^T) S^{-1},

       M = (C_v P C_p^T + D_v Q D_p^T) S^{-1}

    In the paper of Petersen et al. the control signals are further inputs of the model. Their contribution to the state
    is known, so it need not be estimated: `VirtualMicrophones` computes it with the secondary paths. The estimates are
    the same.

    Parameters
    ----------
    model : control.StateSpace
        Model of the disturbance, discrete in time with ``dt = 1/fs`` and stable. Inputs: the noise sources. Outputs:
        the physical microphones, then the virtual ones. `realize_paths` makes such a model from primary paths; the
        colour of the noise must be part of it. If the control signals are further inputs of a model, pass
        ``model[:, :n_sources]``.
    n_physical : int
        Number of physical microphones K_p; the other outputs are virtual.
    sensor_noise_std : float or array_like, shape (K_p,)
        Standard deviation, above zero, of the noise of the physical microphones and of whatever else the model does not
        explain.
    source_power : float or array_like, shape (n_sources,), default 1
        Power of each noise source, the mean square of v.

    Attributes
    ----------
    n_physical, n_virtual : int
        Numbers of microphones K_p and K_v.
    virtual_variance : numpy.ndarray, shape (K_v,)
        Variance of the estimation error at each virtual microphone, from the Riccati equation.
    residual_db : numpy.ndarray, shape (K_v,)
        This variance relative to the power of the disturbance there, in dB, as in `ObservationFilters`.

    Raises
    ------
    TypeError, ValueError
        If the model is not a discrete-time state-space model, is unstable or has no output for a virtual microphone, or
        if a variance is not positive.

    Notes
    -----
    A sample takes about n^2 multiplications for n states.

    References
    ----------
    C. D. Petersen, R. Fraanje, B. S. Cazzolato, A. C. Zander, C. H. Hansen, "A Kalman filter approach to virtual
    sensing for active noise control", Mechanical Systems and Signal Processing 22(2), 2008. The correlation of process
    and measurement noise: T. Kailath, A. H. Sayed, B. Hassibi, Linear Estimation, Prentice Hall 2000, ch. 9.

    Examples
    --------
    White noise reaches the physical microphone at once, and the virtual one a sample later with half the amplitude:

    >>> import control
    >>> from kfopc_filterpy.controllers import KalmanObserver
    >>> model = control.StateSpace([[0.0]], [[1.0]], [[0.0], [0.5]], [[1.0], [0.0]], 1 / 8000)
    >>> KalmanObserver(model, n_physical=1, sensor_noise_std=0.1).virtual_variance.round(5)  # 0.5^2 * 0.01 / 1.01
    array([0.00248])
    """

    def __init__(
        self,
        model: control.StateSpace,
        n_physical: int,
        *,
        sensor_noise_std: PerMicrophone,
        source_power: float | ArrayLike = 1.0,
    ) -> None:
        from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

        self.n_physical = as_count(n_physical, "n_physical")
        A, B, C, D, self.fs = _matrices(model, self.n_physical)
        self.n_virtual = len(C) - self.n_physical
        Q = np.diag(per_channel(source_power, B.shape[1], "sources", "source_power"))
        R = np.diag(per_channel(sensor_noise_std, self.n_physical, "physical microphones", "sensor_noise_std") ** 2)
        physical, virtual = slice(None, self.n_physical), slice(self.n_physical, None)
        self._A, self._Cp, self._Cv = A, C[physical], C[virtual]
        white, shared = D[physical] @ Q @ D[physical].T + R, B @ Q @ D[physical].T
        P = solve_discrete_are(A.T, self._Cp.T, B @ Q @ B.T, white, s=shared)
        S = self._Cp @ P @ self._Cp.T + white
        cross = self._Cv @ P @ self._Cp.T + D[virtual] @ Q @ D[physical].T
        self._K = np.linalg.solve(S, (A @ P @ self._Cp.T + shared).T).T
        self._M = np.linalg.solve(S, cross.T).T
        own = D[virtual] @ Q @ D[virtual].T
        self.virtual_variance = np.diag(self._Cv @ P @ self._Cv.T + own - self._M @ cross.T).clip(min=0.0)
        power = np.diag(self._Cv @ solve_discrete_lyapunov(A, B @ Q @ B.T) @ self._Cv.T + own)
        share = self.virtual_variance / np.maximum(power, np.finfo(float).tiny)
        self.residual_db = 10 * np.log10(np.maximum(share, 1e-30))
        self._state = np.zeros(len(A))

    def __repr__(self) -> str:
        residual = ", ".join(f"{value:.1f}" for value in self.residual_db)
        return (
            f"<KalmanObserver: {self._state.size} states, {self.n_physical} physical and {self.n_virtual} virtual "
            f"microphone(s), residual {residual} dB>"
        )

    def estimate(self, disturbance: np.ndarray) -> np.ndarray:
        """Return the disturbance at the virtual microphones, (K_v,); nothing is changed.

        `disturbance` is the newest sample at the physical microphones, (K_p,).
        """
        return self._Cv @ self._state + self._M @ (disturbance - self._Cp @ self._state)

    def advance(self, disturbance: np.ndarray) -> None:
        """Update the state with `disturbance`, the newest sample at the physical microphones, (K_p,)."""
        self._state = self._A @ self._state + self._K @ (disturbance - self._Cp @ self._state)
        self._state[np.abs(self._state) < np.finfo(float).tiny] = 0.0  # denormal numbers are slow


def _matrices(model: Any, n_physical: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
    """Return A, B, C, D and the sampling rate in Hz of a model; raise an error if no observer can be made for it."""
    if not all(hasattr(model, name) for name in "ABCD"):
        raise TypeError(f"model must be a control.StateSpace, got {type(model).__name__}; control.ss converts a system")
    if model.dt is None or model.dt is True or model.dt == 0:
        raise ValueError(f"model must be discrete in time with dt = 1/fs, got dt = {model.dt}")
    if model.noutputs <= n_physical:
        raise ValueError(
            f"model must have outputs for the {n_physical} physical and the virtual microphones, got {model.noutputs}"
        )
    largest = np.max(np.abs(model.poles()), initial=0.0)
    if largest >= 1.0:
        raise ValueError(f"model must be stable, but has a pole of magnitude {largest:.6g}")
    A, B, C, D = (np.array(getattr(model, name), dtype=np.float64) for name in "ABCD")
    return A, B, C, D, 1.0 / float(model.dt)


class VirtualMicrophones(WrappedController):
    r"""A controller that reduces the error at places without a microphone, such as the ears in front of a headrest.

    It receives the errors of all microphones of the plant, but uses only those of the physical ones. From these it
    estimates the errors at the virtual microphones, and `controller` adapts to the estimates:

    .. math::

       \hat d_p = e_p + \hat s_p * y,

       \hat d_v = \mathrm{observer}(\hat d_p),

       \hat e_v = \hat d_v - \hat s_v * y

    With observation filters as the observer, :math:`\hat d_v = O * \hat d_p`, this is the remote-microphone technique;
    with a `KalmanObserver` it is the Kalman filter of Petersen et al. In `simulate`, the plant has all microphones, and
    the result contains the true error at each of them.

    Parameters
    ----------
    controller : Controller
        Controller for the virtual microphones: it takes errors (K_v,), and its secondary paths are those to the virtual
        microphones. With an internal model, its reference is :math:`\hat d_v(n - 1)`, for a headrest without
        a reference microphone. A controller of your own works too.
    secondary : array_like, shape (K, J, taps), nested sequence of control systems, or Plant
        Estimated secondary paths to all microphones of the plant, physical and virtual.
    observer : ObservationFilters, array_like of shape (K_v, K_p, n_taps), KalmanObserver, or an object like it
        Estimator of the disturbance at the virtual microphones. An object of your own needs two methods:
        ``estimate(disturbance)`` returns (K_v,) for the newest sample (K_p,) and changes nothing;
        ``advance(disturbance)`` adds the sample to its memory. Do not share it with another controller.
    physical : sequence of int
        Indices of the microphones that exist, in the order in which the observer takes them.
    virtual : sequence of int, optional
        Indices of the virtual microphones, in the order in which the observer returns them; by default all others.
    amplifier : amplifier model or sequence of J of them, optional
        Known amplifiers: the disturbance is then estimated from what they deliver, not from y.

    Attributes
    ----------
    physical, virtual : numpy.ndarray
        Indices of the physical and virtual microphones.

    Raises
    ------
    TypeError, ValueError
        Indices that are out of range or occur twice; an observer or a controller for a different number of microphones
        or loudspeakers. During a run: an error at a physical microphone that is not finite. Nothing was changed.

    Notes
    -----
    `simulate` calls it from Python sample by sample. This takes some tens of microseconds per sample more than calling
    `controller` alone in the same way, which itself takes longer than a compiled loop; the tutorial prints the time.
    The secondary paths take K J taps multiplications per sample, and observation filters K_v K_p n_taps.

    References
    ----------
    D. Moreau, B. Cazzolato, A. Zander, C. Petersen, "A review of virtual sensing algorithms for active noise control",
    Algorithms 1(2), 2008.

    Examples
    --------
    With one loudspeaker, the noise passes the physical microphone and reaches the virtual one a sample later:

    >>> import numpy as np
    >>> from kfopc_filterpy import Plant, fx_lms, noise_reduction_db, simulate
    >>> from kfopc_filterpy.controllers import VirtualMicrophones
    >>> secondary = np.zeros((2, 1, 4))
    >>> secondary[:, 0, 1] = [0.5, 1.0]  # physical, virtual
    >>> primary = np.zeros((2, 1, 8))
    >>> primary[[0, 1], 0, [4, 5]] = 1.0
    >>> plant = Plant(secondary, primary, fs=16000)
    >>> ears = fx_lms(8, secondary[1:], step_size=0.01)
    >>> controller = VirtualMicrophones(ears, plant, [[[0.0, 1.0]]], physical=[0])
    >>> result = simulate(controller, np.random.default_rng(0).standard_normal(4000), plant)
    >>> result.error.shape, bool(noise_reduction_db(result.error[1], result.disturbance[1]) > 60)
    ((2, 4000), True)
    """

    def __init__(
        self,
        controller: Controller,
        secondary: Secondary,
        observer: KalmanObserver | ArrayLike,
        *,
        physical: Sequence[int],
        virtual: Sequence[int] | None = None,
        amplifier: Amplifiers = None,
    ) -> None:
        super().__init__(controller, "with virtual microphones")
        paths, self._path_fs = estimated_secondary(secondary)
        self.n_microphones, self.n_loudspeakers, _ = paths.shape
        self.physical = self._indices(physical, "physical")
        others = np.setdiff1d(np.arange(self.n_microphones), self.physical)
        self.virtual = others if virtual is None else self._indices(virtual, "virtual")
        if not self.virtual.size:
            raise ValueError(f"virtual must name a microphone: all {self.n_microphones} of secondary are physical")
        self.observer = self._checked_observer(observer)
        wanted = {"n_microphones": self.virtual.size, "n_loudspeakers": self.n_loudspeakers}
        for name, own in differing_counts(self.controller, **wanted):
            raise ValueError(
                f"controller must be made for the {self.virtual.size} virtual microphones and {self.n_loudspeakers} "
                f"loudspeakers, but its {name} is {own}: make it with the secondary paths to the virtual microphones only"
            )
        self._sound = PlayedSound(paths, amplifier)
        self._virtual_error, self._awaits_error = np.zeros(self.virtual.size), False

    @property
    def multichannel(self) -> bool:
        """Whether signals have a channel axis: always, since there are two microphones at least."""
        return True

    def _indices(self, value: Any, name: str) -> np.ndarray:
        indices = np.array([as_count(index, name, minimum=0) for index in value])
        if not indices.size or indices.max() >= self.n_microphones or np.unique(indices).size < indices.size:
            raise ValueError(
                f"{name} must be different indices of the {self.n_microphones} microphones of secondary, "
                f"got {indices.tolist()}"
            )
        return indices

    def _checked_observer(self, observer: Any) -> Any:
        wanted = (self.virtual.size, self.physical.size)
        if isinstance(observer, ObservationFilters):
            observer = observer.taps
        if not (hasattr(observer, "estimate") and hasattr(observer, "advance")):
            taps = as_real_array(observer, "observer")
            if taps.ndim != 3 or taps.size == 0:
                raise ValueError(f"observer must be filters (K_v, K_p, n_taps), got shape {taps.shape}")
            require_finite(taps, "observer")
            observer = FilterObserver(taps)
        own = tuple(getattr(observer, name, n) for name, n in zip(("n_virtual", "n_physical"), wanted, strict=True))
        if own != wanted:
            raise ValueError(
                f"observer must lead from the {wanted[1]} physical to the {wanted[0]} virtual microphones, "
                f"but it leads from {own[1]} to {own[0]}"
            )
        return observer

    def __repr__(self) -> str:
        return f"<{self.name}: {self.physical.size} physical, {self.virtual.size} virtual>"

    @property
    def virtual_error(self) -> np.ndarray:
        """Last estimate of the error at the virtual microphones, (K_v,); a copy."""
        return self._virtual_error.copy()

    def _pass_on(self, name: str, value: Any) -> None:
        if name == "secondary":
            raise AttributeError(
                "VirtualMicrophones takes no new secondary path: its observer belongs to the paths that it was made "
                "with; make it again with the new ones"
            )
        super()._pass_on(name, value)

    def control_signal(self, reference: NumberOrArray) -> NumberOrArray:
        """Return the control signal y(n), (J,), for the newest reference sample x(n), (I,)."""
        y = self.controller.control_signal(reference)
        self._advance_unheard()
        self._awaits_error = True
        return self._sound.play(y)

    def update(self, error: NumberOrArray) -> None:
        """Let the controller adapt to the errors that the last control signal leaves at the virtual microphones.

        `error` is (K,), of all microphones; only the values of the physical ones are used.
        """
        self._take(error, self.controller.update)

    def take_error(self, error: NumberOrArray) -> None:
        """Take the errors without adapting to them, in place of `update`; only for a built-in controller."""
        self._take(error, self.controller.take_error)

    def _take(self, error: Any, step: Callable[[np.ndarray], None]) -> None:
        """Hand the errors at the virtual microphones to a step of the controller."""
        heard = as_real_array(error, "error").reshape(-1)
        if heard.size != self.n_microphones:
            raise ValueError(
                f"error must have a value for each of the {self.n_microphones} microphones, got {heard.size}"
            )
        for k in self.physical[~np.isfinite(heard[self.physical])]:
            raise ValueError(f"error must be finite, but that of microphone {k} is {heard[k]}")
        require_moderate(heard[self.physical], "error", LOUDEST)
        disturbance, virtual_error = self._estimate(heard)
        step(virtual_error)
        self.observer.advance(disturbance)
        self._virtual_error, self._awaits_error = virtual_error, False

    def _advance_unheard(self) -> None:
        """Keep the observer in time: a sample whose error was refused, or never came, counts as silence."""
        if self._awaits_error:
            self.observer.advance(np.zeros(self.physical.size))
            self._awaits_error = False

    def _estimate(self, heard: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the disturbance at the physical and the error at the virtual microphones."""
        anti_noise = self._sound.output()
        disturbance = heard[self.physical] + anti_noise[self.physical]
        return disturbance, self.observer.estimate(disturbance) - anti_noise[self.virtual]

    def listen(self, references: np.ndarray | None, errors: np.ndarray) -> None:
        """Let the controller follow the noise before the control is switched on, while the loudspeakers are silent.

        Parameters
        ----------
        references : ndarray, shape (I, n_samples), or None
            References; None for a feedback controller, which has none.
        errors : ndarray, shape (K, n_samples)
            Signals of all microphones; only those of the physical ones are used.
        """
        controller, given = listening(self.controller), np.asarray(errors if references is None else references)
        if np.ndim(errors) != 2 or len(errors) != self.n_microphones or given.shape[-1:] != np.shape(errors)[-1:]:
            raise ValueError(
                f"errors must be (K microphones, n_samples) with K = {self.n_microphones}, as many samples as references, "
                f"got {np.shape(errors)} and {given.shape}"
            )
        # What the virtual microphones hear is not used, so it may be anything.
        heard: np.ndarray = np.zeros(np.shape(errors))
        heard[self.physical] = as_channels(np.asarray(errors)[self.physical], "errors")
        before = self._sound.branched(), self._virtual_error, deepcopy(self.observer), self._awaits_error
        self._advance_unheard()
        virtual_errors = np.empty((self.virtual.size, heard.shape[1]))
        for n, sample in enumerate(heard.T):
            self._sound.push(np.zeros(self.n_loudspeakers))
            disturbance, self._virtual_error = self._estimate(sample)
            virtual_errors[:, n] = self._virtual_error
            self.observer.advance(disturbance)
        try:
            controller.listen(references, virtual_errors)
        except (ValueError, TypeError):
            self._sound, self._virtual_error, self.observer, self._awaits_error = before
            raise

    def _rates(self) -> dict[str, float | None]:
        return {"secondary path": self._path_fs, "observer": getattr(self.observer, "fs", None)}
