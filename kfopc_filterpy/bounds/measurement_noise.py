"""Estimate of the measurement noise variance q = E[e_o^2] of eq. 7, from a recording."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .._validate import as_count
from ..plant import Plant
from .wiener import full_stretch, loss_db, one_channel, warn_of_loss


def measurement_noise_from_run(
    reference: ArrayLike, plant: Plant, *, n_taps: int, disturbance: ArrayLike | None = None
) -> float:
    r"""Estimate the measurement noise variance from a run without control.

    With the loudspeaker silent, the error microphone records the disturbance d. The part of it that no control filter
    of `n_taps` taps explains is e_o of eq. 1b: the batch least-squares residual of d on the filtered reference.

    Parameters
    ----------
    reference : array_like, shape (n_samples,)
        Reference x of the run.
    plant : Plant
        Plant with the estimated secondary path.
    n_taps : int
        Number of taps L of the control filter.
    disturbance : array_like, shape (n_samples,), optional
        Signal of the error microphone, the disturbance d, in place of the plant's primary path. Leave out its start-up
        transient, which would count as unexplained.

    Returns
    -------
    float
        Estimate of q, in the square of the disturbance's unit, corrected for the `n_taps` weights fitted.

    Raises
    ------
    ValueError
        If the signals are too short for the fit, of different lengths, silent or not finite.

    Warns
    -----
    numpy.exceptions.RankWarning
        If q cannot be told: the reference is so narrow-band that float64 correlations do not resolve all directions of
        the weights, and weights in those would explain part of the residual. The estimate is then too high by at least
        6 dB.

    Examples
    --------
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> x = rng.standard_normal(20000)
    >>> d = 0.5 * x + 0.1 * rng.standard_normal(20000)  # q = 0.01
    >>> from kfopc_filterpy import Plant
    >>> round(measurement_noise_from_run(x, Plant([1.0], fs=16000), n_taps=8, disturbance=d), 3)
    0.01
    """
    x, d, s = one_channel(reference, plant, disturbance, "measurement_noise_from_run")
    n_taps = as_count(n_taps, "n_taps")
    transient = n_taps + s.size - 2
    if x.size < transient + 2 * n_taps:
        raise ValueError(
            f"reference and disturbance must have at least {transient + 2 * n_taps} samples for {n_taps} taps and a "
            f"secondary path of {s.size}, got {x.size}"
        )
    stretch = full_stretch(x, d, s, n_taps)
    correlations = stretch.correlations()
    weights = correlations.weights()
    warn_of_loss(
        loss_db(stretch, correlations, weights), "q cannot be told from this run, and the estimate is too high"
    )
    explained = np.convolve(np.convolve(x, s), weights)[: x.size]
    residual = (d - explained)[transient:]
    return float(residual @ residual) / (residual.size - n_taps)  # each weight takes a degree of freedom
