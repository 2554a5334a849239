"""The measured room of four loudspeakers and microphones; no test reaches for the network."""

import numpy as np
import pytest
import scipy.io
from helpers.network import publish, serving

from kfopc_filterpy.signals import DataUnavailableError, MeasuredRoom, datasets, load_measured_room

EACH = range(1, 5)
NAMES = [f"P{k}" for k in EACH] + [f"S{k}{j}" for k in EACH for j in EACH]
SOURCE = "ShiDongyuan/Meta/dd99aaa351c397090ab7efc03f02a84b669cf302/path"
HOST = "https://raw.githubusercontent.com"


@pytest.fixture
def own_files(tmp_path, monkeypatch, data_folder):
    """A folder of small files in the published layout, which counts as the published one: S{k}{j} holds k and j."""
    data_folder(None)
    (tmp_path / "room4x4").mkdir()
    for name in NAMES:
        path = tmp_path / "room4x4" / f"{name}.mat"
        scipy.io.savemat(path, {name: np.array([[float(digit)] for digit in name[1:]])})
    publish(tmp_path, monkeypatch)
    return tmp_path


def test_published_room_has_its_known_contents(shared_data):
    if not (shared_data / "room4x4").is_dir():
        pytest.skip(f"no measured room: {shared_data} has no folder room4x4")
    room = load_measured_room(shared_data)
    assert (room.primary.shape, room.secondary.shape, room.fs) == ((4, 1, 256), (4, 4, 256), 16000)
    expected = scipy.io.loadmat(shared_data / "room4x4" / "S23.mat")["S23"][:, 0]
    np.testing.assert_array_equal(room.secondary[1, 2], expected)
    np.testing.assert_array_equal(room.primary[3, 0], scipy.io.loadmat(shared_data / "room4x4" / "P4.mat")["P4"][:, 0])
    # The noise arrives 30 samples in, after every loudspeaker's sound: control is causal.
    onset = np.argmax(
        np.cumsum(room.secondary**2, axis=2) > 0.01 * np.sum(room.secondary**2, axis=2)[..., None], axis=2
    )
    assert 8 <= onset.min() < onset.max() <= 14


def test_first_index_is_the_microphone_and_second_the_loudspeaker(own_files):
    room = load_measured_room(own_files)
    for k in EACH:
        assert room.primary[k - 1, 0].tolist() == [k]
        for j in EACH:
            assert room.secondary[k - 1, j - 1].tolist() == [k, j]


def test_room_is_found_through_the_environment(own_files, data_folder):
    with pytest.raises(DataUnavailableError, match=r"P1\.mat is missing: put .* or name another folder"):
        load_measured_room()
    data_folder(own_files)
    assert load_measured_room().secondary.shape == (4, 4, 2)
    (own_files / "room4x4" / "S41.mat").unlink()
    with pytest.raises(DataUnavailableError, match=rf"S41\.mat is missing: put {HOST}/{SOURCE}/S41\.mat there"):
        load_measured_room()


def test_download_asks_once_for_each_file_of_the_room(own_files, monkeypatch):
    with serving(own_files, monkeypatch) as source:
        for _ in range(2):
            assert load_measured_room(allow_download=True).secondary[3, 1].tolist() == [4, 2]
    assert source.asked == [f"/{SOURCE}/{name}.mat" for name in NAMES]


def test_the_room_has_a_file_for_each_path():
    files = datasets.named_dataset("room").files
    assert [(file.variable, file.name) for file in files] == [(name, f"room4x4/{name}.mat") for name in NAMES]
    assert [file.url for file in files] == [f"{HOST}/{SOURCE}/{name}.mat" for name in NAMES]


def test_measured_room_of_own_paths_is_checked():
    room = MeasuredRoom(np.ones((2, 1, 3), dtype=int), np.ones((2, 2, 3)), fs=8000)
    assert room.primary.dtype == np.float64
    with pytest.raises(AttributeError):
        room.fs = 1
    good = np.ones((2, 2, 3))
    for primary, secondary, fs, message in (
        (good, good[0], 1, r"secondary must have shape \(K microphones, inputs, taps\), got \(2, 3\)"),
        (good[:1], good, 1, "must have the same K microphones as their first axis, got 1 and 2"),
        (good * np.nan, good, 1, "primary must be finite"),
        (good, good, 0, "fs must be greater than 0"),
    ):
        with pytest.raises(ValueError, match=message):
            MeasuredRoom(primary, secondary, fs=fs)
