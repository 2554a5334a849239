"""The core's loop: a controller of the core, or functions at two addresses, with a plant or over a block."""

from __future__ import annotations

import ctypes
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .calls import amplify_all
from .library import load

RUNNING, DIVERGED, REFUSED_REFERENCE, REFUSED_ERROR = range(4)
LINEAR, HARD_CLIP, SOFT_SATURATION = range(3)
_library: Any = load().free  # other threads run meanwhile


class Steps(NamedTuple):
    """A controller as the loop sees it: `anc_controller` in anc.h."""

    address: int  # of the controller, which must exist for as long as the loop runs
    control_signal: int  # addresses of the functions
    update: int
    take_error: int = 0  # of an error that is not adapted to; 0: it is not needed


class _Controller(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in ("self", "control_signal", "update", "take_error")]


class _Plant(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int32) for name in ("scenarios", "microphones", "loudspeakers", "references")),
        *((name, ctypes.c_int32) for name in ("path_taps", "feedback_taps", "at", "length")),
        *((name, ctypes.c_void_p) for name in ("path", "feedback", "amplifiers", "output")),
        *((name, ctypes.c_void_p) for name in ("reference", "control", "error", "limit")),
    ]


class _Record(ctypes.Structure):
    _fields_ = [
        ("source", ctypes.c_void_p),
        *((name, ctypes.c_int64) for name in ("step", "count", "every", "row", "column")),
        ("to", ctypes.c_void_p),
    ]


class _Signals(ctypes.Structure):
    _fields_ = [
        ("length", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in ("reference", "disturbance", "sensor_noise")),
        *((name, ctypes.c_void_p) for name in ("error", "control_signal", "amplifier_output", "anti_noise")),
    ]


class Signals(NamedTuple):
    """Signals of a run, C-contiguous, (channels, n_samples): three inputs, then the results of the loop.

    The channels of scenarios come one after the other.
    """

    reference: NDArray[np.float64]  # (I, n)
    disturbance: NDArray[np.float64]  # (K, n)
    sensor_noise: NDArray[np.float64] | None  # (K, n); may be the array of the error, which takes its place
    error: NDArray[np.float64]  # (K, n)
    control_signal: NDArray[np.float64]  # (J, n)
    amplifier_output: NDArray[np.float64]  # (J, n)
    anti_noise: NDArray[np.float64]  # (K, n)


class Record(NamedTuple):
    """Numbers of a controller that the loop writes down: at every `every`-th sample, a column, or a row of `to`."""

    source: NDArray[np.float64]  # (count,), with any stride
    to: NDArray[np.float64]  # (count, n_samples), or (rows, count) if `in_rows`
    every: int = 1
    in_rows: bool = False

    def _struct(self) -> _Record:
        row, column = (self.to.shape[1], 1) if self.in_rows else (1, self.to.shape[1])
        stride = self.source.strides[0] // 8 if self.source.size > 1 else 1
        return _Record(self.source.ctypes.data, stride, self.source.size, self.every, row, column, self.to.ctypes.data)


class Plant:
    """The true amplifiers and paths, which start silent.

    `secondary`, `feedback` and `amplifiers` may be changed between two samples; the delay lines go on.

    Parameters
    ----------
    secondary : ndarray, shape (S, K, J, taps)
        Secondary paths s of each scenario.
    feedback : ndarray, shape (I, J, taps)
        Paths from the loudspeakers to the reference microphones; 0 taps: none, as it must be with several scenarios.
    amplifiers : ndarray, shape (S J, 3)
        Kind, limit and sharpness of each amplifier model.
    limit : ndarray, shape (S J,)
        A control signal beyond it is a divergence.

    Attributes
    ----------
    control : ndarray, shape (S J,)
        Control signals of the present sample; after a divergence they can be mended before the run goes on.
    """

    def __init__(
        self,
        secondary: NDArray[np.float64],
        feedback: NDArray[np.float64],
        amplifiers: NDArray[np.float64],
        limit: NDArray[np.float64],
    ) -> None:
        S, K, J, taps = secondary.shape
        longest = max(taps, feedback.shape[2])
        length = 4 * longest + 64
        self.reference, self.control, self.error = np.zeros(len(feedback)), np.zeros(S * J), np.zeros(S * K)
        self.limit = np.ascontiguousarray(limit, np.float64)
        plant = secondary, feedback, amplifiers, np.zeros((S * J, length))
        self.secondary, self.feedback, self.amplifiers, self._output = (np.array(array, order="C") for array in plant)
        arrays = [self.secondary, self.feedback, self.amplifiers, self._output]
        arrays += [self.reference, self.control, self.error, self.limit]
        counts = (S, K, J, len(feedback), taps, feedback.shape[2], length - longest, length)
        self._struct = _Plant(*counts, *(array.ctypes.data for array in arrays))
        self._signals: Signals | None = None
        self._passed: _Signals

    def run(
        self, steps: Steps, signals: Signals, records: list[Record], begin: int, end: int, status: int = RUNNING
    ) -> tuple[int, int]:
        """Run a controller from sample `begin` to `end`; return the status and the first sample not completed.

        With the status DIVERGED, go on from a divergence at `begin` with the control signals in `control`.
        """
        notes = (_Record * max(len(records), 1))(*(record._struct() for record in records))
        answer, of = ctypes.c_int32(status), ctypes.byref
        run_of = of(_Controller(*steps)), of(self._struct), self._pointers(signals)
        done = _library.anc_run(*run_of, notes, len(records), begin, end, of(answer))
        return answer.value, done

    def silence(self, scenario: int) -> None:
        """Cut off the loudspeakers of a scenario."""
        loudspeakers = self.secondary.shape[2]
        rows = slice(scenario * loudspeakers, (scenario + 1) * loudspeakers)
        self.secondary[scenario] = self._output[rows] = self.control[rows] = 0.0

    def _pointers(self, signals: Signals) -> Any:
        """Return the signals as the core takes them; made once, because a run calls the core for single samples too."""
        if signals is not self._signals:
            pointers = (None if signal is None else signal.ctypes.data for signal in signals)
            self._signals, self._passed = signals, _Signals(signals.disturbance.shape[1], *pointers)
        return ctypes.byref(self._passed)

    def hear(self, signals: Signals, n: int) -> NDArray[np.float64]:
        """Return the references of sample n, (I,)."""
        _library.anc_hear(ctypes.byref(self._struct), self._pointers(signals), n)
        return self.reference

    def amplified(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the outputs of the amplifier models for control signals, (J, n)."""
        y = np.ascontiguousarray(y)
        out = np.empty_like(y)
        for model, one, other in zip(self.amplifiers, y, out, strict=True):
            amplify_all(model.ctypes.data, one.ctypes.data, other.ctypes.data, one.size)
        return out

    def play(self, signals: Signals, begin: int, end: int) -> NDArray[np.float64]:
        """Send the amplifiers' outputs of the samples from `begin` to `end` through the paths.

        Return the errors, (K, n).
        """
        _library.anc_play(ctypes.byref(self._struct), self._pointers(signals), begin, end)
        return signals.error[:, begin:end]


def process(
    steps: Steps,
    x: NDArray[np.float64],
    e: NDArray[np.float64],
    y: NDArray[np.float64],
    adapting: NDArray[np.bool_],
    begin: int,
    end: int,
) -> tuple[int, int]:
    """Process a block, (channels, n_samples), C-contiguous, from sample `begin` to `end`.

    Return the status and the first sample that was refused, or `end`.
    """
    scratch, status = np.empty(len(x) + len(y) + len(e)), ctypes.c_int32()
    controller, counts = ctypes.byref(_Controller(*steps)), map(len, (x, y, e))
    arrays = (array.ctypes.data for array in (x, e, y, adapting))
    ends = x.shape[1], begin, end
    done = _library.anc_process(controller, *counts, *arrays, *ends, scratch.ctypes.data, ctypes.byref(status))
    return status.value, done
