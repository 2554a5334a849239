"""Several loudspeakers and microphones: the signals of a controller, and the functions of `step` for them.

Axes lead with the channel, in the order in which sound travels backwards: microphones K, loudspeakers J, references I,
taps. Secondary paths are (K, J, taps), control filters (J, I, taps), primary paths (K, I, taps).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from .._validate import as_real_array
from ..kernels.compiling import inlined
from ..kernels.delay_lines import delay_line, latest, newest, push
from ..kernels.vectors import at, dot
from ..power.amplifiers import amplifier_models, amplify
from ..power.constraint import advance_squares
from ..power.limiter import LimiterState, limit_sample
from .step import (
    adapt,
    adapt_sample,
    advance_powers,
    emit,
    emit_outputs,
    emit_sample,
    emit_silence,
    filter_output,
    output,
    take_reference,
)


class ChannelLines(NamedTuple):
    """Signals that a controller of several channels uses, and its models."""

    secondary_estimate: np.ndarray  # (K, J, taps) of s^
    reference: np.ndarray  # (I, size) delay lines of x
    filtered: np.ndarray  # (K, J, I, size) delay lines of x'_kji = s^_kj * x_i; K = 0 if the algorithm needs none
    output: np.ndarray  # (J, size) delay lines of y, after limiters and amplifier models
    amplifier: np.ndarray  # (J, 1) records of those models
    limiter: tuple[LimiterState, ...] | None
    control_signal: np.ndarray  # (J,) the last y
    energy: np.ndarray  # (J,) sum of y^2 since the start of the block; without blocks, of all samples
    n_emitted: np.ndarray  # (1,) number of samples in that sum; silence before the control is not counted
    disturbance: np.ndarray  # (K,) the last estimate d^
    constraint_factor: np.ndarray  # (J,) the last factors
    heard: np.ndarray  # (I,) room for x, where the entry points find it
    error: np.ndarray  # (K,) room for e, likewise


def channel_lines(
    secondary: np.ndarray,
    n_references: int,
    *,
    reference_taps: int,
    filtered_taps: int,
    amplifier: Any,
    limiter: tuple[Any, ...] | None,
) -> ChannelLines:
    """Return silent lines for secondary paths (K, J, taps); 0 `filtered_taps`: no filtered references."""
    K, J, taps = secondary.shape
    filtered = [delay_lines(n_references, filtered_taps) for _ in range(K * J)] if filtered_taps else []
    size = filtered[0].shape[1] if filtered else 0
    return ChannelLines(
        secondary_estimate=secondary.copy(),  # a read-only array would be another type, and compile again
        reference=delay_lines(n_references, max(reference_taps, taps)),
        filtered=np.array(filtered).reshape(K if filtered else 0, J, n_references, size),
        output=delay_lines(J, taps),
        amplifier=amplifier_models(amplifier, J),
        limiter=limiter,
        control_signal=np.zeros(J),
        energy=np.zeros(J),
        n_emitted=np.zeros(1),
        disturbance=np.zeros(K),
        constraint_factor=np.ones(J),
        heard=np.zeros(n_references),
        error=np.zeros(K),
    )


@filter_output.register(ChannelLines)
def channel_output(lines, weights, j):
    """Return sum_i w_ji' x_i."""
    y = 0.0
    for i in range(weights.shape[1]):
        y += dot(weights[j, i], newest(lines.reference[i], weights.shape[2]))
    return y


@take_reference.register(ChannelLines)
def take_references(lines, x):
    """Add x_i(n) and x'_kji(n) = (s^_kj * x_i)(n) to their delay lines."""
    for i in range(lines.reference.shape[0]):
        push(lines.reference[i], x[i])
    s, filtered = lines.secondary_estimate, lines.filtered
    for k in range(filtered.shape[0]):
        for j in range(filtered.shape[1]):
            for i in range(filtered.shape[2]):
                push(filtered[k, j, i], dot(s[k, j], newest(lines.reference[i], s.shape[2])))


@emit_outputs.register(ChannelLines)
def emit_channel_outputs(lines, state):
    """Set y(n), (J,)."""
    for j in range(lines.output.shape[0]):
        emit_channel(lines, j, output(state, j))
    lines.n_emitted[0] += 1.0
    return 0.0


@emit_sample.register(ChannelLines)
def emit_channel_sample(lines, state, reference, control):
    """Take x(n), (I,), and set y(n), (J,)."""
    for i in range(lines.heard.size):
        lines.heard[i] = reference[i]
    emit(state, lines.heard)
    for j in range(lines.control_signal.size):
        control[j] = lines.control_signal[j]


@adapt_sample.register(ChannelLines)
def adapt_channel_sample(lines, state, error):
    """Adapt to e(n), (K,)."""
    for k in range(lines.error.size):
        lines.error[k] = error[k]
    return adapt(state, lines.error, lines.control_signal)


@emit_silence.register(ChannelLines)
def emit_channel_silence(lines):
    """Add y_j(n) = 0 to their delay lines."""
    for j in range(lines.output.shape[0]):
        emit_channel(lines, j, 0.0)


@inlined
def emit_channel(lines, j, y):
    """Set the control signal of a loudspeaker to y after its limiter, if there is one."""
    y = limited_channel(lines.limiter, j, y)
    lines.control_signal[j] = y
    lines.energy[j] += y * y
    push(lines.output[j], amplify(lines.amplifier[j], y))


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


@inlined
def sample_is_finite(lines, error):
    """Set d^(n); return whether disturbances and references have finite squares."""
    return estimate_disturbances(lines, error) and references_are_finite(lines)


@advance_powers.register(ChannelLines)
def advance_channel_powers(lines, constraint, error):
    """Add a sample to the powers of each loudspeaker: sums over microphones and references, as if it were alone."""
    finite, d, x = squares_of_sample(lines, error)
    if finite:
        add_squares(lines, constraint, d, x)
    return finite, lines.disturbance, lines.constraint_factor


@inlined
def squares_of_sample(lines, error):
    """Set d^(n); return whether all squares are finite, the sum of d^_k(n)^2 and that of x_i(n)^2."""
    finite, d, x = estimate_disturbances(lines, error), 0.0, 0.0
    for k in range(lines.disturbance.size):
        d += lines.disturbance[k] ** 2
    for i in range(lines.reference.shape[0]):
        x += latest(lines.reference[i]) ** 2
    finite &= np.isfinite(d) and np.isfinite(x)
    for j in range(lines.output.shape[0]):
        finite &= np.isfinite(filtered_square(lines, j))
    return finite, d, x


@inlined
def references_are_finite(lines):
    """Return whether the newest references have finite squares."""
    finite = True
    for i in range(lines.reference.shape[0]):
        finite &= np.isfinite(latest(lines.reference[i]) ** 2)
    return finite


@inlined
def add_squares(lines, constraint, d, x):
    """Add the sums of squares to the powers of each loudspeaker, and set their constraint factors."""
    for j in range(lines.output.shape[0]):
        lines.constraint_factor[j] = advance_squares(at(constraint, j), d, filtered_square(lines, j), x)


@inlined
def filtered_square(lines, j):
    """Return the sum of x'_kji(n)^2 over microphones and references."""
    total = 0.0
    for k in range(lines.filtered.shape[0]):
        for i in range(lines.filtered.shape[2]):
            total += latest(lines.filtered[k, j, i]) ** 2
    return total


def channel_sample(value: Any, size: int, name: str, what: str) -> np.ndarray:
    """Return a sample of each channel, (size,), finite; `what` names the channels in an error."""
    sample = as_real_array(value, name).reshape(-1)
    if sample.size != size:
        raise ValueError(f"{name} must have a value for each of the {size} {what}, got {sample.size}")
    for channel in np.flatnonzero(~np.isfinite(sample)):
        raise ValueError(f"{name} must be finite, but that of {what[:-1]} {channel} is {sample[channel]}")
    return np.ascontiguousarray(sample)


def delay_lines(n_lines: int, taps: int) -> np.ndarray:
    """Return silent delay lines, one in each row."""
    return np.array([delay_line(taps) for _ in range(n_lines)])


def amplifier_functions(amplifier: Any, n_loudspeakers: int) -> list[Any] | None:
    """Return the functions of a sample that stand for the amplifiers, one for each loudspeaker; None without any."""
    if amplifier is None:
        return None
    each = list(amplifier) if isinstance(amplifier, Sequence) else [amplifier] * n_loudspeakers
    if len(each) != n_loudspeakers or not all(callable(one) for one in each):
        raise TypeError(
            f"amplifier must be a function of a sample, or one for each of the {n_loudspeakers} loudspeakers, "
            f"got {amplifier!r}"
        )
    return each


def push_sample(line: np.ndarray, sample: np.ndarray) -> None:
    """Add the newest sample of several channels to a delay line in which the channels of a sample are adjacent."""
    line[sample.size :] = line[: line.size - sample.size]
    line[: sample.size] = sample[: line.size]
