"""Damaged files of every format: each is read, or refused with a message; nothing else comes out, and no warning."""

from __future__ import annotations

import gc
import os
import re
import struct
import subprocess
import sys
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest
import scipy.io
import soundfile
from helpers.commands import ROOT
from helpers.files import FS, WRITERS, rew_text, signal
from hypothesis import given, settings
from hypothesis import strategies as st

from kfopc_filterpy.paths import read_path
from kfopc_filterpy.signals import Recording, read_recording
from kfopc_filterpy.signals.content import room_of

# For a longer search: `FUZZ_EXAMPLES=20000 pytest tests/signals/test_damaged_files.py --hypothesis-profile default`.
EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "60"))

_EXTREMES = [bytes(4), b"\xff" * 4, b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\1\0\0\0", b"-1e9", b"nan ", b" 9999 "]
_PLACE = st.one_of(st.integers(0, 260), st.floats(0, 1))
EDIT = st.one_of(
    st.tuples(st.just("flip"), _PLACE, st.integers(0, 7)),
    st.tuples(st.just("put"), _PLACE, st.one_of(st.sampled_from(_EXTREMES), st.binary(min_size=1, max_size=8))),
    st.tuples(st.just("insert"), _PLACE, st.binary(min_size=1, max_size=8)),
    st.tuples(st.just("remove"), _PLACE, st.integers(1, 64)),
    st.tuples(st.just("cut"), _PLACE, st.none()),
)


def damaged(content: bytes, edits: list[tuple[str, float, object]]) -> bytes:
    for kind, place, what in edits:
        at = min(place if isinstance(place, int) else int(place * len(content)), max(0, len(content) - 1))
        head, rest = content[:at], content[at:]
        if kind == "flip" and rest:
            rest = bytes([rest[0] ^ (1 << what)]) + rest[1:]
        elif kind == "put":
            rest = what + rest[len(what) :]
        elif kind == "insert":
            rest = what + rest
        elif kind == "remove":
            rest = rest[what:]
        elif kind == "cut":
            rest = b""
        content = head + rest
    return content


@pytest.fixture(scope="module")
def originals(tmp_path_factory):
    """The valid content of a file of each format, written when it is first asked for."""
    folder, contents = tmp_path_factory.mktemp("valid"), {}

    def content(name: str) -> bytes:
        if name not in contents:
            WRITERS[name](folder / name)
            contents[name] = (folder / name).read_bytes()
        return contents[name]

    return content


def outcome(read: Callable[..., Recording], path: Path) -> Recording | Exception:
    """Return what comes of a file: a recording, or an exception of the kinds that readers may raise."""
    try:
        return read(path, file_fs=FS if path.name in ("x.npy", "x.csv") else None)
    except (ValueError, OSError) as error:
        return error


def check(result: Recording | Exception, path: Path) -> bool:
    """Check a recording or a message; return whether it is a recording."""
    if isinstance(result, Exception):
        assert path.stem in str(result)
        return False
    assert result.samples.size > 0
    assert np.all(np.isfinite(result.samples))
    assert result.samples.dtype == np.float64
    assert result.samples.nbytes <= room_of(path)
    assert 0 < result.fs < np.inf
    assert repr(result)
    return True


@pytest.mark.parametrize("name", WRITERS)
def test_damaged_files_are_read_or_refused_with_a_message(name, originals, tmp_path_factory):
    if name == "new.mat":
        pytest.importorskip("h5py")
    path = tmp_path_factory.mktemp("damaged") / name
    outcomes = []

    in_a_process = name.endswith(".mat")

    @settings(max_examples=EXAMPLES // 6 if in_a_process else EXAMPLES, deadline=None)
    @given(st.lists(EDIT, min_size=1, max_size=4))
    def search(edits):
        path.write_bytes(damaged(originals(name), edits))
        outcomes.extend(check(outcome(read, path), path) for read in (read_recording, read_path))

    search()
    assert not all(outcomes)  # some damage was found


@pytest.mark.parametrize(
    ("name", "at", "what"),
    [
        ("plain.mat", b"fs\0\0\x09", b"fs\0\0\x00"),  # numbers of type 0
        # Complex, without an imaginary part.
        ("plain.mat", b"\x06\0\0\0\x08\0\0\0\x06\0", b"\x06\0\0\0\x08\0\0\0\x06\x08"),
        # In a struct: text without dimensions, numbers of type 0; and a struct that claims 2^31 elements.
        ("struct.mat", b"\x04\0\0\0\0\0\0\0\x05\0\0\0", b"\x04\0\0\0\0\0\0\0\x05\0\x01\0"),
        ("struct.mat", b"\x09\0\0\0\x08\0\0\0\0\0\0\0\0\x40\xcf", b"\0\0\0\0\x08\0\0\0\0\0\0\0\0\x40\xcf"),
        (
            "struct.mat",
            b"\x02\0\0\0\0\0\0\0\x05\0\0\0\x08\0\0\0\x01\0\0\0\x01\0\0\0",
            b"\x02\0\0\0\0\0\0\0\x05\0\0\0\x08\0\0\0\0\x80\0\0\0\0\1\0",
        ),
    ],
)
def test_what_the_search_found_to_end_the_process_within_scipy_is_refused(name, at, what, tmp_path):
    path = tmp_path / name
    WRITERS[name](path)
    content = path.read_bytes()
    assert at in content
    path.write_bytes(content.replace(at, what, 1))
    with pytest.raises(ValueError, match=rf"{name} (is damaged|cannot be read|would take more memory|.* must hold)"):
        read_recording(path)


# ---- memory: what comes of a small file is bounded, whatever it claims


class Memory:
    """The most bytes that Python and numpy held within a `with` block, beyond what they held before."""

    def __enter__(self) -> Self:
        gc.collect()
        tracemalloc.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()


def _new_mat(path: Path, *arguments: Any, **settings: Any) -> Any:
    """Write a file of MATLAB 7.3 with one compressed variable; return its open file and the variable."""
    h5py = pytest.importorskip("h5py")
    WRITERS["new.mat"](path)
    file = h5py.File(path, "a")
    del file["noise"]
    noise = file.create_dataset("noise", *arguments, compression="gzip", **settings)
    noise.attrs["MATLAB_class"] = np.bytes_("double")
    return file, noise


def _claims(path: Path, name: str) -> None:
    """Write a small file of a format that claims, or unpacks to, 160 MB and more."""
    large = 20_000_000
    if name == "x.flac":
        WRITERS["x.flac"](path)
        content = bytearray(path.read_bytes())
        content[22:26] = (2**31).to_bytes(4, "big")  # STREAMINFO's number of samples
        path.write_bytes(content)
    elif name == "silence.flac":
        soundfile.write(path, np.zeros(large, dtype=np.int16), FS, subtype="PCM_16")
    elif name == "packed.mat":
        scipy.io.savemat(path, {"noise": np.zeros(large)}, do_compression=True)
    elif name == "x.npz":
        np.savez_compressed(path, noise=np.zeros(large))
    elif name == "header.npz":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("noise.npy", b"\x93NUMPY\x02\x00" + (8 * large).to_bytes(4, "little") + bytes(8 * large))
    elif name == "x.npy":
        with open(path, "wb") as file:
            np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    elif name == "new.mat":
        _new_mat(path, (1, 10**11), "f8", chunks=(1, 10**5))[0].close()
    elif name == "chunks.mat":
        _new_mat(path, (1, 500_000), "f8", chunks=(1, 1))[0].close()
    elif name == "inflated.mat":  # a chunk that says it has 300 numbers and unpacks to 160 MB
        file, noise = _new_mat(path, (1, 300), "f8", chunks=(1, 300))
        noise.id.write_direct_chunk((0, 0), zlib.compress(bytes(160_000_000)))
        file.close()
    elif name == "cells.mat":
        _cells(path)
    elif name == "rew.txt":
        path.write_text(rew_text(np.ones(3), start_s=1e6))


def _cells(path: Path) -> None:
    """Write a cell of empty elements of eight bytes, each of which takes a hundred and more in memory."""
    count = 300_000
    head = struct.pack("<2I2I 2I2I 2H4s", 6, 8, 1, 0, 5, 8, count, 1, 1, 1, b"c")
    body = struct.pack("<2I", 14, len(head) + 8 * count) + head + struct.pack("<2I", 14, 0) * count
    WRITERS["plain.mat"](path)
    packed = zlib.compress(body)
    path.write_bytes(path.read_bytes()[:128] + struct.pack("<2I", 15, len(packed)) + packed)


CLAIMS = {
    "x.flac": "claims .* samples: what takes more than 64 MiB and 100 times the file",
    "silence.flac": "claims 2e\\+07 samples",
    "packed.mat": "would take more memory than a file of its size may|claims 2e\\+07 samples",
    "cells.mat": "no array of real numbers",
    "x.npz": "claims 2e\\+07 samples",
    "header.npz": "claims 2e\\+07 samples",
    "x.npy": "claims 1e\\+12 samples",
    "new.mat": "claims 1e\\+11 samples",
    "chunks.mat": "its 500000 chunks take as much memory as 2.56e\\+08 samples",
    "inflated.mat": "is damaged: a chunk is larger than its 2400 bytes",
    "rew.txt": "with its start time it has 1.6e\\+10 samples",
}


@pytest.mark.parametrize("name", CLAIMS)
def test_a_file_that_claims_far_more_than_it_has_is_refused_before_it_takes_the_memory(name, tmp_path):
    _claims(tmp_path / name, name)
    assert (tmp_path / name).stat().st_size < 2_000_000
    with Memory() as memory, pytest.raises(ValueError, match=CLAIMS[name]):
        read_path(tmp_path / name)
    assert memory.peak < 2.1 * room_of(tmp_path / name)


READ = """
import resource, sys
from kfopc_filterpy.paths import read_path
try:
    read_path(sys.argv[1], fs=8000)
except ValueError as error:
    print(error)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited and measured on Linux only")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        pytest.param("size", "its library ended .* or took longer than 10 s", marks=pytest.mark.slow),
        ("length", "memory allocation failed"),
    ],
)
def test_what_leads_libhdf5_astray_ends_in_time_and_within_the_memory(change, message, tmp_path):
    """The size of an object in the global heap becomes 0, which is a loop; the length of an attribute, which is 4.1 GB."""
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "x.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        file["S"] = np.ones((1, 64))
        file["S"].attrs["MATLAB_class"] = "double"  # as a text of any length, in the heap
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    assert read_path(path, fs=FS).samples.size == 64
    content = bytearray(path.read_bytes())
    heap = content.index(b"GCOL")
    if change == "size":
        content[heap + 24] = 0
    else:
        reference = content.index((heap - 512).to_bytes(8, "little"))  # addresses begin after MATLAB's bytes
        content[reference - 4 : reference] = b"\x00\x00\x00\xf4"
    path.write_bytes(content)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", READ, path], env=environment, capture_output=True, text=True)
    assert re.search(message, done.stdout), done
    seconds, megabytes = map(float, done.stdout.split()[-2:])
    assert seconds < 20  # of a processor: 10 s, and what Python needs to start
    assert megabytes < 150 + 3 * 64  # what Python, numpy and h5py take, and three times the room of the file


def test_reading_runs_no_module_of_the_current_folder(tmp_path, monkeypatch):
    WRITERS["packed.mat"](tmp_path / "packed.mat")
    (tmp_path / "json.py").write_text("open('ran', 'w')\nfrom sys import exit\nexit()\n")
    monkeypatch.chdir(tmp_path)
    assert read_path(tmp_path / "packed.mat").samples.size
    assert not (tmp_path / "ran").exists()


def test_a_sampling_rate_that_is_none_is_refused(tmp_path):
    np.savez(tmp_path / "x.npz", noise=signal(), fs=1e-310)
    with pytest.raises(ValueError, match=r"rate that .*x\.npz states must be a sampling rate from"):
        read_path(tmp_path / "x.npz", fs=FS)


def test_resampling_to_any_rate_takes_no_more_than_the_room(tmp_path):
    soundfile.write(tmp_path / "x.wav", np.eye(200)[100], FS)
    for reader in (read_path, read_recording):
        reader(tmp_path / "x.wav", fs=FS // 2)
        with Memory() as memory, pytest.raises(ValueError, match="ratio of whole numbers up to 50000"):
            reader(tmp_path / "x.wav", fs=99_999_999)
        assert memory.peak < 1e6


@pytest.mark.parametrize("name", ["x.flac", "packed.mat"])
def test_what_is_compressed_as_far_as_it_may_be_takes_no_more_than_three_times_its_room(name, tmp_path):
    samples = np.zeros((2, 4_000_000), dtype=np.int16)
    if name == "x.flac":
        soundfile.write(tmp_path / name, samples.T, FS)
    else:
        scipy.io.savemat(tmp_path / name, {"noise": samples.astype(float)}, do_compression=True)
    with Memory() as memory:
        assert read_path(tmp_path / name, fs=FS).samples.shape == (2, 4_000_000)
    assert samples.size * 8 < memory.peak < 3 * room_of(tmp_path / name)


MULTIPLE = 32  # docs/formats.md states it, of what is not compressed


def test_the_worst_of_what_is_not_compressed_takes_no_more_than_the_stated_multiple(tmp_path):
    soundfile.write(tmp_path / "x.wav", signal(2, 60_000).T, FS, subtype="PCM_U8")
    (tmp_path / "x.txt").write_text("1 " * 60_000)
    for name, stated in (("x.wav", 16), ("x.txt", 25)):
        read_path(tmp_path / name, fs=FS)
        with Memory() as memory:
            assert read_path(tmp_path / name, fs=FS).samples.shape[-1] >= 60_000
        size = (tmp_path / name).stat().st_size
        assert memory.peak == pytest.approx(stated * size, rel=0.15)
        assert memory.peak <= MULTIPLE * size


def test_a_file_of_very_many_variables_is_refused_at_once(tmp_path):
    """Each would be compared with each, which took a minute for 8000."""
    np.savez(tmp_path / "x.npz", **{f"v{n}": np.zeros(2) for n in range(1001)})
    with pytest.raises(ValueError, match="holds 1001 variables, at most 1000 are read"):
        read_recording(tmp_path / "x.npz", file_fs=FS)
    np.savez(tmp_path / "x.npz", **{f"v{n}": np.zeros(2) for n in range(1000)})
    with pytest.raises(ValueError, match="and 980 more; choose one") as refused:
        read_recording(tmp_path / "x.npz", file_fs=FS)
    assert len(str(refused.value)) < 1000


def test_text_that_ends_within_a_number_is_refused(tmp_path):
    lines = [f"{abs(value):.9f}" for value in signal(1, 200)]
    for cut in (1, 5, 9):
        (tmp_path / "x.txt").write_text("\n".join(lines)[:-cut])
        with pytest.raises(ValueError, match="ends within a line"):
            read_recording(tmp_path / "x.txt", file_fs=FS)
    for end in ("", "\n"):
        (tmp_path / "x.txt").write_text("\n".join(lines) + end)
        assert read_recording(tmp_path / "x.txt", file_fs=FS).samples.size == 200


def test_a_number_behind_a_hash_is_no_comment(tmp_path):
    (tmp_path / "x.txt").write_text("1.5\n2.5\n#3\n4.5\n")
    with pytest.raises(ValueError, match="'#3' among its numbers"):
        read_recording(tmp_path / "x.txt", file_fs=FS)
    (tmp_path / "x.txt").write_text("1.5\n2.5\n# a door\n4.5\n")
    assert read_recording(tmp_path / "x.txt", file_fs=FS).samples.tolist() == [1.5, 2.5, 4.5]
