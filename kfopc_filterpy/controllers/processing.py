"""Blocks of samples: what a real-time process hands to a controller, and what it gets back."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._validate import as_real_array, require_finite


class RefusedUpdate(ValueError):
    """Raised by `process` if the controller could not adapt to a sample of a block.

    The control signals up to that sample are in `out`, if it was given, and the controller has processed everything up
    to it but did not adapt to it. Go on with the rest of the block, ``references[..., sample + 1:]``.

    Attributes
    ----------
    sample : int
        Index of the sample in the block.
    """

    def __init__(self, reason: str, sample: int) -> None:
        super().__init__(reason)
        self.sample = sample
        self.add_note(f"in sample {sample} of the block")


class BlockProcessing:
    """Gives a controller `process`, by its two methods per sample."""

    def process(
        self,
        references: ArrayLike | None,
        errors: ArrayLike,
        *,
        adapt: bool | ArrayLike = True,
        out: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the control signals of a block of samples, and adapt to its errors.

        This is `control_signal` and `update` for each sample in turn, so the results do not depend on how a recording
        is cut into blocks. The errors of a block must have been measured before its control signals are known. In a
        real-time process this holds if the estimated secondary path includes the delay of the blocks: the path then
        begins with at least as many zeros as a block has samples.

        Parameters
        ----------
        references : array_like, shape (n_samples,) or (I, n_samples), or None
            Reference x; None for a controller without a reference microphone, see `with_internal_model`.
        errors : array_like, shape (n_samples,) or (K, n_samples)
            Error e.
        adapt : bool or array_like, shape (n_samples,), default True
            Whether to adapt to a sample. Without, the control signal is computed with the present control filter.
        out : ndarray of float64, shape (n_samples,) or (J, n_samples), optional
            Array for the control signals, C-contiguous, in memory of its own. With it, nothing is allocated for them.

        Returns
        -------
        ndarray, shape (n_samples,) or (J, n_samples)
            Control signals y; `out` if it was given.

        Raises
        ------
        ValueError
            Signals of other shapes, without a sample, or with NaN or Inf; an `out` that overlaps with them: nothing was
            changed.
        RuntimeError
            Another thread is using the controller: nothing was changed.
        RefusedUpdate
            An update that `update` refuses, for example because a square overflows.

        Notes
        -----
        The built-in controllers process a block in compiled code, which releases the interpreter lock. Wrappers, and
        subclasses with methods of their own, are called sample by sample.

        Examples
        --------
        >>> import numpy as np
        >>> from kfopc_filterpy import fx_lms
        >>> path = np.zeros(65)
        >>> path[64] = 1.0  # blocks of 64 samples: a sample is heard 64 samples later
        >>> controller = fx_lms(16, path, step_size=1e-3)
        >>> block = np.ones(64)
        >>> controller.process(block, 0.5 * block).shape
        (64,)
        """
        return process_steps(self, references, errors, adapt=adapt, out=out)


def process_steps(
    controller: Any, references: ArrayLike | None, errors: ArrayLike, *, adapt: bool | ArrayLike, out: np.ndarray | None
) -> np.ndarray:
    """Process a block with the two methods per sample of any controller; see `BlockProcessing.process`."""
    x, e, flags, y = checked_block(controller, references, errors, adapt, out)
    none = takes_none(controller, references)
    with getattr(controller, "in_use", nullcontext()):
        for n in range(x.shape[-1]):
            sample = controller.control_signal(None if none else x[..., n])
            if n == 0:
                y = output_array(y, (*np.shape(sample), x.shape[-1]))
            y[..., n] = sample
            if flags[n] or getattr(controller, "internal_model", False):
                try:
                    (controller.update if flags[n] else controller.take_error)(e[..., n])
                except ValueError as error:
                    raise RefusedUpdate(str(error), n) from error
    return y


def checked_block(
    controller: Any, references: Any, errors: Any, adapt: Any, out: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Any]:
    """Return references, errors, whether to adapt to each sample, and the array for the control signals, if known."""
    x, e = block_signals(controller, references, errors)
    flags = adapt_flags(adapt, x.shape[-1])
    if isinstance(out, np.ndarray) and any(np.may_share_memory(out, signal) for signal in (x, e)):
        raise ValueError("out must not overlap with references or errors: give it memory of its own")
    if hasattr(controller, "multichannel"):
        out = output_array(out, ((controller.n_loudspeakers,) if controller.multichannel else ()) + x.shape[-1:])
    elif out is not None:  # the first sample shows the channels
        output_array(out, getattr(out, "shape", ())[:-1] + x.shape[-1:])
    return x, e, flags, out


def block_signals(controller: Any, references: Any, errors: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the references and errors of a block, with the channels that a controller states."""
    e = block_signal(errors, "errors")
    none = takes_none(controller, references)
    x = np.empty((0, e.shape[-1])) if none else block_signal(references, "references")
    if states_channels(controller):
        if controller.multichannel:
            x, e = np.atleast_2d(x), np.atleast_2d(e)
        else:
            x, e = (signal[0] if signal.ndim == 2 and len(signal) == 1 else signal for signal in (x, e))
        if not none:
            require_channels(x, "references", controller.multichannel, controller.n_references)
        require_channels(e, "errors", controller.multichannel, controller.n_microphones)
    elif hasattr(controller, "physical"):
        require_channels(e, "errors", True, controller.n_microphones)
    if x.shape[-1] != e.shape[-1]:
        raise ValueError(
            "references and errors of a block must have the same number of samples, "
            f"got {x.shape[-1]} and {e.shape[-1]}"
        )
    return x, e


def states_channels(controller: object) -> bool:
    """Return whether a controller states its channels.

    For virtual microphones and a user's controller, a sample shows them.
    """
    return hasattr(controller, "multichannel") and not hasattr(controller, "physical")


def takes_none(controller: object, references: object) -> bool:
    """Return whether a controller takes no references.

    Raise ValueError if it gets some, or needs them and gets none.
    """
    none = getattr(controller, "n_references", 1) == 0
    given: Any = references
    if none and references is not None and np.size(given):
        raise ValueError(
            "reference must be None: this controller has no reference microphone, its reference is its own estimate of "
            "the disturbance"
        )
    if not none and references is None:
        raise ValueError(
            "reference must be the signal of the reference microphone, got None: without one, make a feedback controller "
            "with controllers.with_internal_model"
        )
    return none


def block_signal(value: ArrayLike, name: str) -> np.ndarray:
    """Return a block of finite samples, (n_samples,) or (n_channels, n_samples), with at least one sample."""
    signal = as_real_array(value, name)
    if signal.ndim not in (1, 2) or signal.size == 0:
        raise ValueError(
            f"{name} must be (n_samples,) or (n_channels, n_samples) with at least 1 sample, got shape {signal.shape}"
        )
    # The sum of the squares says at once whether all are finite, without an array for the answers, unless it overflows.
    if not (signal.flags.c_contiguous and np.isfinite(np.vdot(signal, signal))):
        require_finite(signal, name)
    return signal


def adapt_flags(adapt: bool | ArrayLike, n_samples: int) -> np.ndarray:
    """Return for each sample whether to adapt to it, (n_samples,) of bool."""
    flags = np.asarray(adapt)
    if flags.dtype != bool or flags.shape not in ((), (n_samples,)):
        raise ValueError(
            f"adapt must be True, False or an array of bool with one for each of the {n_samples} samples, got "
            f"{flags.dtype} of shape {flags.shape}"
        )
    return np.ascontiguousarray(np.broadcast_to(flags, n_samples))


def require_channels(signal: np.ndarray, name: str, multichannel: bool, n_channels: int) -> None:
    """Raise ValueError if a block of samples has other channels than a controller."""
    wanted = "(n_samples,)" if not multichannel else f"({n_channels}, n_samples)"
    if signal.ndim != 1 + multichannel or (multichannel and len(signal) != n_channels):
        raise ValueError(f"{name} must be {wanted} for this controller, got shape {signal.shape}")


def output_array(out: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray:
    """Return `out`, or a new array if it is None; raise ValueError if control signals of a shape do not fit into it."""
    if out is None:
        return np.empty(shape)
    fits = isinstance(out, np.ndarray) and out.dtype == np.float64 and out.shape == shape and out.flags.c_contiguous
    if not fits or not out.flags.writeable:
        got = f"{out.dtype} of shape {out.shape}" if isinstance(out, np.ndarray) else repr(out)
        raise ValueError(f"out must be a writable, C-contiguous array of float64 of shape {shape}, got {got}")
    return np.asarray(out)
