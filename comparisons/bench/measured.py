"""Measured paths and recorded noises that others published: where they are, their fetch, and two loaders.

They come without a stated licence, so they are not part of this repository; `measured.txt` lists them. Files are read from
the folder that the environment variable KFOPC_DATA names; without one, they are fetched once to pooch's cache. Each is
checked by SHA-256. `python -m comparisons data` fetches all of them beforehand, to that folder or to the cache.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pooch
from scipy.io import loadmat

from kfopc_filterpy import Plant

FOLDER = "KFOPC_DATA"
HOST = "https://raw.githubusercontent.com"
TIMEOUT_S = 5.0  # for the network's next answer; each file is tried once
FS = 16000.0  # of all of them

_LINES = [line.split() for line in Path(__file__).with_suffix(".txt").read_text(encoding="utf-8").splitlines()]
_FILES = [line for line in _LINES if line and line[0] != "#"]
SHA256 = {name: sha256 for name, sha256, _ in _FILES}
PLACES = {name: place for name, _, place in _FILES}

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
    urls = {file: f"{HOST}/{place}" for file, place in PLACES.items()}
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
