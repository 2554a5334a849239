"""One compiled sample of a controller: functions that all controllers share, and functions chosen by type of state.

A controller's state is a NamedTuple with at least three fields,

- `lines`: its signals (`Lines`, or `ChannelLines` with several channels),
- `weights`: the adapted weights, (L,) or (J, I, L),
- `constraint`: the running powers (`power.constraint.ConstraintState`), or a tuple of them, one for each loudspeaker,

and whatever else its algorithm stores. `adapt` must have a body for the type, registered by
``adapt.register(MyState)(my_step)``. The other functions have a default body, which an algorithm can replace.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.extending import overload

from ..kernels.borrowing import borrowed
from ..kernels.compiling import OPTIONS, by_type, compiled, compiled_for_states, inlined, part
from ..kernels.delay_lines import latest, newest, push
from ..kernels.holding import kind_of_held
from ..kernels.vectors import dot
from ..power.amplifiers import amplify
from ..power.constraint import advance_constraint, squares_are_finite
from ..power.limiter import LimiterState, limit_sample


class GuardLine(NamedTuple):
    """The guard against an uncertain secondary path, see `paths.uncertainty`."""

    taps: np.ndarray  # of W
    filtered: np.ndarray  # delay line of W * x'


class Lines(NamedTuple):
    """Signals that a controller uses, and its models."""

    secondary_estimate: np.ndarray  # taps of s^
    reference: np.ndarray  # delay line of x
    filtered: np.ndarray  # delay line of x' = s^ * x
    output: np.ndarray  # delay line of y, after the limiter and the amplifier model
    amplifier: np.ndarray  # record of that model; linear: d^ = e + s^ * y as published
    limiter: LimiterState | None
    guard: GuardLine | None


# Functions chosen by the type of the state.


@by_type
def control_filter(state):
    """Return the filter that generates the control signal: by default, the weights."""
    return state.weights


@by_type
def output(state, j):
    """Return w(n-1)' x(n) of loudspeaker j (0 if there is one), before any limiter."""
    return filter_output(state.lines, control_filter(state), j)


@by_type
def adapt(state, error, control_signal):
    """Adapt to the error that the emitted control signal left; return False, with nothing changed, if that fails."""
    raise NotImplementedError("no step is registered for this type of state: adapt.register(State)(step)")


@by_type
def skip(state):
    """Advance what must advance with every sample, if there is anything, without adapting to it."""


@by_type
def follow(state, error):
    """Update the powers with a sample heard while the loudspeaker is silent. Return False if that fails."""
    finite, _, _ = advance_powers(state.lines, state.constraint, error)
    return finite


@by_type
def power_weight(state):
    """Return the weight lambda of the control power; NaN for an algorithm without one."""
    return np.nan


# Functions chosen by the type of the lines: `Lines` here, `ChannelLines` in `channels`.


@by_type
def loudspeakers(lines):
    """Return the number of loudspeakers."""
    return 1


@by_type
def filter_output(lines, weights, j):
    """Return w' x of loudspeaker j."""
    return dot(weights, newest(lines.reference, weights.size))


@by_type
def weights_of(lines, weights, j):
    """Return the weights of loudspeaker j in one row, as a view."""
    return weights


@by_type
def take_reference(lines, x):
    """Add x(n) and x'(n) = (s^ * x)(n) to their delay lines."""
    push(lines.reference, x)
    s = lines.secondary_estimate
    push(lines.filtered, dot(s, newest(lines.reference, s.size)))
    take_guarded(lines.guard, lines.filtered)


@by_type
def emit_outputs(lines, state):
    """Return y(n), after any limiter, and add it to its delay line; with several channels, only `emitted` has it."""
    return emit_limited(lines, output(state, 0))


@by_type
def emitted(lines, y):
    """Return the control signal after `emit` has returned y; with several channels (J,)."""
    return y


@by_type
def emit_silence(lines):
    """Add y(n) = 0 to its delay line."""
    emit_limited(lines, 0.0)


@by_type
def advance_powers(lines, constraint, error):
    """Add a sample to the running powers; return whether the squares are finite, d^(n) and the constraint factor.

    If they are not finite, nothing was changed. With several channels, d^ and the factor are arrays.
    """
    d = disturbance_estimate(lines, error)
    filtered, x = latest(lines.filtered), latest(lines.reference)
    if not squares_are_finite(d, filtered, x):
        return False, d, 1.0
    return True, d, advance_constraint(constraint, d, filtered, x)


# Functions that all controllers share.


@inlined
def emit(state, x):
    """Return y(n) for the newest reference, after any limiter; add x(n), x'(n) and y(n) to their delay lines."""
    take_reference(state.lines, x)
    return emit_outputs(state.lines, state)


@inlined
def emit_limited(lines, y):
    """Return y after the limiter, if there is one, and add it to its delay line."""
    y = limited(lines.limiter, y)
    push(lines.output, amplify(lines.amplifier, y))
    return y


@part()
def limited(limiter, y):
    """Return y after the limiter, if there is one."""
    if limiter is None:
        return y
    return limit_sample(limiter, y)


@part()
def take_guarded(guard, filtered):
    """Add (W * x')(n) to its delay line, if there is a guard."""
    if guard is not None:
        push(guard.filtered, dot(guard.taps, newest(filtered, guard.taps.size)))


@inlined
def disturbance_estimate(lines, error):
    """Return d^(n) = e(n) + (s^ * y)(n)."""
    s = lines.secondary_estimate
    return error + dot(s, newest(lines.output, s.size))


# Entry points from Python. The loops call `emit_step` and `adapt_step`, which are the same compiled functions: an
# algorithm is compiled once, and a loop over its samples is small.


@compiled_for_states()
def emit_once(held, x):
    """Call `emit` with a `Held` state."""
    return emit(borrowed(held.state), x)


@compiled_for_states()
def adapt_once(held, error, control_signal):
    """Call `adapt` with a `Held` state."""
    return adapt(borrowed(held.state), error, control_signal)


def emit_step(held, x):
    """Call `emit_once` in a compiled loop."""
    return emit(held.state, x)


def adapt_step(held, error, control_signal):
    """Call `adapt_once` in a compiled loop."""
    return adapt(held.state, error, control_signal)


@overload(emit_step, jit_options=OPTIONS)
def _emit_step(held, x):
    step = emit_once.for_states(kind_of_held(held))
    return lambda held, x: step(held, x)


@overload(adapt_step, jit_options=OPTIONS)
def _adapt_step(held, error, control_signal):
    step = adapt_once.for_states(kind_of_held(held))
    return lambda held, error, control_signal: step(held, error, control_signal)


@compiled()
def estimate_once(lines, error):
    """Call `disturbance_estimate` from Python."""
    return disturbance_estimate(lines, error)


@compiled_for_states(nogil=True)
def listen(state, references, errors, adapting):
    """Follow signals while the loudspeakers are silent; return the number of samples processed before a refusal.

    The first axis is time; with several channels, each row is a sample.
    """
    state = borrowed(state)
    for n in range(references.shape[0]):
        take_reference(state.lines, references[n])
        emit_silence(state.lines)
        if not adapting[n]:
            skip(state)
        elif not follow(state, errors[n]):
            return n
    return references.shape[0]


@compiled_for_states(nogil=True)
def process_samples(held, references, errors, adapting, outputs, begin, end):
    """Process the samples from `begin` to `end` of a block, and set their control signals.

    Return the number of samples processed, or the sample to which the controller could not adapt. The first axis is
    time; with several channels, each row is a sample.
    """
    state = borrowed(held.state)
    for n in range(begin, end):
        y = emitted(state.lines, emit_step(held, references[n]))
        outputs[n] = y
        if not adapting[n]:
            skip(state)
        elif not adapt_step(held, errors[n], y):
            return n
    return end
