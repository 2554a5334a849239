"""State-space models of several paths together, for observers such as the Kalman filter that need states."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .._taps import sampled_path_matrix
from .._types import PathModels
from .._validate import as_count

if TYPE_CHECKING:
    import control


@dataclass(frozen=True, eq=False)
class PathRealization:
    """A state-space model of paths, made by `realize_paths`.

    Attributes
    ----------
    system : control.StateSpace
        The model, with ``dt = 1/fs``.
    residual_db : numpy.ndarray, shape (outputs,)
        Energy of the error in each output's impulse responses, relative to the energy of these responses, in dB; at
        least -300.
    """

    system: control.StateSpace
    residual_db: np.ndarray

    @property
    def order(self) -> int:
        """Number of states."""
        return self.system.nstates


def realize_paths(paths: PathModels, order: int, *, fs: float | None = None) -> PathRealization:
    """Return a state-space model of a given order whose impulse responses are close to those of the paths.

    It is the eigensystem realization of Ho, Kalman, Juang and Pappa, as python-control computes it. Because the impulse
    responses are finite, the model is a balanced one. All paths share the states, so several paths with the same
    resonances or the same delay need hardly more states than one of them. A delay needs one state for each sample. A
    delay common to all paths makes no difference if the input is noise of unknown phase: cut it off first, as in the
    example.

    Parameters
    ----------
    paths : array_like, shape (outputs, inputs, n_taps), or nested sequence of control systems
        Finite impulse responses from the inputs, such as noise sources, to the outputs, such as microphones.
    order : int
        Number of states, at most ``n_taps`` times the smaller of the numbers of outputs and inputs.
    fs : float, optional
        Sampling rate in Hz, needed for an array.

    Returns
    -------
    PathRealization
        The model and its error.

    Raises
    ------
    TypeError, ValueError
        If the order is out of range or exceeds the number of states that the paths have, or the paths are silent.

    References
    ----------
    J.-N. Juang, R. S. Pappa, "An eigensystem realization algorithm for modal parameter identification and model
    reduction", J. Guidance 8(5), 1985. S.-Y. Kung, "A new identification and model reduction algorithm via singular
    value decomposition", Asilomar Conf. 1978.

    Examples
    --------
    One source and two microphones, the second of them 3 samples farther away:

    >>> paths = np.zeros((2, 1, 16))
    >>> paths[0, 0, 5:] = 0.5 ** np.arange(11)
    >>> paths[1, 0, 8:] = 0.5 ** np.arange(8)
    >>> model = realize_paths(paths[..., 4:], 4, fs=8000.0)  # one sample of the first delay is left
    >>> model.order, bool(np.all(model.residual_db < -20))
    (4, True)
    """
    from control import StateSpace, eigensys_realization
    from scipy.signal import dimpulse

    taps, fs = sampled_path_matrix(paths, fs, "paths", "(outputs, inputs, taps)")
    outputs, inputs, n_taps = taps.shape
    order, most = as_count(order, "order"), n_taps * min(outputs, inputs)
    if order > most:
        raise ValueError(f"order must be at most {most} for paths of shape {taps.shape}, got {order}")
    if not np.any(taps[..., 1:]):
        raise ValueError("paths must have a tap other than the first that is not zero, or they have no states")
    padded = np.concatenate([taps, np.zeros((outputs, inputs, n_taps + 1))], axis=2)
    balanced, sizes = eigensys_realization(padded, order, m=n_taps, n=n_taps)
    if order > (most := np.sum(sizes > 1e-13 * sizes[0])):
        raise ValueError(f"order must be at most {most}, the number of states that the paths have, got {order}")
    system = StateSpace(balanced.A, balanced.B, balanced.C, balanced.D, 1 / fs)
    responses = dimpulse((system.A, system.B, system.C, system.D, 1), n=2 * n_taps)[1]  # (inputs, n, outputs)
    error = np.transpose(responses, (2, 0, 1)).copy()  # the model's responses may be longer
    error[..., :n_taps] -= taps
    energy = np.maximum(np.sum(taps**2, axis=(1, 2)), np.finfo(float).tiny)
    return PathRealization(system, 10 * np.log10(np.maximum(np.sum(error**2, axis=(1, 2)) / energy, 1e-30)))
