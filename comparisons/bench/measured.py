"""Measured paths and recorded noises that others published: where they are, their fetch, and two loaders.

They come without a stated licence, so they are not part of this repository. Files are read from the folder that the
environment variable KFOPC_DATA names; without one, they are fetched once to pooch's cache. Each is checked by SHA-256.
`python -m comparisons data` fetches all of them beforehand, to that folder or to the cache.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pooch
from scipy.io import loadmat

from kfopc_filterpy import Plant

FOLDER = "KFOPC_DATA"
HOST = "https://raw.githubusercontent.com"
TIMEOUT_S = 5.0  # for the network's next answer; each file is tried once
FS = 16000.0  # of all of them

# GitHub repository, commit and folder of each kind of file.
SOURCES = {
    # J. Ji, the first author of the KF-OPC paper: "a noise air duct", eight days before the preprint. No source says that
    # it is the duct of the paper. Its secondary path has unit gain for white noise.
    "author": "Ji-Junwei/PriPathEst_MOVFxLMS_ANC/84bcdae3aaba5c7410898dcb20ba14f5d417c0d8/MOVFxLMS_PriEst",
    # Z. Luo et al., "GFANC-Kalman: generative fixed-filter active noise control with CNN-Kalman filtering", IEEE Signal
    # Process. Lett., 2023. The units are arbitrary: the secondary path gains 10 to 30 dB.
    "duct": "Luo-Zhengding/GFANC-Kalman/06badd525411571402e83212e7f00b2345cde62d/Pz and Sz/Duct_Path",
    # J. Ji et al., MOV-FxLMS with primary-path estimation.
    "motor": "Ji-Junwei/PriPathEst_MOVFxLMS_ANC/84bcdae3aaba5c7410898dcb20ba14f5d417c0d8/MOVFxLMS_PriEst/Noise_data",
    # J. Ji et al., distributed multichannel control. The paper does not say which compressor it used; its first author
    # published this one.
    "compressor": "ANC-Research/IC-DMCANC-CPA/ed1d5dbe59c990c1718052e6d3e28513ff12b70c",
    # D. Shi. Neither the room nor the units are described.
    "room4x4": "ShiDongyuan/Meta/dd99aaa351c397090ab7efc03f02a84b669cf302/path",
}
SHA256 = {
    "author/Path.mat": "6e2cd0821fec5e1d15258280399315ad20d44f09006789de50f3611d837b7c8c",
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
# Files and variables of each measured duct's primary and secondary path, and of each noise.
DUCTS = {
    "author": (("author/Path.mat", "P"), ("author/Path.mat", "S")),
    "gfanc": (("duct/Pz1.mat", "Pz1"), ("duct/Sz.mat", "S")),
}
NOISES = {"motor": ("motor/Motor.mat", "Motor_noise"), "compressor": ("compressor/compressor_16kHz.mat", "yr")}


class DataUnavailableError(FileNotFoundError):
    """Measured data cannot be read or fetched, or are not the published ones; the message says what to do."""


@dataclass(frozen=True, eq=False)
class MeasuredDuct:
    """Taps of a duct's primary and secondary path, (n_taps,), and a noise, (n_samples,), at the rate `fs` in Hz."""

    primary: np.ndarray
    secondary: np.ndarray
    noise: np.ndarray
    fs: float = FS


def load_measured_duct(noise: str, duct: str = "gfanc") -> MeasuredDuct:
    """Return a measured duct, and the recording of the "motor" (10.1 s) or of the "compressor" (17.5 s).

    The duct is that of the paper's first author, "author", or that of Luo et al., "gfanc".
    """
    primary, secondary = (_read(*place) for place in DUCTS[duct])
    return MeasuredDuct(primary, secondary, _read(*NOISES[noise]))


def load_measured_room() -> Plant:
    """Return the plant of one noise source and four loudspeakers to four microphones.

    The source does not say which index of a secondary path is the loudspeaker: S{k}{j} is read as the path from
    loudspeaker j to microphone k.
    """
    each = range(1, 5)
    return Plant(
        [[_read(f"room4x4/S{k}{j}.mat", f"S{k}{j}") for j in each] for k in each],
        [[_read(f"room4x4/P{k}.mat", f"P{k}")] for k in each],
        fs=FS,
    )


def fetch(name: str) -> Path:
    """Return the path of a published file, fetched if it is not there; one that is there and differs is left alone."""
    pooch.get_logger().setLevel("WARNING")  # its announcements would run into a progress bar
    urls = {file: f"{HOST}/{quote(SOURCES[Path(file).parent.name])}/{Path(file).name}" for file in SHA256}
    store = pooch.create(folder(), base_url="", registry=SHA256, urls=urls, allow_updates=False)
    try:
        downloader = pooch.HTTPDownloader(timeout=TIMEOUT_S, progressbar=sys.stderr.isatty())
        return Path(store.fetch(name, downloader=downloader))
    # No network, an answer such as 404, a cut transfer and a folder that cannot be written are OSErrors; a hash that is
    # not the published file's is a ValueError.
    except (OSError, ValueError) as error:
        raise DataUnavailableError(
            f"{urls[name]} is not at hand ({error}): set {FOLDER} to a folder with the published file as {name}, delete "
            "a file that is not the published one, or try again with a network"
        ) from error


def folder() -> Path:
    """Return the folder of the data: the one that KFOPC_DATA names, or else pooch's cache."""
    return Path(os.environ.get(FOLDER) or pooch.os_cache("kfopc_filterpy"))


def _read(name: str, variable: str) -> np.ndarray:
    """Return a variable of a published file as a vector; only to the cache is a file fetched that is missing."""
    if os.environ.get(FOLDER) and not (folder() / name).is_file():
        raise DataUnavailableError(f"{folder() / name} is missing: python -m comparisons data fetches it")
    return np.ravel(loadmat(fetch(name), variable_names=[variable])[variable])


def main(arguments: Sequence[str]) -> int:
    """Fetch what is missing, and print the folder."""
    parser = argparse.ArgumentParser(
        prog="python -m comparisons data",
        description=f"Fetch the measured data to the folder that {FOLDER} names, or to a cache, and print the folder.",
    )
    parser.parse_args(arguments)
    try:
        for name in SHA256:
            fetch(name)
    except DataUnavailableError as error:
        parser.error(str(error))
    print(folder())
    return 0
