"""Virtual microphones: the disturbance where no microphone is, from that at the microphones there are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

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
        Share of the power at each virtual microphone that they do not predict, in dB. At least -300 dB.
    """

    taps: np.ndarray
    residual_db: np.ndarray

    def predict(self, physical: Any) -> np.ndarray:
        """Return the signals at the virtual microphones, (K_v, n_samples), of a recording at the physical ones.

        Parameters
        ----------
        physical : array_like, shape (K_p, n_samples)
            Recording, which begins in silence.

        Returns
        -------
        numpy.ndarray, shape (K_v, n_samples)
            Prediction. On another recording than that of the fit, its error says what the filters are worth.

        Raises
        ------
        TypeError, ValueError
            If the recording has another number of channels, or is not finite.

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
    physical: Any, virtual: Any, n_taps: int, *, regularization: float = 1e-4
) -> ObservationFilters:
    r"""Fit the filters that predict the noise at virtual microphones from that at physical ones, by least squares.

    This is the first stage of the remote-microphone technique. Microphones stand at the virtual places for as long as
    it takes to record the noise, without control. Then they are removed, and `VirtualMicrophones` uses the filters O:

    .. math:: \hat d_v = O * d_p

    The filters hold as long as the noise comes from where it came from in the recording. They are causal: a place that
    the noise reaches before it reaches the physical microphones is predicted only as far as the noise can be foretold.

    Parameters
    ----------
    physical : array_like, shape (K_p, n_samples)
        Signals of the physical microphones; (n_samples,) of one.
    virtual : array_like, shape (K_v, n_samples)
        Signals of the microphones at the virtual places, recorded at the same time.
    n_taps : int
        Taps of each filter.
    regularization : float, default 1e-4
        Ridge relative to the power of each physical microphone. Microphones that hear nearly the same need it, and it
        bounds how much the filters amplify what the microphones hear beside the noise. With the default, frequencies at
        which the noise is 40 dB below its mean density are hardly predicted.

    Returns
    -------
    ObservationFilters
        The filters, and for each virtual microphone how much of its power they leave unexplained.

    Raises
    ------
    TypeError, ValueError
        If the recordings differ in length, are shorter than ``(K_p + 1) n_taps - 1``, silent or not finite.

    References
    ----------
    A. Roure, A. Albarrazin, "The remote microphone technique for active noise control", Proc. ACTIVE 99, 1999.
    D. Moreau, B. Cazzolato, A. Zander, C. Petersen, "A review of virtual sensing algorithms for active noise control",
    Algorithms 1(2), 2008.

    Examples
    --------
    A virtual microphone that the noise reaches a sample later, half as loud:

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
    return ObservationFilters(*fit_paths(heard, wanted, n_taps, ridge))
