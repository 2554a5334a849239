"""Controllers whose signals and steps are numba's compiled code: those that the core does not have yet."""

from __future__ import annotations

from typing import Any

import numpy as np

from .._validate import as_number
from ..kernels.delay_lines import TAPS, delay_line, newest, refill
from ..power.amplifiers import compiled_model
from .base import OVERFLOW, FilteredReferenceController, Looped, calls_of
from .channels import channel_lines, channel_sample
from .step import Compiled, Lines, listen, looped_arrays


class CompiledController(FilteredReferenceController):
    """Delay lines and steps that such controllers share.

    A subclass sets `_state`, which begins with `_common()`, and registers the step for its type (see `step`).

    Parameters
    ----------
    n_taps, secondary_path, n_references, multichannel, amplifier, constraint, limiter
        See `FilteredReferenceController`.
    filtered_taps : int, optional
        Number of samples stored of the filtered reference; by default `n_taps`. With several channels, 0 for an
        algorithm that needs no filtered reference.
    history : int, optional
        Number of samples stored of the reference, if the algorithm needs more than the filters.
    """

    _state: Any
    _code: Compiled | None = None

    def _begin(
        self, secondary: np.ndarray, amplifier: Any, *, filtered_taps: int | None = None, history: int = 0
    ) -> None:
        filtered_taps = self.n_taps if filtered_taps is None else filtered_taps
        self._lines: Any = self._new_lines(secondary, amplifier, filtered_taps, max(self.n_taps, history))

    def _new_lines(self, secondary: np.ndarray, amplifier: Any, filtered_taps: int, reference_taps: int) -> Any:
        to_filter_again = filtered_taps + secondary.shape[-1] - 1 if filtered_taps else 0  # with another path
        if self.multichannel:
            return channel_lines(
                secondary,
                self.n_references,
                reference_taps=max(reference_taps, to_filter_again),
                filtered_taps=filtered_taps,
                amplifier=amplifier,
                limiter=states_of(self._limiter),
            )
        model = compiled_model(amplifier)
        if model is None:
            raise TypeError(f"amplifier must be one of kfopc_filterpy's amplifier models or None, got {amplifier!r}")
        return Lines(
            secondary_estimate=secondary.copy(),  # a new estimate is written into it
            reference=delay_line(max(reference_taps, to_filter_again)),
            filtered=delay_line(filtered_taps),
            output=delay_line(secondary.size),
            amplifier=model,
            limiter=states_of(self._limiter),
            control_signal=np.zeros(1),
        )

    def _common(self) -> tuple[Any, np.ndarray, Any]:
        """Return the first fields of every state: lines, weights, constraint."""
        shape = (self.n_loudspeakers, self.n_references, self.n_taps) if self.multichannel else self.n_taps
        return self._lines, np.zeros(shape), states_of(self._own_constraint)

    def _use_limiter(self, before: Any) -> None:
        lines = self._state.lines._replace(limiter=states_of(self._limiter))
        self._state = self._state._replace(lines=lines)

    def _estimated_path(self) -> np.ndarray:
        return self._lines.secondary_estimate

    def _filter_again(self) -> None:
        """Filter the stored references with the present estimate."""
        lines = self._lines
        if not self.multichannel:
            _filter_line_again(lines.reference, lines.filtered, lines.secondary_estimate)
            return
        for k, j, i in np.ndindex(lines.filtered.shape[:3]):
            _filter_line_again(lines.reference[i], lines.filtered[k, j, i], lines.secondary_estimate[k, j])

    @property
    def weights(self) -> np.ndarray:
        """Control filter w, (L,), or with several channels (J, I, L), newest-sample tap first; a copy."""
        return self._state.weights.copy()

    def control_signal(self, reference: Any) -> Any:
        """Return the control signal y(n) for the newest reference sample x(n), from the weights of the last sample.

        With several channels, x(n) is (I,) and y(n) is (J,).
        """
        if self.multichannel:
            x = channel_sample(reference, self.n_references, "reference", "references")
            return self._emit(x).copy()
        return self._emit(as_number(reference, "reference"))

    def _emit(self, reference: Any) -> Any:
        """Return y(n) for a checked reference."""
        code = self._compiled()
        code.x[:] = reference
        code.emit(*code.emit_addresses)
        return code.y if self.multichannel else float(code.y[0])

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes for a copy or a file, which holds a state of its own."""
        return {name: value for name, value in vars(self).items() if name != "_code"}

    def _compiled(self) -> Compiled:
        """Return the state, held for compiled code, and its steps."""
        if self._code is None or self._code.held.state is not self._state:
            self._code = Compiled(self._state)
        return self._code

    def update(self, error: Any) -> None:
        """Adapt to the error e(n), with several channels (K,), that the last control signal left."""
        if self.multichannel:
            error = channel_sample(error, self.n_microphones, "error", "microphones")
        else:
            error = as_number(error, "error")
        if not self._adapt(error):
            raise ValueError(self._reason(error))
        if self.multichannel:
            self.after_compiled(self._state)  # a solution may be due

    @property
    def _y(self) -> float:
        """The last control signal of one channel."""
        return float(self._lines.control_signal[0])

    def _adapt(self, error: Any) -> bool:
        """Adapt to a checked error; return False if that fails."""
        code = self._compiled()
        code.e[:] = error
        return code.adapt(*code.adapt_addresses) == 0

    def _reason(self, error: Any) -> str:
        """Return why an update was refused."""
        return OVERFLOW

    def _listen(self, references: np.ndarray, errors: np.ndarray, adapting: np.ndarray) -> int:
        if not self.multichannel:
            self._require_finite_squares(references, errors)
        taken = listen(self._compiled().held, references, errors, adapting)
        if self.multichannel:
            self.after_compiled(self._state)  # a solution may be due
        return taken

    def _require_finite_squares(self, x: np.ndarray, e: np.ndarray) -> None:
        s, heard = self._lines.secondary_estimate, self._lines.reference
        before = newest(heard, s.size - 1)[::-1]
        with np.errstate(over="ignore", invalid="ignore"):
            filtered = np.convolve(np.concatenate((before, x)), s, mode="valid")
            fine = np.isfinite(x**2) & np.isfinite(e**2) & np.isfinite(filtered**2)
        if not fine.all():
            raise ValueError(
                f"references and errors must have finite squares: those of sample {int(fine.argmin())} overflow"
            )

    def looped(self) -> Looped | None:
        """Return what the core's loop needs to run this controller; None if Python must call the steps."""
        state = self.compiled_state()
        if state is None:
            return None
        code = self._compiled() if state is self._state else Compiled(state)
        return Looped(code.steps, *looped_arrays(state), after=lambda: self.after_compiled(state), owner=code)

    def compiled_state(self) -> Any:
        """Return the state for the compiled steps; None if Python must call the steps."""
        return self._state if calls_of(type(self)) == calls_of(CompiledController) else None

    def after_compiled(self, state: Any) -> None:
        """Adopt what the compiled steps changed in `state`, however many samples they ran."""


def states_of(value: Any) -> Any:
    """Return the state of a limiter or a constraint, or of each of a tuple; None stays None."""
    if isinstance(value, tuple):
        return tuple(one.state for one in value)
    return None if value is None else value.state


def _filter_line_again(reference: np.ndarray, filtered: np.ndarray, s: np.ndarray) -> None:
    """Fill the delay line `filtered` by a stored reference after the path s."""
    refill(filtered, np.correlate(newest(reference, int(filtered[TAPS]) + s.size - 1), s, mode="valid"))
