"""A state that compiled code holds, so that Python passes it as one pointer.

numba unpacks a tuple at each call: 0.25 us for each array, 0.85 us for each tuple in it, 5 to 10 us for the state of a
controller. Held, the state costs half a microsecond.
"""

from __future__ import annotations

from typing import Any

from numba import types
from numba.experimental import structref

from .compiling import CONFIG, compiled_for_states, is_ours


@structref.register
class _HeldType(types.StructRef):
    """numba's type of a structure with the field `state`."""


class _Held(structref.StructRefProxy):
    """A structure with the field `state`, for compiled code only."""


structref.define_constructor(_Held, _HeldType, ["state"])
structref.define_boxing(_HeldType, _Held)
structref.define_attributes(_HeldType)


@compiled_for_states()
def hold(state):
    """Return the held form of a state."""
    return _Held(state)


def kind_of_held(held: Any) -> type:
    """Return the type of the state in a held form, from numba's type of that."""
    kind: type = held.field_dict["state"].instance_class
    return kind


class Held:
    """A state and its held form, `passed`, whose field `state` compiled code reads.

    The arrays are those of the state: what compiled code writes into them, Python sees. It cannot be copied: a copy of
    its owner makes another one.
    """

    def __init__(self, state: Any) -> None:
        self.state = state
        self.ours = is_ours(type(state))
        self.passed = self if CONFIG.DISABLE_JIT else hold(state)
