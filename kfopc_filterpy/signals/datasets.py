"""The public measured duct and room, and recordings of a motor and a compressor.

These are third-party data without a stated licence, so they are not part of this package. They are read from a folder
of the user's, or fetched from their public sources, and checked by SHA-256.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .._validate import as_choice, as_positive, as_real_array, as_signal, require_finite
from .recordings import read_content

_FOLDER_VARIABLE = "KFOPC_DATA"

# The room's files by variable: P{k} to microphone k, S{k}{j} from loudspeaker j to microphone k.
_ROOM_HASHES = {
    "P1": "d59075ac333a904ba62dc77a31ba8311ca7af7c5d62857216d328213145be865",
    "P2": "3d25075269206f42800336576730c0985fd60c37896c7d7cbe53a6ee6063e553",
    "P3": "a5e91bd2ee1b1f5aa683a087c4f456ee6ff08a6471e23e9ae81d8080fc69f531",
    "P4": "177bc3cf279a217f7042264d417af99cfde7524339a639880059c5911f373072",
    "S11": "0dc6fcf0ce36ea4b49119da638308a7da49f15f4bea9604ffad220ee2b0343ba",
    "S12": "828404f47cc67a01de81ddccacaf9ca84bb1a7f6879944ef072fc16dd3cfe2fe",
    "S13": "01d8d6493bcc50f176601a4fa3ae01ceb8852f23bd493c63e10d3551d8538ad2",
    "S14": "0347f5d6876c6dde69f0b1aa1728298aed59d166576f5e2d812758b4f6b16e6f",
    "S21": "0c5836eda3613ea7c8279654c83578dacd2ad369359c04e7cfa973f2acdad0c9",
    "S22": "44ca5d237a05e30c42bec2465e27a63a8183b3f0d15635a7a92e5c55d6637245",
    "S23": "c2efd7f5984341ff267bdd3155847c5276579d830d29eb55a31d7945b96dea58",
    "S24": "a55ed764ff44e349064390d9f06e95ca2ef08b49a67c783381d87d45b9c07134",
    "S31": "aed233809d6a6fc6033e9a6249aa711035c29beababda91bd264ccd10b41a935",
    "S32": "24df3d8ff45027432395676409a3dec9a09e6890206e978832ed7ad4148220fc",
    "S33": "4e413c66cdef0290c76fd8f5ac5de49fae56ba3de9f9ee134f61431f4442c501",
    "S34": "d052d8909aa6f324040adaa7dc4990ea63c5eed64efe5c9326ad014dd24b2729",
    "S41": "160e8cb6d0ac2d59d8ea8e05c90d7b6d0d29683fd03c532fdb1cc2609ce4fe6d",
    "S42": "8893bb95e6668451843429ef5f68df2e122e115273ce3f2fddb49c1dfdbbd2e1",
    "S43": "ee087943f71e14ecebbae62db8db1ed33f74de799ed38ff3b2fd2fefad16aea5",
    "S44": "e9a9abe5d954d98933e13c0b933a3487bb54fcf7e2826a25b2b259a1fa01576c",
}
_ROOM = "ShiDongyuan/Meta/dd99aaa351c397090ab7efc03f02a84b669cf302/path"
# Where each file lies in a data folder, its SHA-256, and its public source at a fixed commit.
_HASHES = {
    **{f"room4x4/{name}.mat": digest for name, digest in _ROOM_HASHES.items()},
    "duct/Pz1.mat": "21933650a3af9a1e0cdf77b36d04c03ca36494d9b33384cbc004bbd7e51f976d",
    "duct/Sz.mat": "ea6fcee9df766cf361438f73de5fb63590c20562440a88c462f882fa159df176",
    "motor/Motor.mat": "bded8c35cec69f2c2a71f7d75f8248382a2ea80698ded835d9914b0363755dde",
    "compressor/compressor_16kHz.mat": "41498a595d746ce706926c2b33156bc868753a7e29be1ebb6a1eabcf3417227d",
}
_DUCT = "Luo-Zhengding/GFANC-Kalman/06badd525411571402e83212e7f00b2345cde62d/Pz%20and%20Sz/Duct_Path"
_MOTOR = "Ji-Junwei/PriPathEst_MOVFxLMS_ANC/84bcdae3aaba5c7410898dcb20ba14f5d417c0d8/MOVFxLMS_PriEst/Noise_data"
_COMPRESSOR = "ANC-Research/IC-DMCANC-CPA/ed1d5dbe59c990c1718052e6d3e28513ff12b70c"
_URLS = {
    **{f"room4x4/{name}.mat": f"https://raw.githubusercontent.com/{_ROOM}/{name}.mat" for name in _ROOM_HASHES},
    "duct/Pz1.mat": f"https://raw.githubusercontent.com/{_DUCT}/Pz1.mat",
    "duct/Sz.mat": f"https://raw.githubusercontent.com/{_DUCT}/Sz.mat",
    "motor/Motor.mat": f"https://raw.githubusercontent.com/{_MOTOR}/Motor.mat",
    "compressor/compressor_16kHz.mat": f"https://raw.githubusercontent.com/{_COMPRESSOR}/compressor_16kHz.mat",
}
# File and variable of each noise.
_NOISES = {"motor": ("motor/Motor.mat", "Motor_noise"), "compressor": ("compressor/compressor_16kHz.mat", "yr")}


class DataUnavailableError(FileNotFoundError):
    """Measured data cannot be read or fetched, or are not the published ones; the message says what to do."""


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
    vector = _vector_reader("the measured duct", folder, allow_download, timeout)
    return MeasuredDuct(
        primary=vector("duct/Pz1.mat", "Pz1"),
        secondary=vector("duct/Sz.mat", "S"),
        noise=vector(*noise_file),
    )


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
    >>> try:
    ...     room = load_measured_room("no/such/folder")
    ... except DataUnavailableError:
    ...     print("compute a room with room_paths instead")
    compute a room with room_paths instead
    """
    timeout = as_positive(timeout_s, "timeout_s", unit="s")
    vector = _vector_reader("the measured room", folder, allow_download, timeout)
    each = range(1, 5)
    return MeasuredRoom(
        primary=np.array([[vector(f"room4x4/P{k}.mat", f"P{k}")] for k in each]),
        secondary=np.array([[vector(f"room4x4/S{k}{j}.mat", f"S{k}{j}") for j in each] for k in each]),
    )


def _vector_reader(
    what: str, folder: str | os.PathLike[str] | None, allow_download: bool, timeout_s: float
) -> Callable[[str, str], np.ndarray]:
    """Return a function that reads a published file's variable from the folder chosen, or else from its source."""
    chosen = folder if folder is not None else os.environ.get(_FOLDER_VARIABLE) or None
    if chosen is None and not allow_download:
        raise DataUnavailableError(
            f"no folder with {what} is named: pass folder, set {_FOLDER_VARIABLE}, or pass "
            "allow_download=True to fetch it from its public sources"
        )

    def vector(name: str, variable: str) -> np.ndarray:
        path = _fetched_file(name, timeout_s) if chosen is None else _checked_file(Path(chosen), name)
        return read_content(path, variable=variable).samples

    return vector


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
            f"fetch it again from {_URLS[name]}, or build a MeasuredDuct or MeasuredRoom from files of your own"
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
