"""Public measured data: where they come from, what they are, and fetching them.

These are third-party data without a stated licence, so they are not part of this package. They are read from a folder
of the user's, or fetched from their public sources, and checked by SHA-256.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from .._validate import as_choice, as_positive, how_to_install

_FOLDER_VARIABLE = "KFOPC_DATA"
_HOST = "https://raw.githubusercontent.com"
_NO_LICENCE = "none stated"

# SHA-256 of each file. The room's are P{k}, to microphone k, and S{k}{j}, from loudspeaker j to microphone k.
_SHA256 = {
    "duct/Pz1.mat": "21933650a3af9a1e0cdf77b36d04c03ca36494d9b33384cbc004bbd7e51f976d",
    "duct/Sz.mat": "ea6fcee9df766cf361438f73de5fb63590c20562440a88c462f882fa159df176",
    "motor/Motor.mat": "bded8c35cec69f2c2a71f7d75f8248382a2ea80698ded835d9914b0363755dde",
    "compressor/compressor_16kHz.mat": "41498a595d746ce706926c2b33156bc868753a7e29be1ebb6a1eabcf3417227d",
    "room4x4/P1.mat": "d59075ac333a904ba62dc77a31ba8311ca7af7c5d62857216d328213145be865",
    "room4x4/P2.mat": "3d25075269206f42800336576730c0985fd60c37896c7d7cbe53a6ee6063e553",
    "room4x4/P3.mat": "a5e91bd2ee1b1f5aa683a087c4f456ee6ff08a6471e23e9ae81d8080fc69f531",
    "room4x4/P4.mat": "177bc3cf279a217f7042264d417af99cfde7524339a639880059c5911f373072",
    "room4x4/S11.mat": "0dc6fcf0ce36ea4b49119da638308a7da49f15f4bea9604ffad220ee2b0343ba",
    "room4x4/S12.mat": "828404f47cc67a01de81ddccacaf9ca84bb1a7f6879944ef072fc16dd3cfe2fe",
    "room4x4/S13.mat": "01d8d6493bcc50f176601a4fa3ae01ceb8852f23bd493c63e10d3551d8538ad2",
    "room4x4/S14.mat": "0347f5d6876c6dde69f0b1aa1728298aed59d166576f5e2d812758b4f6b16e6f",
    "room4x4/S21.mat": "0c5836eda3613ea7c8279654c83578dacd2ad369359c04e7cfa973f2acdad0c9",
    "room4x4/S22.mat": "44ca5d237a05e30c42bec2465e27a63a8183b3f0d15635a7a92e5c55d6637245",
    "room4x4/S23.mat": "c2efd7f5984341ff267bdd3155847c5276579d830d29eb55a31d7945b96dea58",
    "room4x4/S24.mat": "a55ed764ff44e349064390d9f06e95ca2ef08b49a67c783381d87d45b9c07134",
    "room4x4/S31.mat": "aed233809d6a6fc6033e9a6249aa711035c29beababda91bd264ccd10b41a935",
    "room4x4/S32.mat": "24df3d8ff45027432395676409a3dec9a09e6890206e978832ed7ad4148220fc",
    "room4x4/S33.mat": "4e413c66cdef0290c76fd8f5ac5de49fae56ba3de9f9ee134f61431f4442c501",
    "room4x4/S34.mat": "d052d8909aa6f324040adaa7dc4990ea63c5eed64efe5c9326ad014dd24b2729",
    "room4x4/S41.mat": "160e8cb6d0ac2d59d8ea8e05c90d7b6d0d29683fd03c532fdb1cc2609ce4fe6d",
    "room4x4/S42.mat": "8893bb95e6668451843429ef5f68df2e122e115273ce3f2fddb49c1dfdbbd2e1",
    "room4x4/S43.mat": "ee087943f71e14ecebbae62db8db1ed33f74de799ed38ff3b2fd2fefad16aea5",
    "room4x4/S44.mat": "e9a9abe5d954d98933e13c0b933a3487bb54fcf7e2826a25b2b259a1fa01576c",
}


class DataUnavailableError(FileNotFoundError):
    """Measured data cannot be read or fetched, or are not the published ones; the message says what to do."""


@dataclass(frozen=True)
class DatasetFile:
    """A file of a dataset.

    Attributes
    ----------
    name : str
        Where it lies in a data folder: "duct/Sz.mat".
    url : str
        Its public source, at a fixed commit.
    sha256 : str
        The hash of the published file.
    variable : str
        The variable in it that is read.
    """

    name: str
    url: str
    sha256: str
    variable: str


@dataclass(frozen=True)
class Dataset:
    """Public measured data: what they are, and where they come from.

    Attributes
    ----------
    name : str
        Name for `fetch_dataset`.
    title : str
        What the data are.
    repository : str
        Public source on GitHub, owner/name.
    commit : str
        Commit of it that is used.
    licence : str
        Licence as the source states it, or "none stated". Then the data are for the user's own reading; they must not be
        passed on.
    fs : float
        Sampling frequency in Hz.
    units : str
        Units of the samples.
    files : tuple of DatasetFile
        The files.
    """

    name: str
    title: str
    repository: str
    commit: str
    licence: str
    fs: float
    units: str
    files: tuple[DatasetFile, ...]


def _dataset(
    name: str, title: str, repository: str, commit: str, units: str, files: dict[str, tuple[str, str]]
) -> Dataset:
    """Return a dataset at 16 kHz without a licence; of each variable its file's name, and the path at the source."""
    source = f"{_HOST}/{repository}/{commit}"
    entries = (DatasetFile(name, f"{source}/{quote(path)}", _SHA256[name], var) for var, (name, path) in files.items())
    return Dataset(name, title, repository, commit, _NO_LICENCE, 16000.0, units, tuple(entries))


_DATASETS = {
    dataset.name: dataset
    for dataset in (
        _dataset(
            "duct",
            "impulse responses of a duct: primary path of 1024 taps, secondary path of 512",
            "Luo-Zhengding/GFANC-Kalman",
            "06badd525411571402e83212e7f00b2345cde62d",
            "arbitrary: the secondary path gains 10 to 30 dB",
            {
                "Pz1": ("duct/Pz1.mat", "Pz and Sz/Duct_Path/Pz1.mat"),
                "S": ("duct/Sz.mat", "Pz and Sz/Duct_Path/Sz.mat"),
            },
        ),
        _dataset(
            "motor",
            "recorded noise of a motor, 10.1 s",
            "Ji-Junwei/PriPathEst_MOVFxLMS_ANC",
            "84bcdae3aaba5c7410898dcb20ba14f5d417c0d8",
            "arbitrary",
            {"Motor_noise": ("motor/Motor.mat", "MOVFxLMS_PriEst/Noise_data/Motor.mat")},
        ),
        _dataset(
            "compressor",
            "recorded noise of a compressor, 17.5 s",
            "ANC-Research/IC-DMCANC-CPA",
            "ed1d5dbe59c990c1718052e6d3e28513ff12b70c",
            "arbitrary",
            {"yr": ("compressor/compressor_16kHz.mat", "compressor_16kHz.mat")},
        ),
        _dataset(
            "room",
            "impulse responses of a noise source and four loudspeakers to four microphones, 256 taps each",
            "ShiDongyuan/Meta",
            "dd99aaa351c397090ab7efc03f02a84b669cf302",
            "not stated",
            {Path(name).stem: (name, f"path/{Path(name).name}") for name in _SHA256 if name.startswith("room4x4/")},
        ),
    )
}


def list_datasets() -> tuple[Dataset, ...]:
    """Return the public measured data that can be read or fetched, with their sources.

    Returns
    -------
    tuple of Dataset
        Name, title, source, commit, licence, sampling rate, units and files of each.

    Examples
    --------
    >>> for dataset in list_datasets():
    ...     print(f"{dataset.name:10} {len(dataset.files):2} files at {dataset.fs:g} Hz, licence: {dataset.licence}")
    duct        2 files at 16000 Hz, licence: none stated
    motor       1 files at 16000 Hz, licence: none stated
    compressor  1 files at 16000 Hz, licence: none stated
    room       20 files at 16000 Hz, licence: none stated
    """
    return tuple(_DATASETS.values())


def dataset_folder() -> Path:
    """Return the folder that measured data are read from and fetched to.

    It is the one that the environment variable KFOPC_DATA names, or else pooch's cache of the operating system. It need not
    exist yet.

    Returns
    -------
    pathlib.Path
        The folder; a dataset's files have their `DatasetFile.name` in it.

    Raises
    ------
    DataUnavailableError
        If KFOPC_DATA is not set and pooch is not installed.

    Examples
    --------
    >>> import os
    >>> from unittest import mock
    >>> with mock.patch.dict(os.environ, KFOPC_DATA="measured"):
    ...     print(dataset_folder())
    measured
    """
    named = os.environ.get(_FOLDER_VARIABLE)
    return Path(named) if named else Path(_pooch().os_cache("kfopc_filterpy"))


def has_dataset(name: str, folder: str | os.PathLike[str] | None = None) -> bool:
    """Return whether a whole dataset is in the folder, checked by SHA-256, so that it can be read without a network.

    Parameters
    ----------
    name : {"duct", "motor", "compressor", "room"}
        The dataset, see `list_datasets`.
    folder : path, optional
        Folder to look in, `dataset_folder` by default.

    Returns
    -------
    bool
        False if a file is missing.

    Raises
    ------
    DataUnavailableError
        If a file is there but is not the published one, or no folder is named and pooch is not installed.
    ValueError
        If there is no such dataset.

    Examples
    --------
    >>> has_dataset("duct", "no/such/folder")
    False
    """
    place = Path(folder) if folder is not None else dataset_folder()
    return all(_is_published(place, file) for file in named_dataset(name).files)


def fetch_dataset(name: str, folder: str | os.PathLike[str] | None = None, *, timeout_s: float = 5.0) -> Path:
    """Fetch what is missing of a dataset, and return the folder.

    Files that are there are not fetched again; a whole dataset is found without a network. A file that differs from the
    published one is never overwritten.

    Parameters
    ----------
    name : {"duct", "motor", "compressor", "room"}
        The dataset, see `list_datasets`.
    folder : path, optional
        Folder to fetch it to, `dataset_folder` by default.
    timeout_s : float, default 5.0
        How long to wait for the network's next answer, in seconds; each file is tried once, and the first failure ends the
        call.

    Returns
    -------
    pathlib.Path
        The folder; every file in it was checked by SHA-256.

    Raises
    ------
    DataUnavailableError
        If a file cannot be fetched (no network, not found, cut off, no room), or a file that is there or was fetched is not
        the published one, or pooch is needed and not installed. Nothing is left of a file that was not fetched whole.
    ValueError, TypeError
        If there is no such dataset, or `timeout_s` is not above 0.

    Examples
    --------
    >>> fetch_dataset("fan")
    Traceback (most recent call last):
    ValueError: name must be one of 'duct', 'motor', 'compressor', 'room', got 'fan'
    """
    dataset = named_dataset(name)
    timeout = as_positive(timeout_s, "timeout_s", unit="s")
    place = Path(folder) if folder is not None else dataset_folder()
    for file in dataset.files:
        if not _is_published(place, file):
            _fetch(place, file, timeout)
    return place


def named_dataset(name: str) -> Dataset:
    """Return a dataset by its name."""
    return _DATASETS[as_choice(name, "name", _DATASETS)]


def find_or_fetch(name: str, folder: str | os.PathLike[str] | None, *, allow_download: bool, timeout_s: float) -> Path:
    """Return the folder that has a dataset: the one named, else the one of the environment, else pooch's cache.

    Only to the cache is anything fetched, if that is allowed.
    """
    named = folder if folder is not None else os.environ.get(_FOLDER_VARIABLE) or None
    if named is None and allow_download:
        return fetch_dataset(name, timeout_s=timeout_s)
    place = dataset_folder() if named is None else Path(named)
    for file in named_dataset(name).files:
        if not _is_published(place, file):
            raise DataUnavailableError(
                f"{place / file.name} is missing: put {file.url} there with signals.fetch_dataset({name!r}, folder), or "
                f"name another folder (argument folder, or the environment variable {_FOLDER_VARIABLE}); without a folder, "
                "allow_download=True fetches it"
            )
    return place


def _is_published(folder: Path, file: DatasetFile) -> bool:
    """Return whether a file is in `folder`; raise DataUnavailableError if it is there but not the published one."""
    path = folder / file.name
    if not path.is_file():
        return False
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if digest != file.sha256:
        raise DataUnavailableError(
            f"{path} is not the published file, its SHA-256 is {digest}, expected {file.sha256}: delete it and fetch it "
            f"again from {file.url}, or build a MeasuredDuct or MeasuredRoom from files of your own"
        )
    return True


def _fetch(folder: Path, file: DatasetFile, timeout_s: float) -> None:
    """Fetch a published file to `folder`; one that is not whole, or not the published one, is not kept."""
    pooch = _pooch()
    path = folder / file.name
    try:
        pooch.retrieve(
            file.url,
            f"sha256:{file.sha256}",
            fname=path.name,
            path=path.parent,
            downloader=pooch.HTTPDownloader(timeout=timeout_s),
        )
    # No network, an answer such as 404, a cut transfer and a folder that cannot be written are OSErrors, a wrong hash is a
    # ValueError.
    except (OSError, ValueError) as error:
        raise DataUnavailableError(
            f"{file.url} could not be fetched ({error}): set {_FOLDER_VARIABLE} to a folder with the file as {file.name}, or "
            "try again with a network"
        ) from error


def _pooch() -> Any:
    try:
        import pooch
    except ImportError as error:
        raise DataUnavailableError(
            f"pooch is not installed, so nothing was fetched: {how_to_install('studies')}, or set "
            f"{_FOLDER_VARIABLE} to a folder with the files"
        ) from error
    pooch.get_logger().setLevel("WARNING")  # its announcements would run into a progress bar
    return pooch
