"""Damaged files of every format: each is read, or refused with a message; nothing else comes out, and no warning."""

from __future__ import annotations

import os
import tracemalloc
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from helpers.files import FS, WRITERS
from hypothesis import given, settings
from hypothesis import strategies as st

from kfopc_filterpy.paths import read_path
from kfopc_filterpy.signals import Recording, read_recording
from kfopc_filterpy.signals.content import room_of

# For a longer search: `FUZZ_EXAMPLES=20000 pytest tests/signals/test_damaged_files.py --hypothesis-profile default`.
EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "60"))
LIBRARIES = {".uff": "pyuff", ".sofa": "sofar", "new.mat": "h5py"}

# An edit: what it does, where (share of the file, or byte of its head), and with what.
_EXTREMES = [bytes(4), b"\xff" * 4, b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\x01\x00\x00\x00", b"-1e9", b"nan ", b" 9999 "]
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


def check_outcome(path: Path) -> bool:
    """Read a file as a recording and as a path; return whether one came out."""
    came = False
    for read in (read_recording, read_path):
        try:
            recording = read(path, file_fs=None if path.stem != "x" or path.suffix not in (".npy", ".csv") else FS)
        except (ValueError, OSError) as error:
            assert path.stem in str(error), error
            continue
        came = True
        assert isinstance(recording, Recording)
        assert recording.samples.size > 0
        assert np.all(np.isfinite(recording.samples))
        assert recording.samples.dtype == np.float64
        assert recording.samples.nbytes <= room_of(path)
        assert 0 < recording.fs < np.inf
        assert repr(recording)
    return came


@pytest.mark.parametrize("name", WRITERS)
def test_damaged_files_are_read_or_refused_with_a_message(name, originals, tmp_path_factory):
    library = next((library for end, library in LIBRARIES.items() if name.endswith(end)), "numpy")
    if find_spec(library) is None:
        pytest.skip(f"needs {library} (the extra `test`)")
    path = tmp_path_factory.mktemp("damaged") / name
    outcomes = []

    @settings(max_examples=EXAMPLES)
    @given(st.lists(EDIT, min_size=1, max_size=4))
    def search(edits):
        path.write_bytes(damaged(originals(name), edits))
        outcomes.append(check_outcome(path))

    search()
    assert not all(outcomes)  # some damage was found
