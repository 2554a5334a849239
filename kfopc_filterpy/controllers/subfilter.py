"""A bank of fixed sub-filters whose outputs are mixed by the gains of a small Kalman filter, within a rated power."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._types import PathModel
from .._validate import as_count, as_number, as_positive, as_real_array, as_signal, require_finite
from ..bounds.channel_bound import ChannelCorrelations
from ..checkpoint import Checkpointed
from ..filters.kfopc import KFOPC
from ..paths import path_taps
from ..power.constraint import DEFAULT_FS, DEFAULT_MEMORY_S
from .base import require_rates
from .channel_samples import ChannelFilters, require_moderate
from .processing import BlockProcessing

BLOCK_S = 0.005  # after which R, H and the reduction of the gains are computed anew
RIDGE = 1e-6  # of the mean energy of an output: bands with less get no gain while the power is limited


def band_subfilters(control_filter: ArrayLike, n_bands: int = 15) -> np.ndarray:
    """Return the parts of a control filter in adjacent bands; their sum is the control filter.

    The discrete Fourier transform of the weights is cut into bands of equal width, from 0 Hz to half the sample rate.

    Parameters
    ----------
    control_filter : array_like, shape (L,)
        Weights of a broadband control filter, for example those of `bounds.wiener_solution` for white noise.
    n_bands : int, default 15
        Number of bands C, at most L // 2 + 1.

    Returns
    -------
    ndarray, shape (C, L)
        Sub-filters, that of the lowest band first.

    Raises
    ------
    ValueError, TypeError
        A filter that is not finite or not one-dimensional, or more bands than it has frequencies.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy.controllers import band_subfilters
    >>> bands = band_subfilters([0.0, 1.0, 0.5, 0.0], n_bands=3)
    >>> bands.shape, bands.sum(axis=0).round(12).tolist()
    ((3, 4), [0.0, 1.0, 0.5, 0.0])
    """
    weights = as_signal(control_filter, "control_filter")
    spectrum = np.fft.rfft(weights)
    n_bands = as_count(n_bands, "n_bands")
    if n_bands > spectrum.size:
        raise ValueError(f"n_bands must be at most {spectrum.size} for {weights.size} taps, got {n_bands}")
    parts = np.zeros((n_bands, spectrum.size), dtype=complex)
    for part, bins in zip(parts, np.array_split(np.arange(spectrum.size), n_bands), strict=True):
        part[bins] = spectrum[bins]
    return np.fft.irfft(parts, n=weights.size)


class SubfilterKalman(BlockProcessing, Checkpointed):
    r"""A fixed bank of sub-filters, mixed by gains that a Kalman filter of as many states finds.

    .. math::

       y = \sum_c g_c\,(w_c * x),

       \hat d = \sum_c g_c\,(\hat s * w_c * x) + \text{noise}

    The gains are a random walk (eq. 1-8 with the filtered outputs of the sub-filters as the row). There are far fewer
    gains than taps, so they are found within some tens of milliseconds. The noise reduction is limited by what the
    sub-filters can form together. Nothing is trained: `band_subfilters` makes them from one broadband control filter,
    which takes a measurement of the primary path with broadband noise.

    With a rated power, the gains are reduced to those of the least expected error within it. With R and H, the running
    means of the products of the sub-filters' outputs, before and after the secondary path, these are

    .. math::

       (H + \lambda R)\,g' = H g,

       \lambda \ge 0,

       g'^T R\,g' \le \rho_o.

    The Kalman filter itself goes on with the gains g.

    Parameters
    ----------
    subfilters : array_like, shape (C, L)
        Weights of the sub-filters.
    secondary_path : array_like, shape (n_path,), or control system
        Estimated secondary path.
    state_noise, measurement_noise, initial_variance
        r, q and P(0|0) of the gains, as for `KFOPC.random_walk`. The default variance of 1 fits sub-filters whose sum
        cancels broadband noise.
    rated_power : float, optional
        Rated output power; by default there is none.
    fs : float, default 16000
        Sample rate in Hz.
    memory_s : float, default 0.5
        Memory of R and H in s.

    Attributes
    ----------
    gains : ndarray, shape (C,)
        Gains of the next sample, within the rated power.
    weights : ndarray, shape (L,)
        Control filter that these gains form.

    Raises
    ------
    ValueError, TypeError
        A setting that is out of range, or shapes that do not fit.

    See Also
    --------
    kf_pb : Adapts all taps within a rated power, and learns the paths.

    Notes
    -----
    `simulate` calls it from Python, sample by sample.

    References
    ----------
    The structure is that of Z. Luo, D. Shi, X. Shen, J. Ji, W.-S. Gan, "GFANC-Kalman: Generative fixed-filter active
    noise control with CNN-Kalman filtering", IEEE Signal Process. Lett. 31, 2024. There, a network tells from each
    second of noise which of 15 sub-filters it needs, and the Kalman filter smooths these answers. Here, the Kalman
    filter observes the error microphone instead.

    Examples
    --------
    Three bands of a filter that cancels white noise perfectly:

    >>> import numpy as np
    >>> from kfopc_filterpy import simulate
    >>> from kfopc_filterpy.controllers import SubfilterKalman, band_subfilters
    >>> bank = band_subfilters([0.0, 0.0, 1.0, 0.0], n_bands=3)
    >>> controller = SubfilterKalman(bank, [0.0, 1.0], state_noise=0.0, measurement_noise=1e-3)
    >>> x = np.random.default_rng(0).standard_normal(1000)
    >>> result = simulate(controller, x, primary_path=[0.0, 0.0, 0.0, 1.0], secondary_path=[0.0, 1.0])
    >>> controller.gains.round(3).tolist()
    [1.0, 1.0, 1.0]
    """

    name = "sub-filter KF"

    def __init__(
        self,
        subfilters: ArrayLike,
        secondary_path: PathModel,
        *,
        state_noise: float,
        measurement_noise: float,
        initial_variance: float = 1.0,
        rated_power: float | None = None,
        fs: float = DEFAULT_FS,
        memory_s: float = DEFAULT_MEMORY_S,
    ) -> None:
        self.fs = as_positive(fs, "fs", unit="Hz")
        memory = as_positive(memory_s, "memory_s", unit="s") * self.fs
        bank = as_real_array(subfilters, "subfilters").copy()
        if bank.ndim != 2 or bank.size == 0:
            raise ValueError(f"subfilters must be (C, L), one row for each sub-filter, got shape {bank.shape}")
        require_finite(bank, "subfilters")
        s = path_taps(secondary_path, fs=self.fs, name="secondary_path")
        self.rated_power = None if rated_power is None else as_positive(rated_power, "rated_power")
        self.kf = KFOPC.random_walk(
            len(bank),
            state_noise=state_noise,
            measurement_noise=as_positive(measurement_noise, "measurement_noise"),  # S must not be 0 in silence
            initial_variance=initial_variance,
        )
        self.subfilters = bank
        filtered = np.array([np.convolve(w, s) for w in bank])
        padded = np.pad(bank, [(0, 0), (0, s.size - 1)])
        self._bank = ChannelFilters(np.concatenate((padded, filtered))[:, np.newaxis])
        self._played = ChannelFilters(s.reshape(1, 1, -1))
        self._block = np.zeros((max(round(BLOCK_S * self.fs), 1), 2 * len(bank)))
        self._outputs = self._block[-1]  # of the sub-filters, and these filtered by the secondary path
        self._R, self._H = np.zeros((2, len(bank), len(bank)))
        self._reduction = np.eye(len(bank))  # from the gains of the Kalman filter to those within the rated power
        self._samples, self._memory = 0, memory

    def __repr__(self) -> str:
        rated = "" if self.rated_power is None else f", rated power {self.rated_power:g}"
        return f"<{self.name}: {len(self.subfilters)} sub-filters of {self.subfilters.shape[1]} taps{rated}>"

    @property
    def gains(self) -> np.ndarray:
        """Gains of the next sample, within the rated power, (C,)."""
        return self._reduction @ self.kf.x.reshape(-1)

    @property
    def weights(self) -> np.ndarray:
        """Control filter that these gains form, (L,)."""
        return self.gains @ self.subfilters

    def control_signal(self, reference: float) -> float:
        """Return the control signal y(n) for the newest reference sample x(n)."""
        self._hear(reference)
        y = float(self.gains @ self._outputs[: len(self.subfilters)])
        self._played.push(np.array([y]))
        return y

    def emitted(self, control_signal: float) -> None:
        """Take `control_signal`, to which a limiter changed the last one; `LimitedController` calls this."""
        self._played.replace(np.array([control_signal]))

    def update(self, error: float) -> None:
        """Let the gains adapt to the error e(n) that the last control signal left."""
        disturbance = float(_moderate(error, "error")[0] + self._played.output()[0])
        before = self.kf.__dict__.copy()  # predictions write into no array
        try:
            self.kf.predict()
            self.kf.update(disturbance, H=self._outputs[len(self.subfilters) :])
        except BaseException:  # the prediction must not stay
            self.kf.__dict__.clear()
            self.kf.__dict__.update(before)
            raise

    def listen(self, references: Any, errors: Any) -> None:
        """Follow `references`, (n_samples,), before the control is switched on; `errors` are not used.

        The output is silent, and the gains stay as they are.
        """
        for x in as_signal(references, "references"):
            self._hear(x)
            self._played.push(np.zeros(1))

    def require_sample_rate(self, fs: float) -> None:
        """Raise ValueError if the controller is for another sample rate than `fs` in Hz."""
        require_rates(fs, {"sub-filters": self.fs})

    def _hear(self, reference: Any) -> None:
        """Filter a reference sample by the bank, and reduce the gains at the end of a block."""
        self._bank.push(_moderate(reference, "reference"))
        n, length = len(self.subfilters), len(self._block)
        self._outputs = self._block[self._samples % length]
        self._outputs[:] = self._bank.output()
        self._samples += 1
        if self.rated_power is None or self._samples % length:
            return
        rate = max(length / self._samples, 1.0 - math.exp(-length / self._memory))
        for mean, part in ((self._R, self._block[:, :n]), (self._H, self._block[:, n:])):
            mean += rate * (part.T @ part / length - mean)
        self._reduction = self._within(self.rated_power)

    def _within(self, rated_power: float) -> np.ndarray:
        """Return the matrix that reduces the gains of the Kalman filter to the best ones within the rated power."""
        identity, g = np.eye(len(self.subfilters)), self.kf.x.reshape(-1)
        if g @ self._R @ g <= rated_power:
            return identity
        correlations = ChannelCorrelations(self._H, self._R, self._H @ g, (1, 1, g.size))
        _, penalty = correlations.constrained_weights(np.array([rated_power]))
        ridge = RIDGE * np.trace(self._H) / g.size
        return np.asarray(np.linalg.solve(self._H + penalty * self._R + ridge * identity, self._H))


def _moderate(value: Any, name: str) -> np.ndarray:
    """Return a checked sample as an array, (1,)."""
    sample = np.array([as_number(value, name)])
    require_moderate(sample, name)
    return sample
