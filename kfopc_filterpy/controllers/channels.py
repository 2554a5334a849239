"""Several loudspeakers and microphones: the signals of a controller, its compiled sample and its base class.

Axes lead with the channel, in the order in which sound travels backwards: microphones K, loudspeakers J, references I,
taps. Secondary paths are (K, J, taps), control filters (J, I, taps), primary paths (K, I, taps).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from .._validate import as_count, as_real_array
from ..kernels.compiling import compiled_for_states, inlined
from ..kernels.delay_lines import delay_line, newest, push
from ..kernels.holding import Held
from ..kernels.vectors import dot
from ..paths.channels import secondary_paths
from ..power.amplifiers import Amplifier, LinearAmplifier, amplify, compiled_model
from ..power.limiter import LimiterState, OutputLimiter, limit_sample
from .base import require_rates
from .step import adapt, control_filter, follow

REFUSED = (
    "the errors and the disturbance estimates must have finite squares, and one overflows: nothing was changed; scale "
    "the signals"
)


class ChannelLines(NamedTuple):
    """Signals that a controller of several channels uses, and its models."""

    secondary_estimate: np.ndarray  # (K, J, taps) of s^
    reference: np.ndarray  # (I, size) delay lines of x
    output: np.ndarray  # (J, size) delay lines of y, after limiters and amplifier models
    amplifiers: np.ndarray  # (J, 1) records of those models
    limiters: tuple[LimiterState, ...] | None
    control_signal: np.ndarray  # (J,) the last y
    disturbance: np.ndarray  # (K,) the last estimate d^


@inlined
def emit_channels(state, x):
    """Set the control signals y(n) for the newest references x, (I,), after any limiters; add both to their lines."""
    lines, w = state.lines, control_filter(state)
    for i in range(x.size):
        push(lines.reference[i], x[i])
    for j in range(w.shape[0]):
        y = 0.0
        for i in range(w.shape[1]):
            y += dot(w[j, i], newest(lines.reference[i], w.shape[2]))
        emit_channel(lines, j, y)


@inlined
def emit_channel(lines, j, y):
    """Set the control signal of a loudspeaker to y after its limiter, if there is one."""
    y = limited_channel(lines.limiters, j, y)
    lines.control_signal[j] = y
    push(lines.output[j], amplify(lines.amplifiers[j], y))


@inlined
def limited_channel(limiters, j, y):
    """Return y after the limiter of loudspeaker j, if there is one."""
    if limiters is None:
        return y
    return limit_sample(limiters[j], y)


@inlined
def estimate_disturbances(lines, error):
    """Set d^_k(n) = e_k(n) + sum_j (s^_kj * y_j)(n); return whether all have finite squares."""
    s, finite = lines.secondary_estimate, True
    for k in range(s.shape[0]):
        d = error[k]
        for j in range(s.shape[1]):
            d += dot(s[k, j], newest(lines.output[j], s.shape[2]))
        lines.disturbance[k] = d
        finite &= np.isfinite(d * d)
    return finite


# Entry points from Python.


@compiled_for_states()
def emit_channels_once(held, x):
    """Call `emit_channels` from Python, with a `Held` state."""
    emit_channels(held.state, x)


@compiled_for_states()
def adapt_channels_once(held, error):
    """Call `adapt` from Python, with a `Held` state."""
    return adapt(held.state, error, held.state.lines.control_signal)


@compiled_for_states(nogil=True)
def listen_channels(state, references, errors):
    """Follow signals while the loudspeakers are silent; return the number of samples processed before a refusal."""
    for n in range(references.shape[1]):
        for i in range(references.shape[0]):
            push(state.lines.reference[i], references[i, n])
        for j in range(state.lines.output.shape[0]):
            emit_channel(state.lines, j, 0.0)
        if not follow(state, errors[:, n]):
            return n
    return references.shape[1]


def channel_sample(value: Any, size: int, name: str, channel: str) -> np.ndarray:
    """Return a sample of each channel, (size,), finite; `channel` is what an error calls one of them."""
    sample = as_real_array(value, name).reshape(-1)
    if sample.size != size:
        raise ValueError(f"{name} must have a value for each {channel}, ({size},), got {sample.size}")
    bad = np.flatnonzero(~np.isfinite(sample))
    if bad.size:
        raise ValueError(f"{name} must be finite, got {sample[bad[0]]} from {channel} {bad[0]}; nothing was changed")
    return np.ascontiguousarray(sample)


class ChannelController:
    """Signals that controllers of several channels share; a subclass sets `_state`, which begins with `lines`.

    Parameters
    ----------
    n_taps : int
        Taps L of each control filter.
    secondary_path : array_like, shape (K, J, n_path), or nested sequence of control systems
        Estimated secondary paths, loudspeaker j to microphone k.
    n_references : int
        Number of references I.
    history : int
        Number of reference samples that the algorithm needs.
    amplifier : callable or sequence of callables, optional
        Known amplifier model of all loudspeakers, or one for each.
    limiter : sequence of OutputLimiter, optional
        A limiter for each loudspeaker.
    """

    name = "controller"
    _state: Any
    _holding: Held | None = None

    def __init__(
        self,
        n_taps: int,
        secondary_path: Any,
        *,
        n_references: int,
        history: int,
        amplifier: Amplifier | Sequence[Amplifier] | None = None,
        limiter: Sequence[OutputLimiter] | None = None,
    ) -> None:
        self.n_taps = as_count(n_taps, "n_taps")
        self.n_references = as_count(n_references, "n_references")
        secondary, self._path_fs = secondary_paths(secondary_path)
        self.n_microphones, self.n_loudspeakers, n_path = secondary.shape
        self._limiters = self._checked_limiters(limiter)
        self._lines = ChannelLines(
            secondary_estimate=secondary,
            reference=delay_lines(self.n_references, max(self.n_taps, history)),
            output=delay_lines(self.n_loudspeakers, n_path),
            amplifiers=amplifier_models(amplifier, self.n_loudspeakers),
            limiters=None if self._limiters is None else tuple(one.state for one in self._limiters),
            control_signal=np.zeros(self.n_loudspeakers),
            disturbance=np.zeros(self.n_microphones),
        )

    def _checked_limiters(self, limiter: Any) -> tuple[OutputLimiter, ...] | None:
        if limiter is None:
            return None
        limiters = tuple(limiter) if isinstance(limiter, Sequence) else ()
        right = len(limiters) == self.n_loudspeakers == len({id(one) for one in limiters})
        if not right or not all(isinstance(one, OutputLimiter) for one in limiters):
            raise TypeError(
                f"limiter must be {self.n_loudspeakers} different OutputLimiters, one for each loudspeaker, got {limiter!r}"
            )
        return limiters

    @property
    def limiter(self) -> tuple[OutputLimiter, ...] | None:
        """Limiters of the loudspeakers, or None."""
        return self._limiters

    @property
    def weights(self) -> np.ndarray:
        """Control filters w, (J, I, L), newest-sample tap first; a copy."""
        return self._state.weights.copy()

    @property
    def control_filter(self) -> np.ndarray:
        """Control filters that generate y, (J, I, L); a copy."""
        return self.weights

    @property
    def rated_power(self) -> np.ndarray | None:
        """Rated output power of each loudspeaker, (J,); None without a constraint."""
        return None

    def _held(self) -> Held:
        if self._holding is None or self._holding.state is not self._state:
            self._holding = Held(self._state)
        return self._holding

    def control_signal(self, reference: Any) -> np.ndarray:
        """Return the control signals y(n), (J,), for the newest reference samples x(n), (I,)."""
        x = channel_sample(reference, self.n_references, "reference", "reference microphone")
        emit_channels_once.with_held(self._held(), x)
        return self._lines.control_signal.copy()

    def update(self, error: Any) -> None:
        """Adapt to the errors e(n), (K,), that the last control signals left."""
        e = channel_sample(error, self.n_microphones, "error", "microphone")
        if not adapt_channels_once.with_held(self._held(), e):
            raise ValueError(REFUSED)
        self.after_compiled(self._state)

    def listen(self, references: np.ndarray, errors: np.ndarray) -> None:
        """Follow the noise before the control is switched on.

        Parameters
        ----------
        references : ndarray, shape (I, n_samples)
            References.
        errors : ndarray, shape (K, n_samples)
            Signals of the error microphones while the loudspeakers are silent.
        """
        taken = listen_channels(self._state, references, errors)
        if taken < references.shape[1]:
            refused = ValueError(REFUSED)
            refused.add_note(f"in sample {taken} of those listened to")
            raise refused
        self.after_compiled(self._state)

    def require_sample_rate(self, fs: float) -> None:
        """Raise ValueError if the secondary paths or limiters are for another rate than `fs` in Hz."""
        limiters = self._limiters or ()
        require_rates(
            fs, {"secondary path": self._path_fs} | {f"limiter {j}": one.fs for j, one in enumerate(limiters)}
        )

    def compiled_state(self) -> Any:
        """Return the state for the compiled loop; None if a subclass replaces a method that the loop replaces."""
        own = type(self).control_signal is ChannelController.control_signal
        return self._state if own and type(self).update is ChannelController.update else None

    def samples_to_block(self) -> int:
        """Return the number of samples until the controller works between blocks; 0 if it never does."""
        return 0

    def after_compiled(self, state: Any) -> None:
        """Adopt what the compiled loop changed in `state`."""


def delay_lines(n_lines: int, taps: int) -> np.ndarray:
    """Return silent delay lines, one in each row."""
    return np.array([delay_line(taps) for _ in range(n_lines)])


def amplifier_models(amplifier: Any, n_loudspeakers: int) -> np.ndarray:
    """Return the records of the amplifier models of all loudspeakers, (J, 1)."""
    each = list(amplifier) if isinstance(amplifier, Sequence) else [amplifier] * n_loudspeakers
    models = [compiled_model(LinearAmplifier() if one is None else one) for one in each]
    if len(models) != n_loudspeakers or any(model is None for model in models):
        raise TypeError(
            "amplifier must be None, one of kfopc_filterpy's amplifier models, or one for each of the "
            f"{n_loudspeakers} loudspeakers, got {amplifier!r}"
        )
    return np.array(models)
