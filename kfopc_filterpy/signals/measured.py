"""The measured duct, and the measured room of several loudspeakers and microphones."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np

from .._validate import as_choice, as_positive, as_real_array, as_signal, require_finite
from .datasets import find_or_fetch, named_dataset

_NOISES = ("motor", "compressor")


@dataclass(frozen=True, eq=False, repr=False)
class MeasuredDuct:
    """Impulse responses of a measured duct, and a noise to run through it.

    Build one from files of your own, for instance with `read_recording` and `paths.read_path`.

    Attributes
    ----------
    primary : ndarray, shape (n_taps,)
        Taps of the primary path, from the reference to the error microphone.
    secondary : ndarray, shape (n_taps,)
        Taps of the secondary path, from the loudspeaker to the error microphone.
    noise : ndarray, shape (n_samples,)
        Primary noise.
    fs : float, default 16000
        Sampling frequency of all three in Hz.

    Raises
    ------
    ValueError, TypeError
        If a signal is empty, not one-dimensional or not finite, or fs is not above 0.

    Examples
    --------
    >>> MeasuredDuct(primary=[0.0, 0.0, 1.0], secondary=[0.0, 1.0], noise=np.zeros(4000), fs=8000)
    <MeasuredDuct: primary path 3 taps, secondary path 2 taps, noise 0.5 s, fs 8000 Hz>
    """

    primary: np.ndarray
    secondary: np.ndarray
    noise: np.ndarray
    fs: float = 16000.0

    def __post_init__(self) -> None:
        for name in ("primary", "secondary", "noise"):
            object.__setattr__(self, name, as_signal(getattr(self, name), name))
        object.__setattr__(self, "fs", as_positive(self.fs, "fs", unit="Hz"))

    def __repr__(self) -> str:
        taps = f"primary path {self.primary.size} taps, secondary path {self.secondary.size} taps"
        return f"<MeasuredDuct: {taps}, noise {self.noise.size / self.fs:.3g} s, fs {self.fs:g} Hz>"


def load_measured_duct(
    folder: str | os.PathLike[str] | None = None,
    *,
    noise: str = "motor",
    allow_download: bool = False,
    timeout_s: float = 5.0,
) -> MeasuredDuct:
    """Load measured duct paths and a recorded noise at 16 kHz.

    The paper does not say which paths and which compressor it used. The compressor recording here was published by its
    first author, so it is probably the paper's.

    The first of these that is given is used, and no other is tried after it: `folder`; the folder that the environment
    variable KFOPC_DATA names; pooch's cache, to which `allow_download` fetches what is missing. A folder holds
    duct/Pz1.mat, duct/Sz.mat, and motor/Motor.mat or compressor/compressor_16kHz.mat. From any source, every file must
    have the published SHA-256; for paths of your own, build a `MeasuredDuct`. Units are arbitrary: the secondary path
    gains 10 to 30 dB.

    Parameters
    ----------
    folder : path, optional
        Folder with the files.
    noise : {"motor", "compressor"}, default "motor"
        Recording that is read; the file of the other one is not needed.
    allow_download : bool, default False
        Fetch the files, one try each, into pooch's cache of the operating system; later calls find them there.
    timeout_s : float, default 5.0
        How long to wait for the network's next answer, in seconds; the first failure ends the call.

    Returns
    -------
    MeasuredDuct
        primary (1024,), secondary (512,), noise (162001,) of the motor or (279378,) of the compressor, fs = 16000.

    Raises
    ------
    DataUnavailableError
        If a file is missing, differs from the published one or cannot be fetched.
    ValueError, TypeError
        If `noise` names no recording, or `timeout_s` is not above 0.

    References
    ----------
    Z. Luo et al., "GFANC-Kalman: generative fixed-filter active noise control with CNN-Kalman filtering",
    IEEE Signal Process. Lett., 2023 (duct). J. Ji et al., MOV-FxLMS with primary-path estimation (motor noise). The
    repository ANC-Research/IC-DMCANC-CPA of J. Ji et al. on distributed multichannel ANC (compressor noise).

    Examples
    --------
    >>> from kfopc_filterpy.signals import DataUnavailableError
    >>> try:
    ...     duct = load_measured_duct("no/such/folder")
    ... except DataUnavailableError:
    ...     print("run the built-in duct instead")
    run the built-in duct instead
    """
    as_choice(noise, "noise", _NOISES)
    paths = _vectors("duct", folder, allow_download, timeout_s)
    (recorded,) = _vectors(noise, folder, allow_download, timeout_s).values()
    return MeasuredDuct(primary=paths["Pz1"], secondary=paths["S"], noise=recorded)


@dataclass(frozen=True, eq=False, repr=False)
class MeasuredRoom:
    """Impulse responses between several loudspeakers and microphones.

    Attributes
    ----------
    primary : ndarray, shape (K, I, n_taps)
        Taps of the primary paths, from each of I references to each of K error microphones.
    secondary : ndarray, shape (K, J, n_taps)
        Taps of the secondary paths, from each of J loudspeakers to each error microphone.
    fs : float, default 16000
        Sampling frequency in Hz.

    Raises
    ------
    ValueError, TypeError
        If paths are not finite, not (K, inputs, n_taps) with the same K, or fs is not above 0.

    Examples
    --------
    >>> MeasuredRoom(primary=np.ones((2, 1, 8)), secondary=np.ones((2, 3, 4)), fs=8000)
    <MeasuredRoom: primary paths (2, 1, 8), secondary paths (2, 3, 4), fs 8000 Hz>
    """

    primary: np.ndarray
    secondary: np.ndarray
    fs: float = 16000.0

    def __post_init__(self) -> None:
        for name in ("primary", "secondary"):
            paths = as_real_array(getattr(self, name), name)
            if paths.ndim != 3 or paths.size == 0:
                raise ValueError(f"{name} must have shape (K microphones, inputs, taps), got {paths.shape}")
            require_finite(paths, name)
            object.__setattr__(self, name, paths)
        if len(self.primary) != len(self.secondary):
            raise ValueError(
                f"primary and secondary must have the same K microphones as their first axis, got "
                f"{len(self.primary)} and {len(self.secondary)}"
            )
        object.__setattr__(self, "fs", as_positive(self.fs, "fs", unit="Hz"))

    def __repr__(self) -> str:
        return f"<MeasuredRoom: primary paths {self.primary.shape}, secondary paths {self.secondary.shape}, fs {self.fs:g} Hz>"


def load_measured_room(
    folder: str | os.PathLike[str] | None = None, *, allow_download: bool = False, timeout_s: float = 5.0
) -> MeasuredRoom:
    """Load measured paths of one noise source and four loudspeakers to four microphones, at 16 kHz.

    The source does not state which index of a secondary path's file is the loudspeaker. S{k}{j} is read as the path from
    loudspeaker j to microphone k. It does not describe the room or the units either.

    Files are found and checked as by `load_measured_duct`. A folder holds room4x4/P1.mat to P4.mat and room4x4/S11.mat to
    S44.mat.

    Parameters
    ----------
    folder : path, optional
        Folder with the files, by default the one that the environment variable KFOPC_DATA names.
    allow_download : bool, default False
        Fetch the files from their public source if no folder is named, into pooch's cache.
    timeout_s : float, default 5.0
        How long to wait for the network's next answer, in seconds.

    Returns
    -------
    MeasuredRoom
        primary (4, 1, 256), secondary (4, 4, 256), fs = 16000.

    Raises
    ------
    DataUnavailableError
        If a file is missing, differs from the published one or cannot be fetched.
    ValueError, TypeError
        If `timeout_s` is not above 0.

    References
    ----------
    D. Shi, the repository ShiDongyuan/Meta on GitHub.

    Examples
    --------
    >>> from kfopc_filterpy.signals import DataUnavailableError
    >>> try:
    ...     room = load_measured_room("no/such/folder")
    ... except DataUnavailableError:
    ...     print("the data are not here")
    the data are not here
    """
    paths = _vectors("room", folder, allow_download, timeout_s)
    each = range(1, 5)
    return MeasuredRoom(
        primary=np.array([[paths[f"P{k}"]] for k in each]),
        secondary=np.array([[paths[f"S{k}{j}"] for j in each] for k in each]),
    )


def _vectors(
    name: str, folder: str | os.PathLike[str] | None, allow_download: bool, timeout_s: float
) -> dict[str, np.ndarray]:
    """Return the vectors of a dataset, by variable. Their hashes are checked, so the files are read in this process."""
    from scipy.io import loadmat

    timeout = as_positive(timeout_s, "timeout_s", unit="s")
    place = find_or_fetch(name, folder, allow_download=allow_download, timeout_s=timeout)
    return {
        file.variable: np.ravel(loadmat(place / file.name, variable_names=[file.variable])[file.variable])
        for file in named_dataset(name).files
    }
