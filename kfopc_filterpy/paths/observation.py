"""Observation filters: they predict the disturbance at virtual microphones from that at physical ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .._validate import as_channels, as_count, as_nonnegative
from .identification import fit_paths, require_audible, require_length


@dataclass(frozen=True, eq=False)
class ObservationFilters:
    """Filters from the physical to the virtual microphones, made by `identify_observation_filters`.

    Attributes
    ----------
    taps : numpy.ndarray, shape (K_v, K_p, n_taps)
        Filter from each physical microphone to each virtual one.
    residual_db : numpy.ndarray, shape (K_v,)
        Share of the power at each virtual microphone that the filters do not predict, in dB; at least -300.
    """

    taps: np.ndarray
    residual_db: np.ndarray

    def predict(self, physical: ArrayLike) -> np.ndarray:
        """Predict the signals at the virtual microphones, (K_v, n_samples), from a recording at the physical ones.

        Parameters
        ----------
        physical : array_like, shape (K_p, n_samples)
            Recording; silence before its first sample is assumed.

        Returns
        -------
        numpy.ndarray, shape (K_v, n_samples)
            Prediction. To judge the filters, look at its error on a recording to which they were not fitted.

        Raises
        ------
        TypeError, ValueError
            If the recording has a different number of channels from that of the fit, or is not finite.

        Examples
        --------
        >>> filters = ObservationFilters(np.array([[[0.0, 0.5]]]), np.array([-300.0]))
        >>> filters.predict([[2.0, 4.0, 6.0]])
        array([[0., 1., 2.]])
        """
        from scipy.signal import lfilter

        heard = np.atleast_2d(as_channels(physical, "physical"))
        if len(heard) != self.taps.shape[1]:
            raise ValueError(f"physical must have {self.taps.shape[1]} channels, as in the fit, got {len(heard)}")
        return np.array([sum(lfilter(o, 1.0, h) for o, h in zip(row, heard, strict=True)) for row in self.taps])


def identify_observation_filters(
    physical: ArrayLike, virtual: ArrayLike, n_taps: int, *, regularization: float = 1e-4
) -> ObservationFilters:
    r"""Fit the filters that predict the noise at virtual microphones from that at physical ones, by least squares.

    This is the first stage of the remote-microphone technique. Microphones are placed at the virtual places, just to
    record the noise without control. Then they are removed, and `VirtualMicrophones` uses the filters O:

    .. math:: \hat d_v = O * d_p

    The filters are valid as long as the noise comes from the same places as in the recording. They are causal: if the
    noise reaches a virtual microphone before it reaches the physical ones, the prediction is only as good as the noise
    is predictable.

    Parameters
    ----------
    physical : array_like, shape (K_p, n_samples)
        Signals of the physical microphones; (n_samples,) is allowed for one.
    virtual : array_like, shape (K_v, n_samples)
        Signals of the microphones at the virtual places, recorded at the same time.
    n_taps : int
        Taps of each filter.
    regularization : float, default 1e-4
        Ridge relative to the power at each physical microphone. It is needed if microphones hear nearly the same, and
        it limits how much the filters amplify whatever else the microphones pick up. With the default, frequencies at
        which the noise is 40 dB below its mean density are hardly predicted.

    Returns
    -------
    ObservationFilters
        The filters, and the share of the power at each virtual microphone that they do not predict.

    Raises
    ------
    TypeError, ValueError
        If the recordings differ in length, are shorter than ``(K_p + 1) n_taps - 1`` samples, silent or not finite.

    References
    ----------
    A. Roure, A. Albarrazin, "The remote microphone technique for active noise control", Proc. ACTIVE 99, 1999.
    D. Moreau, B. Cazzolato, A. Zander, C. Petersen, "A review of virtual sensing algorithms for active noise control",
    Algorithms 1(2), 2008.

    Examples
    --------
    The noise reaches the virtual microphone one sample later, with half the amplitude:

    >>> noise = np.random.default_rng(0).standard_normal(2000)
    >>> found = identify_observation_filters(noise[1:], 0.5 * noise[:-1], n_taps=3)
    >>> found.taps.round(3) + 0.0
    array([[[0. , 0.5, 0. ]]])
    """
    n_taps = as_count(n_taps, "n_taps")
    ridge = as_nonnegative(regularization, "regularization")
    heard, wanted = (np.atleast_2d(as_channels(s, n)) for s, n in ((physical, "physical"), (virtual, "virtual")))
    if wanted.shape[1] != heard.shape[1]:
        raise ValueError(f"virtual must have {heard.shape[1]} samples, as physical has, got {wanted.shape[1]}")
    require_length(heard.shape[1], (len(heard) + 1) * n_taps - 1, "physical")
    require_audible({"physical": heard, "virtual": wanted}, n_taps)
    taps, _, residual_db = fit_paths(heard, wanted, n_taps, ridge)
    return ObservationFilters(taps, residual_db)
