"""A small valid file of every format that is read, written by the field's own libraries."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import soundfile

FS = 16000


def signal(n_channels: int = 1, n_samples: int = 300) -> np.ndarray:
    """Return the signal that the files hold, exact in 16 bits, (n_channels, n_samples), or without the first axis for one."""
    rng = np.random.default_rng(8)
    steps = rng.integers(-(2**15), 2**15, (n_channels, n_samples))
    return np.squeeze(steps / 2**15, axis=0) if n_channels == 1 else steps / 2**15


def _audio(path: Path, **settings: str) -> None:
    soundfile.write(path, signal(2).T, FS, **settings)


def _npy(path: Path) -> None:
    np.save(path, signal(2))


def _npz(path: Path) -> None:
    np.savez_compressed(path, noise=signal(), fs=FS, other=np.array([1.0]))


def _mat5(path: Path, compressed: bool = True) -> None:
    scipy.io.savemat(path, {"noise": signal()[:, None], "fs": float(FS), "text": "a fan"}, do_compression=compressed)


def _mat4(path: Path) -> None:
    scipy.io.savemat(path, {"noise": signal()[:, None], "fs": float(FS)}, format="4")


def _mat_struct(path: Path) -> None:
    """Write a struct with a path and its rate, as a measurement is often kept."""
    meas = {"ir": signal()[:, None], "fs": float(FS), "who": "me", "more": {"gain": 2.0}}
    scipy.io.savemat(path, {"meas": meas, "words": np.array(["a", "b"], dtype=object)})


def _mat73(path: Path) -> None:
    """Write what MATLAB's `save -v7.3` writes: HDF5 after 512 bytes of its own, axes swapped, the class as an attribute."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w", userblock_size=512) as file:
        noise = file.create_dataset("noise", data=signal()[None, :], chunks=(1, 300), compression="gzip")
        rate, text = file.create_dataset("fs", data=[[float(FS)]]), file.create_dataset("text", data=np.uint16([[97]]))
        for data, kind in ((noise, "double"), (rate, "double"), (text, "char")):
            data.attrs["MATLAB_class"] = np.bytes_(kind)
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    with open(path, "r+b") as file:
        file.write(head)


def _text(path: Path) -> None:
    np.savetxt(path, signal(2).T, header="left right", delimiter=",")


def _timed(path: Path) -> None:
    np.savetxt(path, np.column_stack([np.arange(signal().size) / FS, signal()]), fmt="%.7f;%.17g", header="t;p")


def rew_text(taps: np.ndarray, *, fs: float = FS, start_s: float = 0.0, changes: tuple[str, str] = ("", "")) -> str:
    """Return an impulse response as REW 5.40 exports it, `changes` replaced in its header."""
    header = (
        "* Impulse Response data saved by REW V5.40 Beta 132\n* IR is not normalised\n* IR window has not been applied\n"
        "* IR is not the min phase version\n* Source: Scarlett 2i2, 1, volume: no control\n* Measurement: w-L_01 (sw)\n"
        "* Excitation: 512k Log Swept Sine, 1 sweep at -10.0 dBFS using a loopback as a timing reference\n"
        "* Response measured over: 20.1 to 7,999.9 Hz\n0.25 // Peak value before normalisation\n"
        f"{int(np.argmax(np.abs(taps)))} // Peak index\n{taps.size} // Response length\n{1 / fs!r} // Sample interval (seconds)\n"
        f"{start_s!r} // Start time (seconds)\n120.0 // Data offset (dB)\n* Data start\n"
    ).replace(*changes)
    return header + "".join(f"{tap!r}\n" for tap in taps.tolist())


def _rew(path: Path) -> None:
    path.write_text(rew_text(signal()), encoding="utf-8")


WRITERS: dict[str, Callable[[Path], None]] = {
    "pcm16.wav": lambda path: _audio(path, subtype="PCM_16"),
    "float.wav": lambda path: _audio(path, subtype="FLOAT"),
    "long.rf64": lambda path: _audio(path, format="RF64", subtype="PCM_24"),
    "x.flac": _audio,
    "x.aiff": _audio,
    "x.npy": _npy,
    "x.npz": _npz,
    "packed.mat": _mat5,
    "plain.mat": lambda path: _mat5(path, compressed=False),
    "four.mat": _mat4,
    "new.mat": _mat73,
    "struct.mat": _mat_struct,
    "x.csv": _text,
    "timed.csv": _timed,
    "rew.txt": _rew,
}
