"""The public measured duct, and recordings of a motor and a compressor.

These are third-party data without a stated licence, so they are not part of this package. They are read from a folder
of the user's, or fetched from their public sources, and checked by SHA-256.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .._validate import as_choice, as_positive, as_signal
from .recordings import read_mat_vector

_FOLDER_VARIABLE = "KFOPC_DATA"

# Where each file lies in a data folder, its SHA-256, and its public source at a fixed commit.
_HASHES = {
    "duct/Pz1.mat": "21933650a3af9a1e0cdf77b36d04c03ca36494d9b33384cbc004bbd7e51f976d",
    "duct/Sz.mat": "ea6fcee9df766cf361438f73de5fb63590c20562440a88c462f882fa159df176",
    "motor/Motor.mat": "bded8c35cec69f2c2a71f7d75f8248382a2ea80698ded835d9914b0363755dde",
    "compressor/compressor_16kHz.mat": "41498a595d746ce706926c2b33156bc868753a7e29be1ebb6a1eabcf3417227d",
}
_DUCT = "Luo-Zhengding/GFANC-Kalman/06badd525411571402e83212e7f00b2345cde62d/Pz%20and%20Sz/Duct_Path"
_MOTOR = "Ji-Junwei/PriPathEst_MOVFxLMS_ANC/84bcdae3aaba5c7410898dcb20ba14f5d417c0d8/MOVFxLMS_PriEst/Noise_data"
_COMPRESSOR = "ANC-Research/IC-DMCANC-CPA/ed1d5dbe59c990c1718052e6d3e28513ff12b70c"
_URLS = {
    "duct/Pz1.mat": f"https://raw.githubusercontent.com/{_DUCT}/Pz1.mat",
    "duct/Sz.mat": f"https://raw.githubusercontent.com/{_DUCT}/Sz.mat",
    "motor/Motor.mat": f"https://raw.githubusercontent.com/{_MOTOR}/Motor.mat",
    "compressor/compressor_16kHz.mat": f"https://raw.githubusercontent.com/{_COMPRESSOR}/compressor_16kHz.mat",
}
# File and variable of each noise.
_NOISES = {"motor": ("motor/Motor.mat", "Motor_noise"), "compressor": ("compressor/compressor_16kHz.mat", "yr")}


class DataUnavailableError(FileNotFoundError):
    """The measured duct cannot be read or fetched, or is not the published one; the message says what to do."""


@dataclass(frozen=True, eq=False)
class MeasuredDuct:
    """Impulse responses of a measured duct, and a noise to run through it.

    Build one from files of your own, for instance with `read_mat_vector` and `read_wav`.

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
    >>> duct = MeasuredDuct(primary=[0.0, 0.0, 1.0], secondary=[0.0, 1.0], noise=[0.1, -0.2], fs=8000)
    >>> duct.primary.shape, duct.fs
    ((3,), 8000.0)
    """

    primary: np.ndarray
    secondary: np.ndarray
    noise: np.ndarray
    fs: float = 16000.0

    def __post_init__(self) -> None:
        for name in ("primary", "secondary", "noise"):
            object.__setattr__(self, name, as_signal(getattr(self, name), name))
        object.__setattr__(self, "fs", as_positive(self.fs, "fs", unit="Hz"))


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
    variable KFOPC_DATA names; the public sources, if `allow_download` is true and pooch is installed. A folder holds
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
    >>> try:
    ...     duct = load_measured_duct("no/such/folder")
    ... except DataUnavailableError:
    ...     print("run the built-in duct instead")
    run the built-in duct instead
    """
    noise_file = _NOISES[as_choice(noise, "noise", _NOISES)]
    timeout = as_positive(timeout_s, "timeout_s", unit="s")
    chosen = folder if folder is not None else os.environ.get(_FOLDER_VARIABLE) or None
    if chosen is None and not allow_download:
        raise DataUnavailableError(
            f"no folder with the measured duct is named: pass folder, set {_FOLDER_VARIABLE}, or pass "
            "allow_download=True to fetch it from its public sources"
        )

    def vector(name: str, variable: str) -> np.ndarray:
        path = _fetched_file(name, timeout) if chosen is None else _checked_file(Path(chosen), name)
        return read_mat_vector(path, variable)

    return MeasuredDuct(
        primary=vector("duct/Pz1.mat", "Pz1"),
        secondary=vector("duct/Sz.mat", "S"),
        noise=vector(*noise_file),
    )


def _checked_file(folder: Path, name: str) -> Path:
    """Return the path of a published file in `folder`, its content verified."""
    path = folder / name
    if not path.is_file():
        raise DataUnavailableError(
            f"{path} is missing: put {_URLS[name]} there, or name another folder (argument folder, or the "
            f"environment variable {_FOLDER_VARIABLE})"
        )
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if digest != _HASHES[name]:
        raise DataUnavailableError(
            f"{path} is not the published file, its SHA-256 is {digest}, expected {_HASHES[name]}: "
            f"fetch it again from {_URLS[name]}, or build a MeasuredDuct from files of your own"
        )
    return path


def _fetched_file(name: str, timeout_s: float) -> Path:
    """Return the path of a published file in pooch's cache, fetched on first use, its content verified."""
    try:
        import pooch
    except ImportError as error:
        raise DataUnavailableError(
            "pooch is not installed, so nothing was fetched: install kfopc-filterpy[studies], or set "
            f"{_FOLDER_VARIABLE} to a folder with the files"
        ) from error
    pooch.get_logger().setLevel("WARNING")  # its announcements would run into a progress bar
    cache = pooch.create(pooch.os_cache("kfopc_filterpy"), base_url="", registry=_HASHES, urls=_URLS)
    try:
        return Path(cache.fetch(name, downloader=pooch.HTTPDownloader(timeout=timeout_s)))
    # No network and a cache that cannot be written are OSErrors, a wrong hash is a ValueError.
    except (OSError, ValueError) as error:
        raise DataUnavailableError(
            f"{_URLS[name]} could not be fetched ({error}): set {_FOLDER_VARIABLE} to a folder with the file as "
            f"{name}, or try again with a network"
        ) from error
