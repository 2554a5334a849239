"""Measured duct and room, and fetching of measured data from a server on this machine; no test reaches beyond it."""

import hashlib
import socket
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from helpers.network import publish, serving

from kfopc_filterpy.signals import (
    DataUnavailableError,
    MeasuredDuct,
    MeasuredRoom,
    dataset_folder,
    fetch_dataset,
    has_dataset,
    list_datasets,
    load_measured_duct,
    load_measured_room,
)

FILES = {
    "duct/Pz1.mat": "Pz1",
    "duct/Sz.mat": "S",
    "motor/Motor.mat": "Motor_noise",
    "compressor/compressor_16kHz.mat": "yr",
}
EACH = range(1, 5)
ROOM = [f"P{k}" for k in EACH] + [f"S{k}{j}" for k in EACH for j in EACH]  # of microphone k and loudspeaker j


@pytest.fixture
def own_files(tmp_path, monkeypatch):
    """A folder of small files in the published layout, which counts as the published one: S{k}{j} holds k and j."""
    contents = {name: (variable, [1.0, 2.0, 3.0]) for name, variable in FILES.items()}
    contents |= {f"room4x4/{name}.mat": (name, [float(digit) for digit in name[1:]]) for name in ROOM}
    for name, (variable, values) in contents.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        scipy.io.savemat(tmp_path / name, {variable: np.array(values)[:, None]})
    publish(tmp_path, monkeypatch)
    return tmp_path


@pytest.fixture
def source(own_files, monkeypatch):
    """A server of `own_files`; pooch's cache is a new folder."""
    with serving(own_files, monkeypatch) as source:
        yield source


# ---- the measured duct


def test_published_duct_has_its_known_contents(shared_data):
    duct = load_measured_duct(shared_data)
    assert (duct.primary.shape, duct.secondary.shape, duct.noise.shape) == ((1024,), (512,), (162001,))
    assert duct.fs == 16000
    expected = scipy.io.loadmat(shared_data / "duct" / "Sz.mat")["S"][:, 0]
    np.testing.assert_array_equal(duct.secondary, expected)
    # The secondary path gains 10 to 30 dB in the middle of 200 to 2000 Hz.
    gain_db = 20 * np.log10(np.abs(np.fft.rfft(duct.secondary, 4096)))[52:513]
    assert 10 < np.median(gain_db) < 30


def test_published_compressor_has_its_known_contents(shared_data):
    duct = load_measured_duct(shared_data, noise="compressor")
    expected = scipy.io.loadmat(shared_data / "compressor" / "compressor_16kHz.mat")
    np.testing.assert_array_equal(duct.noise, expected["yr"][:, 0])
    np.testing.assert_allclose(np.diff(expected["tr"][:, 0]), 1 / duct.fs, rtol=1e-6)


def test_published_room_has_its_known_contents(shared_data):
    if not (shared_data / "room4x4").is_dir():
        pytest.skip(f"no measured room: {shared_data} has no folder room4x4")
    room = load_measured_room(shared_data)
    assert (room.primary.shape, room.secondary.shape, room.fs) == ((4, 1, 256), (4, 4, 256), 16000)
    for name, path in (("S23", room.secondary[1, 2]), ("P4", room.primary[3, 0])):
        np.testing.assert_array_equal(path, scipy.io.loadmat(shared_data / "room4x4" / f"{name}.mat")[name][:, 0])
    # The noise arrives 30 samples in, after every loudspeaker's sound: control is causal.
    share = np.cumsum(room.secondary**2, axis=2) / np.sum(room.secondary**2, axis=2)[..., None]
    onset = np.argmax(share > 0.01, axis=2)
    assert 8 <= onset.min() < onset.max() <= 14


def test_first_index_of_the_room_is_the_microphone_and_second_the_loudspeaker(own_files):
    room = load_measured_room(own_files)
    assert room.primary.tolist() == [[[k]] for k in EACH]
    assert room.secondary.tolist() == [[[k, j] for j in EACH] for k in EACH]
    (own_files / "room4x4" / "S41.mat").unlink()
    with pytest.raises(DataUnavailableError, match=r"S41\.mat is missing: put https://.*/S41\.mat there"):
        load_measured_room(own_files)


@pytest.mark.parametrize(
    ("noise", "other"), [("motor", "compressor/compressor_16kHz.mat"), ("compressor", "motor/Motor.mat")]
)
def test_only_the_noise_that_is_asked_for_is_needed(own_files, noise, other):
    (own_files / other).unlink()
    assert load_measured_duct(own_files, noise=noise).noise.tolist() == [1.0, 2.0, 3.0]
    (wanted,) = {"motor", "compressor"} - {noise}
    with pytest.raises(DataUnavailableError, match=f"{Path(other).name} is missing: put https"):
        load_measured_duct(own_files, noise=wanted)
    with pytest.raises(ValueError, match="noise must be one of 'motor', 'compressor', got 'fan'"):
        load_measured_duct(own_files, noise="fan")


@pytest.mark.parametrize("load", [load_measured_duct, load_measured_room])
def test_folder_argument_comes_before_the_environment(load, own_files, data_folder, tmp_path):
    data_folder(tmp_path / "elsewhere")
    expected = load(own_files).primary
    with pytest.raises(DataUnavailableError, match=r"elsewhere.*\.mat is missing: put https"):
        load()
    data_folder(own_files)
    np.testing.assert_array_equal(load().primary, expected)


@pytest.mark.parametrize("load", [load_measured_duct, load_measured_room])
def test_an_empty_environment_variable_names_no_folder(load, source, data_folder, tmp_path):
    data_folder("")
    with pytest.raises(
        DataUnavailableError,
        match=r"\.mat is missing: put .* or name another folder .*; without a folder, allow_download=True",
    ):
        load()
    assert source.asked == []
    assert dataset_folder() == tmp_path / "cache" / "kfopc_filterpy"


def test_without_folder_or_permission_the_error_names_every_way(data_folder, uninstall):
    data_folder(None)
    uninstall("pooch")
    with pytest.raises(DataUnavailableError, match=r"pooch is not installed.*or set KFOPC_DATA to a folder") as told:
        load_measured_duct()
    assert isinstance(told.value, FileNotFoundError)


def test_download_asks_once_for_each_pinned_file_and_keeps_it(source):
    pinned = {dataset.name: ["/" + file.url.split("/", 3)[3] for file in dataset.files] for dataset in list_datasets()}
    for _ in range(2):
        assert load_measured_duct(allow_download=True, timeout_s=2.5).secondary.tolist() == [1.0, 2.0, 3.0]
    assert source.asked == pinned["duct"] + pinned["motor"]
    assert load_measured_duct().primary.tolist() == [1.0, 2.0, 3.0]  # what is in the cache needs no permission
    load_measured_duct(noise="compressor", allow_download=True)
    assert load_measured_room(allow_download=True).secondary[3, 1].tolist() == [4, 2]
    assert source.asked == pinned["duct"] + pinned["motor"] + pinned["compressor"] + pinned["room"]


def test_a_folder_comes_before_a_download(source, own_files, data_folder):
    data_folder(own_files)
    load_measured_duct(allow_download=True)
    (own_files / "duct" / "Sz.mat").unlink()
    with pytest.raises(DataUnavailableError, match=r"Sz\.mat is missing"):
        load_measured_duct(allow_download=True)
    assert source.asked == []


# ---- fetching


def left_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob("*") if path.is_file())


def test_a_dataset_is_fetched_once_to_the_folder_of_the_environment(source, data_folder, tmp_path):
    folder = tmp_path / "measured"
    data_folder(folder)
    assert not has_dataset("duct")
    assert fetch_dataset("duct") == dataset_folder() == folder
    assert has_dataset("duct")
    assert not has_dataset("duct", tmp_path / "other")
    assert left_in(folder) == ["Pz1.mat", "Sz.mat"]
    assert (folder / "duct" / "Sz.mat").read_bytes() == (tmp_path / "duct" / "Sz.mat").read_bytes()
    (folder / "duct" / "Pz1.mat").unlink()
    fetch_dataset("duct")
    assert [path.rsplit("/", 1)[1] for path in source.asked] == ["Pz1.mat", "Sz.mat", "Pz1.mat"]
    other = tmp_path / "other"
    assert fetch_dataset("motor", other) == other
    assert left_in(other) == ["Motor.mat"]


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ("changed", r"SHA256 hash .* does not match"),
        ("cut", r"IncompleteRead|Connection broken"),
        ("cut_of_unknown_length", r"SHA256 hash .* does not match"),
        ("missing", r"404 Client Error"),
        ("silent", r"[Rr]ead timed out"),
    ],
)
def test_a_fetch_that_fails_ends_at_the_first_file_and_leaves_nothing(source, fault, reason):
    source.fault = fault
    message = rf"(?s)http://127.*Pz1\.mat could not be fetched \(.*({reason}).*\): set KFOPC_DATA to a folder"
    with pytest.raises(DataUnavailableError, match=message):
        fetch_dataset("duct", timeout_s=0.3 if fault == "silent" else 5.0)
    assert len(source.asked) == 1
    assert left_in(dataset_folder()) == []
    source.fault = "whole"
    assert left_in(fetch_dataset("duct")) == ["Pz1.mat", "Sz.mat"]


def test_without_a_network_what_is_fetched_is_read_and_the_rest_refused(source, own_files, monkeypatch):
    fetch_dataset("duct")
    with socket.socket() as closed:  # a port at which nothing listens
        closed.bind(("127.0.0.1", 0))
        publish_at = f"http://127.0.0.1:{closed.getsockname()[1]}"
    publish(own_files, monkeypatch, host=publish_at)
    assert fetch_dataset("duct") == dataset_folder()
    with pytest.raises(DataUnavailableError, match=r"(?s)Motor\.mat could not be fetched \(.*refused"):
        fetch_dataset("motor")
    assert len(source.asked) == 2


def test_a_file_that_differs_is_refused_with_its_hash_and_not_overwritten(source, own_files):
    path = own_files / "duct" / "Pz1.mat"
    path.write_bytes(b"measured by the user")
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    with pytest.raises(DataUnavailableError, match=rf"Pz1\.mat is not the published file, its SHA-256 is {found}"):
        load_measured_duct(own_files)
    with pytest.raises(DataUnavailableError, match=r"Pz1\.mat is not the published file.*delete it and fetch it again"):
        fetch_dataset("duct", own_files)
    assert path.read_bytes() == b"measured by the user"
    assert source.asked == []


def test_a_folder_that_cannot_be_written_is_refused(source, tmp_path):
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(DataUnavailableError, match=r"could not be fetched \(.*taken"):
        fetch_dataset("duct", tmp_path / "taken")


def test_download_without_pooch_says_what_to_install(data_folder, uninstall):
    data_folder(None)
    uninstall("pooch")
    for call in (lambda: load_measured_duct(allow_download=True), lambda: fetch_dataset("duct"), dataset_folder):
        with pytest.raises(DataUnavailableError, match=r"pooch is not installed.*pip install -e .\.\[studies\]."):
            call()


def test_every_dataset_states_where_it_comes_from():
    assert [dataset.name for dataset in list_datasets()] == ["duct", "motor", "compressor", "room"]
    for dataset in list_datasets():
        assert (dataset.fs, dataset.licence) == (16000.0, "none stated")
        assert dataset.units
        assert len(dataset.commit) == 40
        for file in dataset.files:
            assert file.url.startswith(f"https://raw.githubusercontent.com/{dataset.repository}/{dataset.commit}/")
    files = {file.name: file.variable for dataset in list_datasets() for file in dataset.files}
    assert files == FILES | {f"room4x4/{name}.mat": name for name in ROOM}


def test_pinned_hashes_are_those_of_the_published_files(shared_data):
    files = [file for dataset in list_datasets() for file in dataset.files if (shared_data / file.name).is_file()]
    assert len(files) >= len(FILES)
    for file in files:
        assert hashlib.sha256((shared_data / file.name).read_bytes()).hexdigest() == file.sha256


SQUARE = np.ones((2, 2, 3), dtype=int)


@pytest.mark.parametrize("own", [MeasuredDuct([0, 1], [1], [1, 2, 3]), MeasuredRoom(SQUARE, SQUARE)])
def test_measured_data_of_ones_own_are_floats_that_stay(own):
    assert own.primary.dtype == np.float64
    with pytest.raises(AttributeError):
        own.fs = 1


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: MeasuredDuct([1], [[1]], [1]), "secondary must be one-dimensional"),
        (lambda: MeasuredDuct([1], [1], [np.nan]), "noise must be finite"),
        (lambda: MeasuredDuct([1], [1], [1], fs=0), "fs must be greater than 0"),
        (lambda: MeasuredRoom(SQUARE, SQUARE[0]), r"secondary must have shape \(K microphones, inputs, taps\)"),
        (lambda: MeasuredRoom(SQUARE[:1], SQUARE), "must have the same K microphones as their first axis, got 1 and 2"),
        (lambda: MeasuredRoom(np.nan * SQUARE, SQUARE), "primary must be finite"),
        (lambda: MeasuredRoom(SQUARE, SQUARE, fs=0), "fs must be greater than 0"),
    ],
)
def test_measured_data_of_ones_own_are_checked(make, message):
    with pytest.raises(ValueError, match=message):
        make()
