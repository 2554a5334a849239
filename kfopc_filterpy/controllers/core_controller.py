"""The class of the built-in controllers: their state is in one block of the core's memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from .._types import NumberOrArray, PerLoudspeaker
from .._validate import as_count, as_nonnegative, as_positive, per_channel, per_loudspeaker
from ..checkpoint import Checkpointed
from ..core.block import REASONS, Algorithm, Block, InUse, Shape
from ..core.calls import LONGEST_CALL
from ..core.run_loop import REFUSED_REFERENCE, Steps, process
from ..paths.uncertainty import Uncertainty, as_uncertainty, guard_filter
from ..plant import Secondary
from ..power.amplifiers import Amplifiers, amplifier_models
from ..power.constraint import NUMBERS, Constraints, OutputPowerConstraint
from ..power.limiter import Limiters, OutputLimiter
from .base import Looped, calls_of, constraint_for, listed, require_rates
from .channels import Channels
from .processing import BlockProcessing, RefusedUpdate, adapt_flags, block_signals, checked_block

NO_SOLUTION = "the update has no solution: the covariance P is too large, S = x' P x' + q could overflow"
# Settings that may be zero; the others must be positive.
MAY_BE_ZERO = {"leak", "state_noise", "measurement_noise", "initial_variance", "regularization", "spread"}
MAY_BE_ZERO |= {"penalty_factor", "modified"}
# What a run records of each loudspeaker, by its name in the constraint's numbers.
RECORDED = {"constraint_factor": "factor", "disturbance_power": "power", "secondary_path_gain": "gain"}


class CoreController(Channels, BlockProcessing, Checkpointed):
    """A controller whose algorithm is in the core: `kf_opc`, `kf_pb`, `fx_lms` and the others return it.

    It has the channels, the estimated secondary path, the limiter, the constraint and the settings of its algorithm,
    which can be read as attributes, such as ``controller.step_size``.

    Parameters
    ----------
    name : str
        Name in results and legends.
    algorithm : str
        Name of the algorithm in the core.
    n_taps : int
        Taps L of the control filter, or of each of them.
    secondary : array_like, shape (n_taps,) or (K, J, n_taps), control system, Recording or Plant
        Estimated secondary path, or those from loudspeaker j to microphone k.
    settings : mapping
        Settings of the algorithm: a number each, or also (J,) or (K,) where each loudspeaker or microphone has its own.
    n_references : int, default 1
        Number of references I; None: the algorithm takes one channel only.
    amplifier : amplifier model or sequence of J of them, optional
        Known amplifier: the disturbance is then estimated with s^ * amplifier(y), not s^ * y.
    rated_power : float or array_like, shape (J,), optional
        Rated power of a constraint with default settings.
    constraint : OutputPowerConstraint or sequence of J of them, optional
        Given instead of `rated_power`: the constraint that computes the powers and the factor. A copy is kept. By
        default one whose factor is fixed at 1.
    fs : float, optional
        Sample rate in Hz for `rated_power`; a system, a recording or a plant as `secondary` brings it.
    limiter : OutputLimiter or sequence of J of them, optional
        Limiter of the control signal, not shared with another controller.

    Attributes
    ----------
    internal_model : bool
        Whether the last references come from an internal model, see `with_internal_model`; `n_references` are the
        others.

    Raises
    ------
    ValueError
        A setting that is out of range, fewer than one tap or reference, a path that is not FIR, a rated power without a
        sample rate.
    TypeError
        A setting that the algorithm does not have, or a limiter that is not an `OutputLimiter`.

    Examples
    --------
    >>> from kfopc_filterpy import fx_lms
    >>> controller = fx_lms(4, [1.0], step_size=0.1)
    >>> controller
    <FxLMS: 4 taps, constraint factor 1>
    >>> controller.step_size
    0.1
    """

    takes_guard: ClassVar[bool] = True  # whether the step takes account of an uncertain secondary path
    internal_model: bool = False
    _block: Block
    _uncertainty: Any = None  # as it was assigned

    def __init__(
        self,
        name: str,
        algorithm: str,
        n_taps: int,
        secondary: Secondary,
        *,
        settings: Mapping[str, Any],
        n_references: int | None = 1,
        amplifier: Amplifiers = None,
        rated_power: PerLoudspeaker | None = None,
        constraint: Constraints = None,
        fs: float | None = None,
        limiter: Limiters = None,
    ) -> None:
        self.name, self.algorithm = name, algorithm
        self.n_taps = as_count(n_taps, "n_taps")
        path = self._read_paths(secondary, n_references)
        self._constrained = rated_power is not None or constraint is not None
        self._limiter = self._checked_limiter(limiter)
        self._own_constraint = self._checked_constraint(
            constraint_for(rated_power, constraint, fs, self._path_fs) if self._constrained else None
        )
        models = amplifier_models(amplifier, self.n_loudspeakers)
        wanted = {one.name for one in Algorithm(algorithm).settings}
        if set(settings) != wanted:
            raise TypeError(f"{self.name} has the settings {sorted(wanted)}, got {sorted(settings)}")
        block = Block(
            Algorithm(algorithm),
            self._needed_shape(path.shape[-1], guard_taps=0),
            path=path,
            settings={name: self._checked_setting(name, value) for name, value in settings.items()},
        )
        block.fields["amplifier"][0, 0] = models
        self._use_block(block)

    def __getattr__(self, name: str) -> Any:
        """Return a setting of the algorithm: a number, or with several channels (J,) or (K,) where each has its own."""
        if not name.startswith("_") and name in (one.name for one in Algorithm(self.algorithm).settings):
            return self._of_setting(name)
        raise AttributeError(f"{type(self).__name__} {self.__dict__.get('name', '')!r} has no attribute {name!r}")

    @property
    def shares_gains(self) -> bool:
        """Whether runs that differ only in what they measure can share this controller's gains, see `simulate`."""
        return not self.internal_model

    # Channels: numbers with one, arrays with several.

    def _shaped(self, values: np.ndarray) -> Any:
        """Return the core's value of each channel: a number, or with several channels a copy."""
        return values.copy() if self.multichannel else float(values[0])

    def _number_of_each(self, name: str) -> Any:
        """Return a field of the core that has a number for each channel."""
        return self._shaped(self._block.fields[name].ravel())

    def _by_channel(self, name: str) -> np.ndarray:
        """Return a field of filters, (outputs, inputs, taps), or (taps,) with one channel, in the core's memory."""
        return self._by_count(self._block.fields[name][0])

    def _by_count(self, filters: np.ndarray) -> np.ndarray:
        """Return filters (outputs, inputs, taps) as users see them: the only one of one channel is (taps,)."""
        return filters if self.multichannel or filters.shape[:2] != (1, 1) else filters[0, 0]

    # Checks of what the user gives.

    def _checked_setting(self, name: str, value: Any) -> Any:
        """Return a checked setting: a number, or an array if each of several channels has its own."""
        check = as_nonnegative if name in MAY_BE_ZERO else as_positive
        each = self._who_has(name)
        return per_channel(value, getattr(self, f"n_{each}"), each, name, check) if each else check(value, name)

    def _who_has(self, name: str) -> str:
        """Return which channels have a setting each, "loudspeakers" or "microphones"; "" if all share one."""
        return next(one.each for one in Algorithm(self.algorithm).settings if one.name == name)

    def _checked_limiter(self, limiter: Any) -> Any:
        """Return None, a limiter, or a tuple of limiters."""
        if limiter is None or (not self.multichannel and isinstance(limiter, OutputLimiter)):
            return limiter
        if not self.multichannel:
            raise TypeError(f"limiter must be an OutputLimiter or None, got {limiter!r}")
        limiters = tuple(limiter) if isinstance(limiter, Sequence) else ()
        different = len(limiters) == self.n_loudspeakers == len({id(one) for one in limiters})
        if not different or not all(isinstance(one, OutputLimiter) for one in limiters):
            raise TypeError(
                f"limiter must be {self.n_loudspeakers} different OutputLimiters, one for each loudspeaker, got {limiter!r}"
            )
        return limiters

    def _checked_constraint(self, own: Any) -> Any:
        """Return a constraint, or a tuple of them; if none is given, one whose factor is fixed at 1."""
        if own is None:
            # Its powers are recorded, nothing else: without a known rate their memory is 8000 samples.
            own = OutputPowerConstraint(1.0, fs=self._path_fs or 16000.0)
            own.factor = 1.0
        if not self.multichannel:
            if isinstance(own, tuple):
                raise ValueError(f"rated power and constraint must be one for one loudspeaker, got {len(own)}")
            return own
        each = own if isinstance(own, tuple) else tuple(deepcopy(own) for _ in range(self.n_loudspeakers))
        if len(each) != self.n_loudspeakers:
            raise ValueError(
                f"rated power and constraint must be one, or one for each of the {self.n_loudspeakers} loudspeakers, "
                f"got {len(each)}"
            )
        return each

    def _estimated_path(self) -> np.ndarray:
        """Return the estimated secondary path in the core's memory: the steps use what is written into it."""
        return self._by_channel("secondary_path")

    # The block.

    def _needed_shape(self, path_taps: int, guard_taps: int) -> Shape:
        """Return the shape of a block for the present limiter and constraint."""
        return Shape(
            self.n_microphones,
            self.n_loudspeakers,
            self.n_references + self.internal_model * self.n_microphones,
            self.n_taps,
            path_taps,
            guard_taps,
            tuple(one.state.window.shape[1] for one in self._each(self._own_constraint)),
            tuple(one.state.laps.shape[1] - 1 for one in self._each(self._limiter)),
            modelled=int(self.internal_model),
        )

    def _remake_block(self) -> None:
        """Go on in a block for the limiter and the internal model that are now in use."""
        block = self._block
        guard = block.fields["guard"].ravel()
        shape = self._needed_shape(block.shape.path_taps, guard.size)
        self._use_block(block.remade(shape, guard if guard.size else None))

    def _add_internal_model(self) -> None:
        """Let the internal model take the place of the last references."""
        self.name = f"{'hybrid' if self.n_references > self.n_microphones else 'feedback'} {self.name}"
        self.n_references -= self.n_microphones
        self.internal_model = True
        self._remake_block()

    @staticmethod
    def _each(value: Any) -> tuple[Any, ...]:
        """Return the limiters or constraints of the loudspeakers."""
        return () if value is None else value if isinstance(value, tuple) else (value,)

    def _use_block(self, block: Block) -> None:
        """Go on in a block, into which the constraints and limiters move."""
        fields = block.fields
        for j, constraint in enumerate(self._each(self._own_constraint)):
            window = _rows(fields["power_window"][0, j], block.shape.power_windows[j])
            constraint.live_in(fields["powers"][0, j], window, fields["constraint"][0, 0, j])
        for j, limiter in enumerate(self._each(self._limiter)):
            limiter.live_in(fields["limiter"][0, 0, j], _rows(fields["laps"][0, j], block.shape.limiter_windows[j] + 1))
        self._block = block

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Go on as a copy, with a block of its own; the constraints and limiters move into it."""
        vars(self).update(state)
        self._use_block(self._block)

    @property
    def in_use(self) -> InUse:
        """Context that refuses to be entered by a second thread: RuntimeError."""
        return self._block.in_use

    def _of_setting(self, name: str) -> Any:
        """Return a setting: a number, or with several channels (J,) or (K,) where each has its own."""
        values = self._block.fields[name].ravel()
        return self._shaped(values) if self._who_has(name) else float(values[0])

    def _take_setting(self, name: str, value: Any) -> None:
        """Assign a setting, checked."""
        with self.in_use:
            self._block.fields[name][:] = self._checked_setting(name, value)

    # Assignments.

    @property
    def limiter(self) -> Any:
        """Limiter of the control signal, or None; can be assigned, but not shared with another controller.

        With several channels it is a tuple, one for each loudspeaker. The disturbance is estimated from the output of
        the limiter, so the adaptation stays correct.
        """
        return self._limiter

    @limiter.setter
    def limiter(self, value: Limiters) -> None:
        block = self._block
        with block.in_use:
            before, self._limiter = self._limiter, self._checked_limiter(value)
            for limiter in self._each(before):
                limiter.move_out()
            for new, old in zip(self._each(self._limiter), self._each(before), strict=False):
                new.follow(old)
            self._remake_block()

    @property
    def secondary(self) -> np.ndarray:
        """Estimated secondary path s^, (n_path,), or with several channels (K, J, n_path); a copy.

        A new estimate can be assigned between two samples, also during a run: taps or an FIR system, or paths with the
        same channels, no longer than the present estimate. The stored references are filtered again with it, so the
        next update knows only the new path. The weights stay, and the control signal does not jump. A Kalman filter's
        covariance grows, because its weights belong to the old path. Running powers forget the old path within their
        memory. KF-PB begins to learn the plant anew, around the new path.
        """
        return self._estimated_path().copy()

    @secondary.setter
    def secondary(self, path: Secondary) -> None:
        before = self.secondary
        after = self._checked_estimate(path, before.shape)
        guard_filter(self._uncertainty, after)  # raises if none can be made, before anything changes
        with self.in_use:
            self._estimated_path()[:] = after
            if self._uncertainty is None or not self.takes_guard:
                self._block.refilter()
            else:  # measured paths, for example, have another distance from the new path
                self.secondary_path_uncertainty = self._uncertainty
            self._after_new_path(before)

    def _after_new_path(self, before: np.ndarray) -> None:
        """Adapt what the algorithm knows to the new estimate; `before` is the last one, of the same shape."""

    def _variance_by_new_path(self, before: np.ndarray) -> float:
        """Return the variance of each weight after a new path: relatively, the weights are as wrong as the old path."""
        after, w = self._estimated_path(), self.weights
        energy = max(np.sum(before**2), np.sum(after**2))
        return float(np.sum((after - before) ** 2) / energy * np.mean(w**2)) if energy > 0.0 else 0.0

    @property
    def secondary_path_uncertainty(self) -> Uncertainty | None:
        """Uncertainty of the secondary path as it was stated; None: the path is exact.

        Whatever `paths.path_uncertainty` takes can be assigned. The weights then minimise
        :math:`E[(d - w^T x')^2] + E[(w^T x'')^2]` with :math:`x'' = W * x'` and the filter W of `paths.guard_filter`: an
        LMS algorithm gets a leak shaped in frequency, which also limits its step size, and a Kalman filter gets a
        second observation. An uncertainty can be assigned for KF-ANC, KF-OPC, the diagonal Kalman filter and the LMS
        family, with one channel or several. `kf_pb` takes it as a setting, which cannot be changed, and learns the
        path.
        """
        return deepcopy(self._uncertainty)

    @secondary_path_uncertainty.setter
    def secondary_path_uncertainty(self, value: Uncertainty | None) -> None:
        if not self.takes_guard:
            raise ValueError(
                f"no secondary_path_uncertainty can be assigned to {self.name}: make it with "
                "kf_pb(..., secondary_path_uncertainty=...), or use KF-ANC, KF-OPC, the diagonal Kalman filter or an LMS "
                "algorithm"
            )
        taps = guard_filter(value, self._estimated_path())
        with self.in_use:
            self._uncertainty = as_uncertainty(value)
            self._use_block(self._block.with_guard(taps))

    @property
    def rated_power(self) -> NumberOrArray | None:
        """Rated output power of the controller, or of each loudspeaker, (J,); None if it has none.

        If the controller has a rated power, another one can be assigned at any time.
        """
        return self._read_rated_power()

    @rated_power.setter
    def rated_power(self, value: PerLoudspeaker) -> None:
        if self.rated_power is None:
            raise ValueError(
                f"{self.name} has no rated power that could be changed; kf_opc, kf_pb and mov_fx_lms, for example, have "
                "one; a limiter keeps one whatever the controller asks for"
            )
        value = per_loudspeaker(value, self.n_loudspeakers, "rated_power")
        with self.in_use:
            self._take_rated_power(value)

    def _read_rated_power(self) -> Any:
        return self._of_constraint("rated_power", self._own_constraint) if self._constrained else None

    def _take_rated_power(self, value: np.ndarray) -> None:
        """Use another rated power of each loudspeaker, (J,)."""
        for constraint, power in zip(np.atleast_1d(self._own_constraint), value, strict=True):
            constraint.rated_power = power

    # What can be read.

    @property
    def weights(self) -> np.ndarray:
        """Control filter w, (L,), or with several channels (J, I, L), newest-sample tap first; a copy."""
        return self._by_channel("weights").copy()

    @property
    def control_filter(self) -> np.ndarray:
        """Control filter that generates y, of the shape of `weights`; a copy."""
        return self.weights

    @property
    def constraint(self) -> Any:
        """Constraint that computes the powers and the factor; without a rated power its factor is fixed at 1.

        With several channels it is a tuple, one for each loudspeaker.
        """
        return self._own_constraint

    @property
    def constraint_factor(self) -> NumberOrArray:
        """Constraint factor of the last sample; with several channels (J,)."""
        return self._of_constraint("factor")

    @property
    def disturbance_power(self) -> NumberOrArray:
        """Running power of the disturbance estimate (eq. 10); with several channels (J,), summed over microphones."""
        return self._of_constraint("disturbance_power")

    @property
    def secondary_path_gain(self) -> NumberOrArray:
        """Running secondary-path gain (eq. 11); NaN until the reference has energy.

        With several channels (J,): E[x'^2] summed over microphones and references, over E[x^2] summed over references.
        """
        gain = self._of_constraint("secondary_path_gain")
        return np.array(gain, dtype=np.float64) if self.multichannel else np.nan if gain is None else gain

    def _of_constraint(self, name: str, constraint: Any = None) -> Any:
        """Return a number of the constraint, or of each of them, (J,)."""
        own = self.constraint if constraint is None else constraint
        return np.array([getattr(one, name) for one in own]) if isinstance(own, tuple) else getattr(own, name)

    def __repr__(self) -> str:
        limiters = self._each(self.limiter)
        counts = {
            "microphone": self.n_microphones,
            "loudspeaker": self.n_loudspeakers,
            "reference": self.n_references,
        }
        parts = [
            *(f"{n} {what}{'s' if n > 1 else ''}" for what, n in counts.items() if self.multichannel),
            f"{self.n_taps} taps",
            *([] if self.rated_power is None else [f"rated power {listed(self.rated_power, 'g')}"]),
            f"constraint factor {listed(self.constraint_factor, '.3g')}",
            *([f"limiter of rated power {listed([one.rated_power for one in limiters], 'g')}"] if limiters else []),
        ]
        return f"<{self.name}: {', '.join(parts)}>"

    # Samples.

    def control_signal(self, reference: NumberOrArray | None) -> NumberOrArray:
        """Return the control signal y(n) for the newest reference sample x(n), from the weights of the last sample.

        With several channels, x(n) is (I,) and y(n) is (J,). A feedback controller has no reference microphone: None.
        """
        block, x = self._block, self._sample(reference, "reference", "references")
        block.enter()
        try:
            block.reference[:] = x
            if answer := block.emit():
                raise ValueError(f"{REASONS[answer]}; nothing was changed")
            return self._shaped(block.control_signal)
        finally:
            block.leave()

    def update(self, error: NumberOrArray) -> None:
        """Adapt to the error e(n), with several channels (K,), that the last control signal left."""
        self._take(error, "update")

    def take_error(self, error: NumberOrArray) -> None:
        """Take an error without adapting to it, in place of `update`: an internal model needs it for its reference."""
        self._take(error, "take_error")

    def _take(self, error: Any, step: str) -> None:
        """Hand an error to a step of the core, "update" or "take_error"."""
        block, e = self._block, self._sample(error, "error", "microphones")
        block.enter()
        try:
            block.error[:] = e
            if answer := getattr(block, step)():
                raise ValueError(f"{REASONS[answer]}; nothing was changed")
        finally:
            block.leave()

    def process(
        self,
        references: ArrayLike | None,
        errors: ArrayLike,
        *,
        adapt: bool | ArrayLike = True,
        out: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the control signals of a block of samples, and adapt to its errors; see `BlockProcessing.process`."""
        looped = self.looped()
        if looped is None:
            return super().process(references, errors, adapt=adapt, out=out)
        x, e, flags, y = checked_block(self, references, errors, adapt, out)
        rows = [np.atleast_2d(np.ascontiguousarray(signal)) for signal in (x, e, y)]
        done, n_samples = 0, x.shape[-1]
        with self.in_use:
            while done < n_samples:
                end = min(done + LONGEST_CALL, n_samples)
                status, done = process(looped.steps, rows[0], rows[1], rows[2], flags, done, end)
                if done < end:
                    self._raise_refusal(x[..., done], e[..., done], done, status)
        return y

    def _raise_refusal(self, reference: Any, error: Any, sample: int, status: int) -> None:
        """Call a refused step again, which changes nothing, and raise `RefusedUpdate` with its reason."""
        try:
            if status == REFUSED_REFERENCE:
                self.control_signal(reference)
            self.update(error)
        except ValueError as reason:
            raise RefusedUpdate(str(reason), sample) from reason
        raise RefusedUpdate(NO_SOLUTION, sample)

    def listen(self, references: np.ndarray | None, errors: np.ndarray, *, adapt: bool | ArrayLike = True) -> None:
        """Follow the noise before the control is switched on: delay lines and powers advance, the weights stay.

        Parameters
        ----------
        references : ndarray, shape (n_samples,) or (I, n_samples), or None
            Reference; None for a feedback controller, which has none.
        errors : ndarray, shape (n_samples,) or (K, n_samples)
            Signals of the error microphones while the loudspeakers are silent.
        adapt : bool or ndarray of shape (n_samples,), default True
            Whether to follow a sample; the others only enter the delay lines.
        """
        x, e = block_signals(self, references, errors)
        flags = adapt_flags(adapt, x.shape[-1])
        with self.in_use:
            states = [self._block.memory, *(array for one in self._each(self.constraint) for array in one.state)]
            before = [array.copy() for array in states]
            try:
                self._listen(x.T, e.T, flags)
            except BaseException:
                for array, own in zip(states, before, strict=True):
                    array[...] = own
                raise

    def _listen(self, references: np.ndarray, errors: np.ndarray, adapting: np.ndarray) -> None:
        block = self._block
        x, e = (signal.reshape(len(signal), -1) for signal in (references, errors))
        for begin in range(0, len(x), LONGEST_CALL):
            part = slice(begin, begin + LONGEST_CALL)
            done, answer = block.listen(x[part], e[part], adapting[part])
            if answer:
                refused = ValueError(f"{REASONS[answer]}; nothing was changed")
                refused.add_note(f"in sample {begin + done} of those listened to")
                raise refused

    def looped(self) -> Looped | None:
        """Return what the core's loop needs to run this controller; None if Python must call the steps."""
        if calls_of(type(self)) != calls_of(CoreController):
            return None
        block = self._block
        constraint = block.fields["constraint"][0, 0].view(NUMBERS)[:, 0]
        return Looped(
            Steps(block.address, *block.algorithm.steps),
            self._by_channel("weights"),
            {name: constraint[field] for name, field in RECORDED.items()},
            owner=block,
        )

    @property
    def _powers_fs(self) -> float:
        """Sample rate in Hz of the power estimates."""
        return np.ravel(self.constraint)[0].fs

    def require_sample_rate(self, fs: float) -> None:
        """Raise ValueError if the controller, its secondary path or a limiter is for another rate than `fs` in Hz."""
        rates = {"controller": None if self.rated_power is None else self._powers_fs, "secondary path": self._path_fs}
        for j, limiter in enumerate(self._each(self.limiter)):
            rates[f"limiter {j}" if self.multichannel else "limiter"] = limiter.fs
        require_rates(fs, rates)


def _rows(room: np.ndarray, length: int) -> np.ndarray:
    """Return three rows of a length at the start of the room for three of the longest."""
    return room.reshape(-1)[: 3 * length].reshape(3, length)
