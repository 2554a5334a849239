"""Recordings of a scene, and the command that runs beside them."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
from helpers.commands import FS

from kfopc_filterpy.commands import main
from kfopc_filterpy.paths import resample_path
from kfopc_filterpy.signals import band_limited_noise, write_wav


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Files of a scene: full control takes a power of 1 of it."""
    here = tmp_path_factory.mktemp("recordings")
    x = band_limited_noise((100, 1500), 3.0, fs=FS, rng=1, power=1.0)
    primary, secondary = np.eye(64)[26], np.eye(64)[12]
    signals = {"noise": x, "P": primary, "S": secondary, "d": np.convolve(x, primary)[: x.size], "stereo": [x, x]}
    for name, signal in signals.items():
        write_wav(here / f"{name}.wav", signal, FS)
    write_wav(here / "S16.wav", np.asarray(resample_path(secondary, 2 * FS, fs=FS)), 2 * FS)
    write_wav(here / "silent.wav", np.zeros(64), FS)
    write_wav(here / "short.wav", signals["d"][:20000], FS)
    (here / "empty.wav").write_bytes(b"")
    (here / "list.csv").write_text("name,watt,ohm,price\nSmall,1,8,20\n")
    (here / "text.wav").write_text("these are words")
    np.save(here / "untimed.npy", secondary)
    return here


@pytest.fixture
def command(folder, capsys):
    """Run the command in the folder; return its exit code, output and errors."""

    def run(*arguments: object) -> tuple[int, str, str]:
        try:
            with contextlib.chdir(folder):
                code = main([str(one) for one in arguments])
        except SystemExit as end:
            code = int(end.code or 0)
        return code, *capsys.readouterr()

    return run


@pytest.fixture
def several(folder):
    """Two loudspeakers and two microphones: recordings of both microphones, and their paths, each way to give them."""
    x = band_limited_noise((100, 1500), 3.0, fs=FS, rng=1, power=1.0)
    primary, secondary = np.eye(64)[[26, 28]], np.zeros((2, 2, 64))  # (K, J, taps)
    secondary[[0, 0, 1, 1], [0, 1, 0, 1], [12, 15, 16, 12]] = [1.0, 0.2, 0.3, 0.8]
    write_wav(folder / "errors.wav", [np.convolve(x, p)[: x.size] for p in primary], FS)
    np.save(folder / "S.npy", secondary)
    write_wav(folder / "P1.wav", primary, FS)
    for j in (0, 1):
        write_wav(folder / f"S{j + 1}.wav", secondary[:, j], FS)
        write_wav(folder / f"P{j + 1}1.wav", primary[j], FS)
        for k in (0, 1):
            write_wav(folder / f"S{k + 1}{j + 1}.wav", secondary[k, j], FS)
    return x, primary[:, np.newaxis], secondary
