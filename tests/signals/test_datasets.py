"""The measured duct, and fetching of measured data from a server on this machine; no test reaches beyond it."""

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
    dataset_folder,
    fetch_dataset,
    has_dataset,
    list_datasets,
    load_measured_duct,
)

FILES = {
    "duct/Pz1.mat": "Pz1",
    "duct/Sz.mat": "S",
    "motor/Motor.mat": "Motor_noise",
    "compressor/compressor_16kHz.mat": "yr",
}


@pytest.fixture
def own_files(tmp_path, monkeypatch):
    """A folder of small files in the published layout, which counts as the published one."""
    for name, variable in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        scipy.io.savemat(tmp_path / name, {variable: np.arange(1.0, 4.0)[:, None]})
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
    np.testing.assert_array_equal(duct.secondary, load_measured_duct(shared_data).secondary)


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


def test_folder_argument_comes_before_the_environment(own_files, data_folder, tmp_path):
    data_folder(tmp_path / "elsewhere")
    assert load_measured_duct(own_files).primary.tolist() == [1.0, 2.0, 3.0]
    with pytest.raises(DataUnavailableError, match=r"elsewhere.duct.Pz1\.mat is missing: put https"):
        load_measured_duct()
    data_folder(own_files)
    assert load_measured_duct().noise.tolist() == [1.0, 2.0, 3.0]


def test_without_folder_or_permission_the_error_names_every_way(data_folder, uninstall):
    data_folder(None)
    uninstall("pooch")
    with pytest.raises(DataUnavailableError, match=r"pooch is not installed.*or set KFOPC_DATA to a folder"):
        load_measured_duct()
    with pytest.raises(FileNotFoundError):
        load_measured_duct()


def test_empty_environment_variable_names_no_folder(source, data_folder, tmp_path):
    data_folder("")
    with pytest.raises(
        DataUnavailableError,
        match=r"Pz1\.mat is missing: put .* or name another folder .*; without a folder, allow_download=True",
    ):
        load_measured_duct()
    assert source.asked == []
    assert dataset_folder() == tmp_path / "cache" / "kfopc_filterpy"


def test_download_asks_once_for_each_pinned_file_and_keeps_it(source):
    duct = "/Luo-Zhengding/GFANC-Kalman/06badd525411571402e83212e7f00b2345cde62d/Pz%20and%20Sz/Duct_Path"
    motor = "/Ji-Junwei/PriPathEst_MOVFxLMS_ANC/84bcdae3aaba5c7410898dcb20ba14f5d417c0d8/MOVFxLMS_PriEst"
    compressor = "/ANC-Research/IC-DMCANC-CPA/ed1d5dbe59c990c1718052e6d3e28513ff12b70c/compressor_16kHz.mat"
    assert load_measured_duct(allow_download=True, timeout_s=2.5).secondary.tolist() == [1.0, 2.0, 3.0]
    assert source.asked == [f"{duct}/Pz1.mat", f"{duct}/Sz.mat", f"{motor}/Noise_data/Motor.mat"]
    assert (dataset_folder() / "motor" / "Motor.mat").is_file()
    assert load_measured_duct(allow_download=True).primary.tolist() == [1.0, 2.0, 3.0]
    assert load_measured_duct().primary.tolist() == [1.0, 2.0, 3.0]  # what is in the cache needs no permission
    assert len(source.asked) == 3
    load_measured_duct(noise="compressor", allow_download=True)
    assert source.asked[3:] == [compressor]


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
            assert len(file.sha256) == 64
    names = [file.name for dataset in list_datasets() for file in dataset.files]
    assert len(names) == len(set(names))


def test_pinned_hashes_are_those_of_the_published_files(shared_data):
    files = {file.name: file for dataset in list_datasets() for file in dataset.files}
    assert {name: files[name].variable for name in FILES} == FILES
    there = [file for name, file in files.items() if (shared_data / name).is_file()]
    assert len(there) >= len(FILES)
    for file in there:
        assert hashlib.sha256((shared_data / file.name).read_bytes()).hexdigest() == file.sha256


def test_measured_duct_of_own_signals_is_checked():
    duct = MeasuredDuct([0, 1], [1], [1, 2, 3], fs=8000)
    assert duct.primary.dtype == np.float64
    with pytest.raises(AttributeError):
        duct.fs = 1
    for signals, message in ((([1], [[1]], [1]), "secondary must be one-"), (([1], [1], [np.nan]), "noise must be")):
        with pytest.raises(ValueError, match=message):
            MeasuredDuct(*signals)
    with pytest.raises(ValueError, match="fs must be greater than 0"):
        MeasuredDuct([1], [1], [1], fs=0)
