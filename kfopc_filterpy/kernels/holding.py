"""A state that compiled code finds at an address, and functions that are compiled for each type of state.

numba unpacks a tuple at each call: 0.25 us for each array, 0.85 us for each tuple in it, 5 to 10 us for the state of a
controller. Held, the state is one number, its address. Moreover, a function of an address has the same signature for
every type of state. So a loop can call the function by address, and the loop is compiled once for all algorithms.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import errors, typeof, types
from numba.extending import intrinsic

from .borrowing import disowned
from .compiling import CONFIG, LOCK, callback, compiled, is_ours

KINDS: dict[str, Any] = {}  # numba's types of states, by the keys that compiled functions know
KEYS: dict[Any, tuple[str, bool]] = {}  # these keys, and whether a type is the package's, by what the types depend on


def _size(typing_context: Any, state: Any) -> Any:
    """Return the number of bytes of a state."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        size = context.get_abi_sizeof(context.get_data_type(state))
        return context.get_constant(types.intp, size)

    return types.intp(state), generate


_size_of: Any = intrinsic(_size)


def _kind(key: Any) -> Any:
    """Return numba's type of the states with a key, which is a constant in the code that is compiled."""
    if not isinstance(key, types.StringLiteral):
        raise errors.RequireLiteralValue("the key of a state must be a constant")
    return KINDS[key.literal_value]


def _store(typing_context: Any, state: Any, address: Any, key: Any) -> Any:
    """Write a state to an address, its arrays borrowed; `key` is that of the `Held` to which the address belongs."""
    if state != _kind(key):
        raise errors.TypingError(f"the address is for a state of the type {_kind(key)}, not for {state}")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = builder.inttoptr(arguments[1], context.get_data_type(state).as_pointer())
        context.pack_value(builder, state, arguments[0], pointer)
        return context.get_dummy_value()

    return types.none(state, types.intp, key), generate


store: Any = intrinsic(prefer_literal=True)(_store)


def _state_at(typing_context: Any, address: Any, key: Any) -> Any:
    """Return the state at an address, its arrays borrowed; `key` is that of its `Held`."""
    kind = _kind(key)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = builder.inttoptr(arguments[0], context.get_data_type(kind).as_pointer())
        # Without owners, the compiler drops all counting of references.
        return disowned(context, builder, kind, context.unpack_value(builder, kind, pointer))

    return kind(types.intp, key), generate


state_at: Any = intrinsic(prefer_literal=True)(_state_at)


def _reals_at(typing_context: Any, address: Any) -> Any:
    """Return the float64 numbers at an address, to be indexed."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

    return types.CPointer(types.float64)(types.intp), generate


reals_at: Any = intrinsic(_reals_at)


class ForStates:
    """A function that is compiled for each type of state, see `for_states`."""

    def __init__(self, make: Callable[[str], Callable[..., Any]], signature: Any, options: dict[str, Any]) -> None:
        self._make, self._signature, self._options = make, signature, options
        self._compiled: dict[str, Any] = {}
        self.__doc__, self.__name__ = make.__doc__, make.__name__

    def of(self, held: Held) -> Any:
        """Return the function for the type of a held state.

        What is compiled for a type of the package is kept on disk. For a type defined elsewhere it is not: nobody would
        notice that its module has changed.
        """
        if held.key not in self._compiled:
            with LOCK:
                if held.key not in self._compiled:
                    self._compiled[held.key] = self._compile(held.key, held.ours)
        return self._compiled[held.key]

    def _compile(self, key: str, keep: bool) -> Any:
        function = self._make(key)
        # A file of its own in the cache: processes that compile for different types at one time would mix them up in one.
        function.__qualname__ += "_" + hashlib.sha256(key.encode()).hexdigest()[:16]
        decorate = compiled if self._signature is None else callback(self._signature)
        return decorate(cache=keep, **self._options)(function)

    def __call__(self, held: Held, *arguments: Any) -> Any:
        """Call the function with the address of a held state."""
        return self.of(held)(held.address, *arguments)


def for_states(signature: Any = None, **options: Any) -> Callable[[Callable[[str], Callable[..., Any]]], ForStates]:
    """Decorate ``make(key)``, which returns a function of an address, where it finds ``state_at(address, key)``.

    Given a `signature` of C numbers, the function can be called by its address, see `calling`.
    """
    return lambda make: ForStates(make, signature, options)


def _make_hold(key: str) -> Callable[..., Any]:
    def hold(state, address):
        """Write a state to an address unless that is 0; return the number of its bytes."""
        if address != 0:
            store(state, address, key)
        return _size_of(state)

    return hold


_hold = ForStates(_make_hold, None, {})


class Held:
    """A state at an `address`, where compiled code finds it.

    The arrays are those of the state: what compiled code writes into them, Python sees. It must not be copied; a copy
    of its owner makes a new one.
    """

    def __init__(self, state: Any) -> None:
        if CONFIG.DISABLE_JIT:
            raise RuntimeError("controllers and random-walk filters run as compiled code: unset NUMBA_DISABLE_JIT")
        self.state = state
        self.key, self.ours = _key_of(state)
        hold = _hold.of(self)
        self._memory = np.empty(-(-hold(state, 0) // 8), np.float64)
        self.address = self._memory.ctypes.data
        hold(state, self.address)


def _key_of(state: Any) -> tuple[str, bool]:
    """Return the key of a state's type, and whether that is the package's; enter the type if it is new."""
    layout = _layout(state)
    if layout not in KEYS:
        kind, ours = typeof(state), _is_ours_throughout(state)
        key = str(kind) if ours else f"{len(KEYS)} {kind}"  # two types of users can have one name
        KINDS[key] = kind
        KEYS[layout] = key, ours
    return KEYS[layout]


def _is_ours_throughout(value: Any) -> bool:
    """Return whether a NamedTuple and all in it are of types that are defined in this package."""
    if not isinstance(value, tuple):
        return True
    return (type(value) is tuple or is_ours(type(value))) and all(_is_ours_throughout(item) for item in value)


def _layout(value: Any) -> Any:
    """Return what numba's type of a value depends on; `typeof` itself takes a third of a millisecond for a state."""
    if isinstance(value, np.ndarray):
        flags = value.flags
        return value.dtype, value.ndim, flags.c_contiguous, flags.f_contiguous, flags.writeable, flags.aligned
    if isinstance(value, tuple):
        return type(value), *[_layout(item) for item in value]
    return type(value)
