"""The Kalman filter as the adaptation of the control filter: KF-ANC and KF-OPC, and any filterpy filter."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import ArrayLike

from .._types import PathModels, PerLoudspeaker, PerMicrophone
from ..bounds.settings import SuggestedSettings
from ..filters.kfopc import KFOPC
from ..power.amplifiers import Amplifier, Amplifiers
from ..power.constraint import DEFAULT_FS, Constraints, OutputPowerConstraint
from ..power.limiter import Limiters, OutputLimiter
from .base import constraint_for
from .core_controller import CoreController
from .direct import DirectKalman

_Made = TypeVar("_Made", bound=CoreController)


class KalmanController(CoreController):
    """The modified ANC structure around a filterpy filter: any `KalmanFilter` of one measurement.

    In each sample, the estimator gets the disturbance estimate as z and the filtered reference as H. With a rated
    power this is KF-OPC, without one KF-ANC. `kf_anc` and `kf_opc` return the same in C, which is much faster.

    Parameters
    ----------
    estimator : filterpy.kalman.KalmanFilter
        Filter whose state is the control filter, ``dim_z = 1``; a `KFOPC`, or filterpy's own.
    secondary_path : array_like or control.TransferFunction
        Estimated secondary path, taps or an FIR system.
    amplifier : callable, optional
        Known amplifier model: the disturbance estimate is then e + s^ * amplifier(y); by default e + s^ * y.
    name : str, optional
        Name in results and legends; by default KF-OPC with a rated power, else KF-ANC.
    limiter : OutputLimiter, optional
        Limiter of the control signal, not shared with another controller. No window of the control signal then exceeds
        the limiter's rated power.

    Raises
    ------
    TypeError
        An estimator that is not a filterpy KalmanFilter.
    ValueError
        An estimator of several measurements.

    Examples
    --------
    >>> from filterpy.kalman import KalmanFilter
    >>> from kfopc_filterpy import KalmanController
    >>> controller = KalmanController(KalmanFilter(dim_x=4, dim_z=1), secondary_path=[1.0])
    >>> controller.control_signal(1.0)
    0.0
    >>> controller.update(2.0)
    >>> float(controller.weights[0])  # K z = P / (P + R) z with P = I + Q = 2, R = 1
    1.3333333333333333
    """

    algorithm = "signals_alone"
    takes_guard = False  # the estimator gets one measurement in a sample

    def __init__(
        self,
        estimator: KalmanFilter,
        secondary_path: PathModels,
        *,
        amplifier: Amplifier | None = None,
        name: str | None = None,
        limiter: OutputLimiter | None = None,
    ) -> None:
        if not isinstance(estimator, KalmanFilter):
            raise TypeError(f"estimator must be a filterpy KalmanFilter, got {type(estimator).__name__}")
        if estimator.dim_z != 1:
            raise ValueError(
                f"estimator must have one measurement, dim_z = 1, got dim_z = {estimator.dim_z}; "
                "kf_anc and kf_opc take several microphones"
            )
        self.estimator = estimator
        super().__init__(
            estimator.dim_x, secondary_path, settings={}, n_references=None, amplifier=amplifier, limiter=limiter
        )
        self.name = name or ("KF-ANC" if self.rated_power is None else "KF-OPC")

    def _read_rated_power(self) -> float | None:
        return getattr(self.estimator, "rated_power", None)

    def _take_rated_power(self, value: float) -> None:
        self.estimator.rated_power = value

    @property
    def weights(self) -> np.ndarray:
        """Estimator's state w, (L,); a copy."""
        return np.array(self.estimator.x, dtype=np.float64).reshape(-1)

    @property
    def constraint(self) -> OutputPowerConstraint:
        """Constraint of the estimator, or else one that computes the powers, its factor fixed at the estimator's."""
        theirs = self.estimator.constraint if isinstance(self.estimator, KFOPC) else None
        if theirs is not None:
            return theirs
        if self._own_constraint.factor != self.constraint_factor:
            self._own_constraint.factor = self.constraint_factor
        return self._own_constraint

    @property
    def constraint_factor(self) -> float:
        """Constraint factor of the last sample."""
        return getattr(self.estimator, "constraint_factor", 1.0)

    def _after_new_path(self, before: np.ndarray) -> None:
        """Let P grow by the variance that the new path gives to the weights."""
        variance = self._variance_by_new_path(before)
        if variance > 0.0:
            self.estimator.P = self.estimator.P + variance * np.eye(self.n_taps)

    def control_signal(self, reference: float | None) -> float:
        """Return the control signal y(n) for the newest reference sample x(n), from the weights of the last sample."""
        weights = self._by_channel("weights")
        before = weights.copy()
        weights[:] = np.reshape(self.estimator.x, -1)
        try:
            return super().control_signal(reference)
        except BaseException:
            weights[:] = before
            raise

    def update(self, error: float) -> None:
        """Let the estimator predict and update (eq. 2-9) with the error e(n) that the last control signal left."""
        super().update(error)
        block, estimator = self._block, self.estimator
        d, x = float(block.fields["disturbance"].item()), float(block.latest("reference").flat[0])
        h, powers = block.latest("filtered_reference").reshape(1, -1)[:, : self.n_taps].copy(), self.constraint
        before = estimator.__dict__.copy()  # predictions write into no array
        try:
            estimator.predict()
            if isinstance(estimator, KFOPC):
                estimator.update(d, H=h, reference=x)
            else:
                estimator.update(np.full((1,) * np.ndim(estimator.x), d), H=h)
        except BaseException:  # the prediction must not stay
            estimator.__dict__.clear()
            estimator.__dict__.update(before)
            raise
        if powers is self._own_constraint:
            powers.advance(d, h[0, 0], x)

    def process(
        self,
        references: ArrayLike | None,
        errors: ArrayLike,
        *,
        adapt: bool | ArrayLike = True,
        out: np.ndarray | None = None,
    ) -> np.ndarray:
        """Process a block, see `BlockProcessing.process`; to the estimator, a sample that is not adapted to is missed."""
        y = super().process(references, errors, adapt=adapt, out=out)
        if not np.ravel(adapt)[-1]:
            self.estimator.update(None)
        return y

    def _listen(self, references: np.ndarray, errors: np.ndarray, adapting: np.ndarray) -> int:
        if self.constraint is self._own_constraint:
            return super()._listen(references, errors, adapting)
        block = self._block
        for n, e in enumerate(errors):
            taken = super()._listen(references[n : n + 1], errors[n : n + 1], adapting[n : n + 1])
            if not taken:
                return n
            if adapting[n]:
                filtered = float(block.latest("filtered_reference").flat[0])
                reference = float(block.latest("reference").flat[0])
                self.constraint.advance(float(e), filtered, reference)  # silent: d^ = e
        return len(references)


def kf_anc(
    n_taps: int | SuggestedSettings,
    secondary_path: PathModels,
    *,
    state_noise: float | None = None,
    measurement_noise: PerMicrophone | None = None,
    initial_variance: float | None = None,
    n_references: int = 1,
    amplifier: Amplifiers = None,
    limiter: Limiters = None,
) -> DirectKalman:
    """Return KF-ANC, the Kalman filter of eq. 2-8 without a constraint.

    Parameters
    ----------
    n_taps : int or SuggestedSettings
        Taps L of the control filter, or of each of them. Or pass the result of `suggest_settings`, which also supplies
        the defaults of the next three settings.
    secondary_path : array_like, shape (n_path,) or (K, J, n_path), or control system
        Estimated secondary path, or those from J loudspeakers to K microphones.
    state_noise : float, optional
        r, see `KFOPC.random_walk`; by default the suggested one.
    measurement_noise : float or array_like, shape (K,), optional
        q of all microphones, or of each; by default the suggested one.
    initial_variance : float, optional
        P(0|0) of each tap; by default the suggested one, or 1. It has the unit of a squared weight, so 1 may be far too
        much.
    n_references : int, default 1
        Number of references I.
    amplifier, limiter : optional
        See `DirectKalman`.

    Returns
    -------
    DirectKalman
        A controller named KF-ANC. With several channels, its signals and weights have channel axes.

    Raises
    ------
    ValueError, TypeError
        Neither suggested settings nor state noise and measurement noise; a setting that is out of range, or that does not
        fit the number of channels; another sample rate than that of the suggested settings.

    Examples
    --------
    >>> from kfopc_filterpy import kf_anc
    >>> kf_anc(8, [1.0], state_noise=1e-6, measurement_noise=0.1).name
    'KF-ANC'

    With settings from a silent run:

    >>> import numpy as np
    >>> from kfopc_filterpy import suggest_settings
    >>> x = np.random.default_rng(0).standard_normal(16000)
    >>> kf_anc(suggest_settings(x, np.roll(x, 9), [1.0]), [1.0]).n_taps
    16
    """
    return with_suggested(
        DirectKalman,
        n_taps,
        secondary_path,
        {"state_noise": state_noise, "measurement_noise": measurement_noise, "initial_variance": initial_variance},
        n_references=n_references,
        amplifier=amplifier,
        limiter=limiter,
    )


def kf_opc(
    n_taps: int | SuggestedSettings,
    secondary_path: PathModels,
    *,
    rated_power: PerLoudspeaker | None = None,
    constraint: Constraints = None,
    state_noise: float | None = None,
    measurement_noise: PerMicrophone | None = None,
    initial_variance: float | None = None,
    n_references: int = 1,
    amplifier: Amplifiers = None,
    limiter: Limiters = None,
    fs: float | None = None,
) -> DirectKalman:
    """Return KF-OPC, the Kalman filter with output power constraint (eq. 9-13).

    Parameters
    ----------
    n_taps, secondary_path, state_noise, measurement_noise, initial_variance, n_references, amplifier, limiter
        As for `kf_anc`.
    rated_power : float or array_like, shape (J,), optional
        Rated output power rho_o of all loudspeakers, or of each.
    constraint : OutputPowerConstraint or sequence of J of them, optional
        Alternative to `rated_power`: a rated power with the settings of its power estimates, for example the sample
        rate. A copy is kept.
    fs : float, optional
        Sample rate in Hz of the power estimates of a `rated_power`; by default that of suggested settings, or 16 kHz.

    Returns
    -------
    DirectKalman
        A controller named KF-OPC. With several loudspeakers it scales all measurements by their smallest factor.

    Raises
    ------
    ValueError, TypeError
        Neither a rated power nor a constraint, or both; neither suggested settings nor state noise and measurement noise;
        a setting that is out of range, or that does not fit the number of channels; another sample rate than that of the
        suggested settings.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import kf_opc
    >>> kf_opc(8, [1.0], rated_power=0.5, state_noise=1e-6, measurement_noise=0.1).rated_power
    0.5
    >>> paths = np.zeros((2, 2, 8))  # two loudspeakers, two microphones
    >>> paths[:, :, 1] = [[1.0, 0.3], [0.2, 1.0]]
    >>> kf_opc(8, paths, rated_power=[0.5, 0.2], state_noise=1e-6, measurement_noise=0.1).rated_power
    array([0.5, 0.2])
    """
    return with_suggested(
        DirectKalman,
        n_taps,
        secondary_path,
        {"state_noise": state_noise, "measurement_noise": measurement_noise, "initial_variance": initial_variance},
        constraint=suggested_constraint(n_taps, rated_power, constraint, fs),
        n_references=n_references,
        amplifier=amplifier,
        limiter=limiter,
    )


def with_suggested(
    kind: Callable[..., _Made],
    n_taps: int | SuggestedSettings,
    secondary_path: PathModels,
    noises: Mapping[str, Any],
    **others: Any,
) -> _Made:
    """Return a controller of a kind; suggested settings, if `n_taps` are such, replace the noises that are None."""
    suggested: Mapping[str, Any] = {"initial_variance": 1.0}
    taps = n_taps
    if isinstance(n_taps, SuggestedSettings):
        suggested, taps = n_taps.settings, n_taps.n_taps
    settings = {**suggested, **{name: value for name, value in noises.items() if value is not None}}
    if not {"state_noise", "measurement_noise"} <= settings.keys():
        raise TypeError(
            "give state_noise and measurement_noise, or pass the result of suggest_settings(reference, disturbance, "
            "secondary_path), from a run with a silent loudspeaker, as n_taps"
        )
    return at_suggested_rate(kind(taps, secondary_path, **settings, **others), n_taps)


def suggested_constraint(
    n_taps: int | SuggestedSettings, rated_power: PerLoudspeaker | None, constraint: Constraints, fs: float | None
) -> Any:
    """Return `constraint_for` at a sample rate, by default that of suggested settings if `n_taps` are such."""
    if constraint is not None and fs is not None:
        raise ValueError("fs belongs to rated_power: a constraint has its own, OutputPowerConstraint(..., fs=...)")
    return constraint_for(rated_power, constraint, rate_of(n_taps, fs))


def rate_of(n_taps: int | SuggestedSettings, fs: float | None) -> float:
    """Return a sample rate in Hz: `fs`, or else that of suggested settings given as `n_taps`, or else the default."""
    if fs is None:
        return n_taps.fs if isinstance(n_taps, SuggestedSettings) else DEFAULT_FS
    return fs


def at_suggested_rate(controller: _Made, n_taps: int | SuggestedSettings) -> _Made:
    """Return the controller, or raise ValueError if a part of it has another sample rate than suggested settings."""
    if isinstance(n_taps, SuggestedSettings):
        try:
            controller.require_sample_rate(n_taps.fs)
        except ValueError as error:
            raise ValueError(f"in the suggested settings, {error}") from None
    return controller
