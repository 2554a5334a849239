"""A read-only array whose refusal to be written into names the assignment to use instead."""

from __future__ import annotations

from typing import Any

import numpy as np


class ReadOnlyMatrix(np.ndarray):
    """View of an array that raises on any in-place write, naming the attribute to assign.

    Results of arithmetic with it are plain arrays.
    """

    attribute = ""

    @classmethod
    def of(cls, array: np.ndarray, attribute: str) -> ReadOnlyMatrix:
        """Freeze `array` and view it as the value of the filter's `attribute`."""
        array.flags.writeable = False
        view = array.view(cls)
        view.attribute = attribute
        return view

    def __array_finalize__(self, source: Any) -> None:
        self.attribute = getattr(source, "attribute", "")

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> Any:
        written = inputs[:1] if method == "at" else kwargs.get("out", ())
        for array in written:
            _require_writeable(array)
        if "out" in kwargs:
            kwargs["out"] = tuple(_plain(array) for array in written)
        return getattr(ufunc, method)(*map(_plain, inputs), **kwargs)

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        try:
            return _plain(super().__array_function__(function, types, args, kwargs))
        except ValueError as error:  # np.fill_diagonal, np.copyto, ...
            raise (self._refusal() if "read-only" in str(error) else error) from error

    def __setitem__(self, key: Any, value: Any) -> None:
        _require_writeable(self)
        super().__setitem__(key, value)

    def fill(self, value: Any) -> None:
        """Refused, as any in-place write."""
        _require_writeable(self)
        super().fill(value)

    def sort(self, *args: Any, **kwargs: Any) -> None:
        """Refused, as any in-place write."""
        _require_writeable(self)
        super().sort(*args, **kwargs)

    def partition(self, *args: Any, **kwargs: Any) -> None:
        """Refused, as any in-place write."""
        _require_writeable(self)
        super().partition(*args, **kwargs)

    def put(self, *args: Any, **kwargs: Any) -> None:
        """Refused, as any in-place write."""
        _require_writeable(self)
        super().put(*args, **kwargs)

    @property
    def flat(self) -> Any:
        """The elements in a row, (size,), to read; writing into them is refused."""
        return self.reshape(-1)

    def copy(self, order: Any = "C") -> np.ndarray:  # type: ignore[override]
        """A plain array, which can be written into and then assigned."""
        return np.array(self, order=order)

    def _refusal(self) -> ValueError:
        name = self.attribute
        return ValueError(
            f"{name} of a random-walk filter is read-only, so that its steps can stay O(L^2): "
            f"assign instead, kf.{name} = value"
            + (" (a full array hands the steps to filterpy's equations)" if name in ("F", "Q") else "")
        )


def _plain(value: Any) -> Any:
    """A `ReadOnlyMatrix` as a plain view, anything else as it is."""
    return value.view(np.ndarray) if isinstance(value, ReadOnlyMatrix) else value


def _require_writeable(array: Any) -> None:
    if isinstance(array, ReadOnlyMatrix) and not array.flags.writeable:
        raise array._refusal()
