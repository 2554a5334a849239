"""One compiled sample of a controller: functions that all controllers share, and functions chosen by type of state.

A controller's state is a NamedTuple with at least three fields,

- `lines`: its signals (`Lines`, or `ChannelLines` with several channels),
- `weights`: the adapted weights, (L,) or (J, I, L),
- `constraint`: the running powers (`power.constraint.ConstraintState`), or a tuple of them, one for each loudspeaker,

and whatever else its algorithm stores. `adapt` must have a body for the type, registered by
``adapt.register(MyState)(my_step)``. The other functions have a default body, which an algorithm can replace.
"""

from __future__ import annotations

from functools import cached_property, singledispatch
from typing import Any, NamedTuple

import numpy as np
from numba import types

from ..core.running import Steps
from ..kernels.compiling import by_type, compiled, inlined, part
from ..kernels.delay_lines import latest, newest, push
from ..kernels.holding import Held, for_states, reals_at, state_at
from ..kernels.vectors import dot
from ..power.amplifiers import amplify
from ..power.constraint import advance_constraint, squares_are_finite
from ..power.limiter import LimiterState, limit_sample


class Lines(NamedTuple):
    """Signals that a controller uses, and its models."""

    secondary_estimate: np.ndarray  # taps of s^
    reference: np.ndarray  # delay line of x
    filtered: np.ndarray  # delay line of x' = s^ * x
    output: np.ndarray  # delay line of y, after the limiter and the amplifier model
    amplifier: np.ndarray  # record of that model; linear: d^ = e + s^ * y as published
    limiter: LimiterState | None
    control_signal: np.ndarray  # (1,) the last y


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
    return False  # `Compiled` refuses a state without a body of its own


@by_type
def skip(state):
    """Advance what must advance with every sample, if there is anything, without adapting to it."""


@by_type
def emitted(state, y):
    """Take note of the control signal that was emitted for the newest reference, if the algorithm has a use for it."""


@by_type
def unheard(state):
    """Advance with a sample heard while the loudspeaker is silent, without following it; by default like `skip`."""
    skip(state)


@by_type
def follow(state, error):
    """Update the powers with a sample heard while the loudspeaker is silent. Return False if that fails."""
    finite, _, _ = advance_powers(state.lines, state.constraint, error)
    return finite


@singledispatch
def power_weight(state: Any) -> np.ndarray:
    """Return the weight lambda of the control power, (1,), which the steps update; NaN for an algorithm without one."""
    return np.array([np.nan])


# Functions chosen by the type of the lines: `Lines` here, `ChannelLines` in `channels`.


@by_type
def filter_output(lines, weights, j):
    """Return w' x of loudspeaker j."""
    return dot(weights, newest(lines.reference, weights.size))


@by_type
def take_reference(lines, x):
    """Add x(n) and x'(n) = (s^ * x)(n) to their delay lines."""
    push(lines.reference, x)
    s = lines.secondary_estimate
    push(lines.filtered, dot(s, newest(lines.reference, s.size)))


@by_type
def emit_outputs(lines, state):
    """Return y(n), after any limiter, and add it to its delay line; with several channels, the lines keep it."""
    lines.control_signal[0] = emit_limited(lines, output(state, 0))
    return lines.control_signal[0]


@by_type
def emit_silence(lines):
    """Add y(n) = 0 to its delay line."""
    lines.control_signal[0] = emit_limited(lines, 0.0)


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
    y = emit_outputs(state.lines, state)
    emitted(state, y)
    return y


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


@inlined
def disturbance_estimate(lines, error):
    """Return d^(n) = e(n) + (s^ * y)(n)."""
    s = lines.secondary_estimate
    return error + dot(s, newest(lines.output, s.size))


# Entry points: the core's loop is given their addresses, and Python calls them by `ctypes`. They find the state, the
# samples and the control signals at addresses. numba prints an exception that a step raises, and goes on.


EMIT = types.int32(types.intp, types.intp, types.intp)
ADAPT = types.int32(types.intp, types.intp)


@for_states(EMIT)
def emit_entry(key):
    """Compile `emit` for a type of state."""

    def emit_at(address, reference, control):
        state = state_at(address, key)
        emit_sample(state.lines, state, reals_at(reference), reals_at(control))
        return 0

    return emit_at


@for_states(ADAPT)
def adapt_entry(key):
    """Compile `adapt`, or `skip` for a sample to which it is not to adapt (no error), for a type of state."""

    def adapt_at(address, error):
        state = state_at(address, key)
        if error == 0:
            skip(state)
            return 0
        return 0 if adapt_sample(state.lines, state, reals_at(error)) else 1

    return adapt_at


@by_type
def emit_sample(lines, state, reference, control):
    """Take x(n) and set y(n), both at addresses."""
    control[0] = emit(state, reference[0])


@by_type
def adapt_sample(lines, state, error):
    """Adapt to e(n), which is at an address; return False if that fails."""
    return adapt(state, error[0], lines.control_signal[0])


@for_states(nogil=True)
def listen(key):
    """Compile, for a type of state, the loop over signals that are heard while the loudspeakers are silent.

    It returns the number of samples processed before a refusal. The first axis is time; with several channels, each row
    is a sample.
    """

    def listen_at(address, references, errors, adapting):
        state = state_at(address, key)
        for n in range(references.shape[0]):
            take_reference(state.lines, references[n])
            emit_silence(state.lines)
            if not adapting[n]:
                unheard(state)
            elif not follow(state, errors[n]):
                return n
        return references.shape[0]

    return listen_at


class Compiled:
    """A controller's state, held, and its compiled steps: `steps` for loops; `emit` and `adapt` for Python.

    It must exist for as long as its `steps` are used: they hold the address of the state, and not the state. A step is
    compiled when it is first asked for: a controller around somebody's own filter never asks for `adapt`. Python calls
    ``emit(*emit_addresses)`` with a sample in `x`, which sets `y`, and ``adapt(*adapt_addresses)`` with one in `e`.
    """

    def __init__(self, state: Any) -> None:
        if adapt.dispatch(type(state)) is adapt.dispatch(object):
            raise NotImplementedError(
                f"no step is registered for this type of state: adapt.register({type(state).__name__})(step)"
            )
        self.held = Held(state)
        path = np.atleast_3d(state.lines.secondary_estimate.T).T
        self.x, self.y, self.e = np.zeros(counted_references(state.lines)), np.zeros(path.shape[1]), np.zeros(len(path))
        self.emit_addresses = self.held.address, self.x.ctypes.data, self.y.ctypes.data
        self.adapt_addresses = self.held.address, self.e.ctypes.data

    @cached_property
    def emit(self) -> Any:
        """Function of `emit_addresses`."""
        return emit_entry.of(self.held).ctypes

    @cached_property
    def adapt(self) -> Any:
        """Function of `adapt_addresses`; it returns 0, or else it could not adapt."""
        return adapt_entry.of(self.held).ctypes

    @property
    def steps(self) -> Steps:
        """The controller as the core's loop sees it."""
        return Steps(self.held.address, emit_entry.of(self.held).address, adapt_entry.of(self.held).address)


def counted_references(lines: Any) -> int:
    """Return the number of references."""
    return 1 if lines.reference.ndim == 1 else len(lines.reference)


def looped_arrays(state: Any) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the control filter, and what can be recorded of a sample: arrays that the steps update."""
    if state.lines.reference.ndim > 1:
        return control_filter(state), {"constraint_factor": state.lines.constraint_factor}
    numbers = state.constraint.numbers
    recorded = {"constraint_factor": "factor", "disturbance_power": "power", "secondary_path_gain": "gain"}
    views = {name: np.asarray(numbers[field]) for name, field in recorded.items()}
    return control_filter(state), views | {"power_weight": power_weight(state)}


@compiled()
def estimate_once(lines, error):
    """Call `disturbance_estimate` from Python."""
    return disturbance_estimate(lines, error)
