"""The reference of a feedback controller, by which its bounds are those of any controller."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .._validate import as_channels


def predictor_reference(disturbance: ArrayLike) -> np.ndarray:
    r"""Return the reference of a feedback controller whose internal model is exact: the disturbance one sample late.

    With it, every bound of this package, such as `power_constrained_wiener`, applies to feedback control: the control
    filter w, followed by the secondary path, is the best predictor of d(n) from d(n - 1), d(n - 2), ... within the
    rated power.

    Parameters
    ----------
    disturbance : array_like, shape (n_samples,) or (K, n_samples)
        Disturbance at the error microphones.

    Returns
    -------
    ndarray, of the same shape
        ``x(n) = d(n - 1)``, and 0 as the first sample. For hybrid control, stack it below the references of the
        microphones.

    Raises
    ------
    TypeError, ValueError
        A disturbance that is empty or not finite.

    Examples
    --------
    An AR(1) disturbance with a pole at 0.9, and a loudspeaker that is heard two samples late: a prediction over three
    samples leaves ``1 - 0.9^6`` of the power.

    >>> import numpy as np
    >>> from scipy.signal import lfilter
    >>> from kfopc_filterpy import Plant
    >>> from kfopc_filterpy.bounds import predictor_reference, wiener_solution
    >>> d = lfilter([1.0], [1.0, -0.9], np.random.default_rng(0).standard_normal(100_000))
    >>> found = wiener_solution(predictor_reference(d), Plant([0, 0, 1.0], fs=16000), n_taps=4, disturbance=d)
    >>> round(found.error_power / found.disturbance_power, 2), round(1 - 0.9**6, 2)
    (0.47, 0.47)
    """
    d = as_channels(disturbance, "disturbance")
    late = np.zeros_like(d)
    late[..., 1:] = d[..., :-1]
    return late
