"""Damaged files of every format: each is read, or refused with a message; nothing else comes out, and no warning."""

from __future__ import annotations

import os
import tracemalloc
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import process_time

import numpy as np
import pytest
import scipy.io
import soundfile
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
REMOVED = st.one_of(st.integers(0, 8), st.sampled_from([64, 2**40]))  # the last is all that is left
PUT = st.one_of(st.sampled_from(_EXTREMES), st.binary(max_size=8))


def damaged(content: bytes, edits: list[tuple[float, int, bytes]]) -> bytes:
    """Return a content in which, at each place, some bytes were removed and others put."""
    for place, removed, put in edits:
        at = min(place if isinstance(place, int) else int(place * len(content)), len(content))
        content = content[:at] + put + content[at + removed :]
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


# Not those of MATLAB: a changed byte may end the process within scipy, or let libhdf5 loop.
@pytest.mark.parametrize("name", [name for name in WRITERS if not name.endswith(".mat")])
def test_damaged_files_are_read_or_refused_with_a_message(name, tmp_path):
    path, outcomes = tmp_path / name, []
    WRITERS[name](path)
    original = path.read_bytes()

    @settings(max_examples=EXAMPLES, deadline=None)
    @given(st.lists(st.tuples(_PLACE, REMOVED, PUT), min_size=1, max_size=4))
    def search(edits):
        path.write_bytes(damaged(original, edits))
        outcomes.extend(check(outcome(read, path), path) for read in (read_recording, read_path))

    search()
    assert not all(outcomes)  # some damage was found


@pytest.mark.parametrize("name", [name for name in WRITERS if name.endswith(".mat")])
def test_a_matlab_file_that_is_cut_anywhere_is_read_or_refused_with_a_message(name, tmp_path):
    path = tmp_path / name
    WRITERS[name](path)
    original = path.read_bytes()
    for length in range(1, len(original), 29):
        path.write_bytes(original[:length])
        check(outcome(read_recording, path), path)


# ---- memory: what comes of a small file is bounded, whatever it claims


@contextmanager
def memory_below(n_bytes: float) -> Iterator[None]:
    """Check the most bytes that Python and numpy hold within the block, beyond what they held before."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < n_bytes
    finally:
        tracemalloc.stop()


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
    elif name == "negative.npy":
        with open(path, "wb") as file:
            np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (-1,)})
            file.write(bytes(80))
    elif name == "new.mat":
        WRITERS["new.mat"](path)
        with pytest.importorskip("h5py").File(path, "a") as file:
            del file["noise"]
            noise = file.create_dataset("noise", (1, 10**11), "f8", chunks=(1, 10**5), compression="gzip")
            noise.attrs["MATLAB_class"] = np.bytes_("double")
    elif name == "struct.mat":
        scipy.io.savemat(path, {"meas": {"noise": np.zeros(large)}}, do_compression=True)
    elif name == "rew.txt":
        path.write_text(rew_text(np.ones(3), start_s=1e6))


CLAIMS = {
    "x.flac": "claims .* samples: what takes more than 64 MiB and 100 times the file",
    "silence.flac": "claims 2e\\+07 samples",
    "packed.mat": r"claims 8\.389e\+06 samples",  # so many were unpacked
    "struct.mat": r"claims 8\.389e\+06 samples",
    "x.npz": "claims 2e\\+07 samples",
    "header.npz": "claims 2e\\+07 samples",
    "x.npy": "claims 1e\\+12 samples",
    "negative.npy": r"claims the shape \(-1,\)",
    "new.mat": "claims 1e\\+11 samples",
    "rew.txt": "with its start time it has 1.6e\\+10 samples",
}


@pytest.mark.parametrize("name", CLAIMS)
def test_a_file_that_claims_far_more_than_it_has_is_refused_before_it_takes_the_memory(name, tmp_path):
    _claims(tmp_path / name, name)
    assert (tmp_path / name).stat().st_size < 2_000_000
    with memory_below(2.1 * room_of(tmp_path / name)), pytest.raises(ValueError, match=CLAIMS[name]):
        read_path(tmp_path / name)


def test_a_sampling_rate_that_is_none_is_refused(tmp_path):
    np.savez(tmp_path / "x.npz", noise=signal(), fs=1e-310)
    with pytest.raises(ValueError, match=r"rate that .*x\.npz states must be a sampling rate from"):
        read_path(tmp_path / "x.npz", fs=FS)


def test_resampling_to_any_rate_takes_no_more_than_the_room(tmp_path):
    soundfile.write(tmp_path / "x.wav", np.eye(200)[100], FS)
    for reader in (read_path, read_recording):
        reader(tmp_path / "x.wav", fs=FS // 2)
        with memory_below(1e6), pytest.raises(ValueError, match="ratio of whole numbers up to 50000"):
            reader(tmp_path / "x.wav", fs=99_999_999)


@pytest.mark.parametrize("name", ["x.flac", "packed.mat"])
def test_what_is_compressed_as_far_as_it_may_be_takes_no_more_than_three_times_its_room(name, tmp_path):
    samples = np.zeros((2, 4_000_000), dtype=np.int16)
    if name == "x.flac":
        soundfile.write(tmp_path / name, samples.T, FS)
    else:
        scipy.io.savemat(tmp_path / name, {"noise": samples.astype(float)}, do_compression=True)
    with memory_below(3 * room_of(tmp_path / name)):
        assert read_path(tmp_path / name, fs=FS).samples.shape == (2, 4_000_000)


def test_what_is_not_compressed_takes_no_more_than_the_stated_multiple(tmp_path):
    soundfile.write(tmp_path / "x.wav", signal(2, 60_000).T, FS, subtype="PCM_U8")
    (tmp_path / "x.txt").write_text("1 " * 60_000)
    for name in ("x.wav", "x.txt"):
        with memory_below(32 * (tmp_path / name).stat().st_size):  # docs/formats.md states it
            assert read_path(tmp_path / name, fs=FS).samples.shape[-1] >= 60_000


def test_a_file_of_very_many_variables_is_refused_at_once(tmp_path):
    """Each would be compared with each, which took a minute for 8000."""
    np.savez(tmp_path / "x.npz", **{f"v{n}": np.zeros(2) for n in range(1001)})
    with pytest.raises(ValueError, match="holds 1001 variables, at most 1000 are read"):
        read_recording(tmp_path / "x.npz", file_fs=FS)
    scipy.io.savemat(tmp_path / "x.mat", {f"s{n}": {"field": 0.0} for n in range(1001)})
    with pytest.raises(ValueError, match="holds 1001 variables, at most 1000 are read"):  # before their fields are
        read_recording(tmp_path / "x.mat", file_fs=FS)
    np.savez(tmp_path / "x.npz", **{f"v{n}": np.zeros(2) for n in range(1000)})
    with pytest.raises(ValueError, match="and 980 more; choose one") as refused:
        read_recording(tmp_path / "x.npz", file_fs=FS)
    assert len(str(refused.value)) < 1000


BLANKS = 100_000 * " "


@pytest.mark.parametrize(
    "line", ["1" + 100_000 * "\t" + "x", f"{BLANKS}x", f'"{BLANKS}', f"(Pa{BLANKS}x", "0.1" * 100_000]
)
@pytest.mark.parametrize("rest", ["0 1\n1 2\n2 4\n", "0.5\n1.5\n", "no numbers\n"])
def test_a_long_line_takes_a_time_that_grows_with_it_alone(line, rest, tmp_path):
    """Patterns that try each end of a stretch for each beginning took minutes, where 0.1 s are enough."""
    path = tmp_path / "x.txt"
    path.write_text(f"{line}\n{rest}")
    began = process_time()
    check(outcome(read_recording, path), path)
    assert process_time() - began < 5.0
