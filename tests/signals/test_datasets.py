"""Readers and writers of recordings, and the measured duct; no test reaches for the network."""

import hashlib
import struct
import sys
import wave
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import soundfile
from helpers.network import serve

from kfopc_filterpy.signals import (
    DataUnavailableError,
    MeasuredDuct,
    datasets,
    load_measured_duct,
    read_mat_vector,
    read_wav,
    write_wav,
)

FILES = {
    "duct/Pz1.mat": ("Pz1", 1024),
    "duct/Sz.mat": ("S", 512),
    "motor/Motor.mat": ("Motor_noise", 162001),
    "compressor/compressor_16kHz.mat": ("yr", 279378),
}


@pytest.fixture
def no_folder(monkeypatch):
    """No data folder in the environment."""
    monkeypatch.delenv("KFOPC_DATA", raising=False)


@pytest.fixture
def own_files(tmp_path, monkeypatch):
    """A folder of small files in the published layout, which counts as the published one."""
    for name, (variable, _) in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        scipy.io.savemat(tmp_path / name, {variable: np.arange(1.0, 4.0)[:, None]})
    for name in FILES:
        monkeypatch.setitem(datasets._HASHES, name, hashlib.sha256((tmp_path / name).read_bytes()).hexdigest())
    return tmp_path


@pytest.fixture
def network(own_files, monkeypatch):
    """A network that serves `own_files` to pooch, whose cache is a new folder; the addresses asked for."""
    monkeypatch.delenv("KFOPC_DATA", raising=False)
    return serve(own_files, monkeypatch)


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


def test_an_unknown_noise_is_refused(own_files):
    with pytest.raises(ValueError, match="noise must be one of 'motor', 'compressor', got 'fan'"):
        load_measured_duct(own_files, noise="fan")


def test_folder_argument_comes_before_the_environment(own_files, monkeypatch, tmp_path):
    monkeypatch.setenv("KFOPC_DATA", str(tmp_path / "elsewhere"))
    assert load_measured_duct(own_files).primary.tolist() == [1.0, 2.0, 3.0]
    with pytest.raises(DataUnavailableError, match=r"elsewhere.duct.Pz1\.mat is missing: put https"):
        load_measured_duct()
    monkeypatch.setenv("KFOPC_DATA", str(own_files))
    assert load_measured_duct().noise.tolist() == [1.0, 2.0, 3.0]


@pytest.mark.usefixtures("no_folder")
def test_without_folder_or_permission_the_error_names_every_way(monkeypatch):
    monkeypatch.setitem(sys.modules, "pooch", None)
    with pytest.raises(DataUnavailableError, match=r"pass folder, set KFOPC_DATA, or pass allow_download=True"):
        load_measured_duct()
    with pytest.raises(FileNotFoundError):
        load_measured_duct()


def test_empty_environment_variable_names_no_folder(monkeypatch):
    monkeypatch.setenv("KFOPC_DATA", "")
    with pytest.raises(DataUnavailableError, match="no folder with the measured duct is named"):
        load_measured_duct()


def test_changed_file_is_refused_with_both_hashes(own_files):
    path = own_files / "duct" / "Sz.mat"
    path.write_bytes(path.read_bytes() + b"\0")
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    with pytest.raises(DataUnavailableError, match=rf"Sz\.mat is not the published file, its SHA-256 is {found}"):
        load_measured_duct(own_files)


def test_download_asks_once_for_each_pinned_file_and_keeps_it(network, own_files):
    assert load_measured_duct(allow_download=True, timeout_s=2.5).secondary.tolist() == [1.0, 2.0, 3.0]
    root = "https://raw.githubusercontent.com"
    duct = f"{root}/Luo-Zhengding/GFANC-Kalman/06badd525411571402e83212e7f00b2345cde62d/Pz%20and%20Sz/Duct_Path"
    motor = f"{root}/Ji-Junwei/PriPathEst_MOVFxLMS_ANC/84bcdae3aaba5c7410898dcb20ba14f5d417c0d8/MOVFxLMS_PriEst"
    expected = [f"{duct}/Pz1.mat", f"{duct}/Sz.mat", f"{motor}/Noise_data/Motor.mat"]
    assert network == [(url, 2.5) for url in expected]
    assert (own_files / "cache" / "kfopc_filterpy" / "motor" / "Motor.mat").is_file()
    assert load_measured_duct(allow_download=True).primary.tolist() == [1.0, 2.0, 3.0]
    assert len(network) == 3
    load_measured_duct(noise="compressor", allow_download=True)
    compressor = "ANC-Research/IC-DMCANC-CPA/ed1d5dbe59c990c1718052e6d3e28513ff12b70c/compressor_16kHz.mat"
    assert network[3:] == [(f"{root}/{compressor}", 5.0)]


def test_a_folder_comes_before_a_download(network, own_files, monkeypatch):
    monkeypatch.setenv("KFOPC_DATA", str(own_files))
    load_measured_duct(allow_download=True)
    assert network == []


def test_a_download_with_another_hash_is_refused(network, monkeypatch):
    monkeypatch.setitem(datasets._HASHES, "duct/Pz1.mat", 64 * "0")
    with pytest.raises(DataUnavailableError, match=r"Pz1\.mat could not be fetched \(SHA256 hash .* does not match"):
        load_measured_duct(allow_download=True)


def test_failed_download_stops_at_the_first_file(network, monkeypatch):
    import pooch

    def no_route(self, url, output_file, _):
        network.append(url)
        raise OSError("no route to host")

    monkeypatch.setattr(pooch.HTTPDownloader, "__call__", no_route)
    with pytest.raises(
        DataUnavailableError, match=r"Pz1\.mat could not be fetched \(no route to host\): set KFOPC_DATA"
    ):
        load_measured_duct(allow_download=True)
    assert len(network) == 1


@pytest.mark.usefixtures("no_folder")
def test_download_without_pooch_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pooch", None)
    with pytest.raises(DataUnavailableError, match=r"pooch is not installed.*kfopc-filterpy\[studies\]"):
        load_measured_duct(allow_download=True)


def test_pinned_hashes_are_those_of_the_published_files(shared_data):
    assert set(datasets._HASHES) == set(datasets._URLS) >= set(FILES)
    for name in FILES:
        assert hashlib.sha256((shared_data / name).read_bytes()).hexdigest() == datasets._HASHES[name]


def test_measured_duct_of_own_signals_is_checked():
    duct = MeasuredDuct([0, 1], [1], [1, 2, 3], fs=8000)
    assert duct.primary.dtype == np.float64
    with pytest.raises(AttributeError):
        duct.fs = 1
    with pytest.raises(ValueError, match=r"secondary must be one-dimensional"):
        MeasuredDuct([1], [[1]], [1])
    with pytest.raises(ValueError, match=r"noise must be finite"):
        MeasuredDuct([1], [1], [np.nan])
    with pytest.raises(ValueError, match=r"fs must be greater than 0"):
        MeasuredDuct([1], [1], [1], fs=0)


# ---- MAT files


@pytest.mark.parametrize("shape", [(5, 1), (1, 5), (5,)])
@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int16])
def test_mat_vectors_of_any_shape_are_read_as_float64(tmp_path, shape, kind):
    values = np.arange(5)
    scipy.io.savemat(tmp_path / "x.mat", {"x": values.astype(kind).reshape(shape)}, oned_as="column")
    read = read_mat_vector(tmp_path / "x.mat", "x")
    assert read.dtype == np.float64
    np.testing.assert_array_equal(read, values)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.ones((2, 3)), r"must be a vector with at least one value, got shape \(2, 3\)"),
        (np.zeros((0, 0)), r"must be a vector with at least one value, got shape \(0, 0\)"),
        (np.zeros((3, 0)), r"must be a vector with at least one value"),
        (np.array([1.0, np.nan]), r"variable 'x' of .* must be finite.*index 1"),
        (np.array([1j]), r"must hold real numbers, got complex128"),
        ("text", r"must hold real numbers"),
        ({"inner": 1.0}, r"must hold real numbers"),
    ],
)
def test_mat_variables_that_are_no_vector_are_refused(tmp_path, value, message):
    scipy.io.savemat(tmp_path / "x.mat", {"x": value})
    with pytest.raises(ValueError, match=message):
        read_mat_vector(tmp_path / "x.mat", "x")


def test_missing_mat_file_and_variable(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.mat does not exist"):
        read_mat_vector(tmp_path / "none.mat", "x")
    scipy.io.savemat(tmp_path / "x.mat", {"b": 1.0, "a": 2.0})
    with pytest.raises(ValueError, match=r"variable 'x' is not in .*; it holds: a, b"):
        read_mat_vector(tmp_path / "x.mat", "x")


def test_unreadable_mat_files(tmp_path):
    path = tmp_path / "x.mat"
    for content in (b"", b"not a mat file", bytes(range(256)) * 8):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"x\.mat cannot be read as a MAT file"):
            read_mat_vector(path, "x")
    scipy.io.savemat(path, {"x": np.arange(1000.0)}, do_compression=True)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(ValueError, match=r"x\.mat cannot be read as a MAT file"):
        read_mat_vector(path, "x")
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + struct.pack("<H", 0x0200) + b"IM" + b"\x89HDF")
    with pytest.raises(ValueError, match=r"version 7\.3; save it with MATLAB's -v7 option"):
        read_mat_vector(path, "x")


# ---- audio files


def test_wav_without_peak_keeps_single_precision_values(tmp_path):
    x = np.random.default_rng(1).normal(0, 3, 1000)
    write_wav(tmp_path / "x.wav", x, 16000)
    read, fs = read_wav(tmp_path / "x.wav")
    assert fs == 16000.0
    np.testing.assert_array_equal(read, x.astype(np.float32))


def test_wav_with_one_peak_shares_one_scale(tmp_path):
    loud = np.array([4.0, -4.0, 1.0])
    for name, signal in (("loud", loud), ("soft", loud / 10)):
        write_wav(tmp_path / f"{name}.wav", signal, 16000, peak=4.0)
        with wave.open(str(tmp_path / f"{name}.wav")) as file:
            assert (file.getsampwidth(), file.getnchannels(), file.getframerate()) == (2, 1, 16000)
            stored = np.frombuffer(file.readframes(3), "<i2")
        np.testing.assert_array_equal(stored, np.round(signal / 4.0 * 32767))


def test_wav_writes_the_tail_of_a_diverged_run_as_silence(tmp_path):
    for peak in (None, 2.0):
        write_wav(tmp_path / "x.wav", [1.0, -2.0, np.nan, np.nan], 16000, peak=peak)
        assert read_wav(tmp_path / "x.wav")[0][2:].tolist() == [0.0, 0.0]
    write_wav(tmp_path / "x.wav", [np.nan], 16000)
    assert read_wav(tmp_path / "x.wav")[0].tolist() == [0.0]


@pytest.mark.parametrize(
    ("width", "stored", "expected"),
    [
        (1, bytes([0, 128, 192]), [-1.0, 0.0, 0.5]),
        (2, struct.pack("<3h", -32768, 0, 16384), [-1.0, 0.0, 0.5]),
        (3, b"\x00\x00\x80" + b"\x00\x00\x00" + b"\x00\x00\x40", [-1.0, 0.0, 0.5]),
        (4, struct.pack("<3i", -(2**31), 0, 2**30), [-1.0, 0.0, 0.5]),
    ],
)
def test_wav_of_any_width_is_read_with_full_scale_one(tmp_path, width, stored, expected):
    with wave.open(str(tmp_path / "x.wav"), "wb") as file:
        file.setparams((1, width, 8000, 3, "NONE", ""))
        file.writeframes(stored)
    signal, fs = read_wav(tmp_path / "x.wav", 8000)
    assert (signal.tolist(), fs) == (expected, 8000.0)


def test_channels_lead_in_what_is_read_and_written(tmp_path):
    with wave.open(str(tmp_path / "x.wav"), "wb") as file:
        file.setparams((2, 2, 8000, 3, "NONE", ""))
        file.writeframes(struct.pack("<6h", 16384, 0, -16384, 8192, 0, 1))
    signal, _ = read_wav(tmp_path / "x.wav")
    assert signal.tolist() == [[0.5, -0.5, 0.0], [0.0, 0.25, 2.0**-15]]
    assert signal.flags.c_contiguous
    assert read_wav(tmp_path / "x.wav", channel=0)[0].tolist() == [0.5, -0.5, 0.0]
    assert read_wav(tmp_path / "x.wav", channel=1)[0].tolist() == [0.0, 0.25, 2.0**-15]
    with pytest.raises(ValueError, match=r"channel must be below the 2 channel"):
        read_wav(tmp_path / "x.wav", channel=2)


@pytest.mark.parametrize("peak", [None, 8.0])
def test_two_channels_come_back_as_they_were_written(tmp_path, peak):
    x = np.clip(np.random.default_rng(1).normal(0, 2, (2, 1000)), -8, 8)
    write_wav(tmp_path / "x.wav", x, 16000, peak=peak)
    assert soundfile.info(tmp_path / "x.wav").channels == 2
    read, _ = read_wav(tmp_path / "x.wav")
    expected = x.astype(np.float32) if peak is None else np.round(x / peak * 32767) / 32768
    np.testing.assert_array_equal(read, expected)
    write_wav(tmp_path / "y.wav", x[:1], 16000, peak=peak)
    np.testing.assert_array_equal(read_wav(tmp_path / "y.wav")[0], expected[0])  # one channel drops its axis


def test_channels_that_diverged_at_different_times_end_in_silence(tmp_path):
    write_wav(tmp_path / "x.wav", [[1.0, 2.0, np.nan], [1.0, np.nan, np.nan]], 16000)
    assert read_wav(tmp_path / "x.wav")[0].tolist() == [[1.0, 2.0, 0.0], [1.0, 0.0, 0.0]]


def test_the_same_signal_gives_the_same_bytes(tmp_path):
    for peak in (None, 1.0):
        write_wav(tmp_path / "x.wav", [0.5, -0.5], 16000, peak=peak)
        content = (tmp_path / "x.wav").read_bytes()
        assert b"PEAK" not in content  # a chunk with the time of writing
        write_wav(tmp_path / "x.wav", [0.5, -0.5], 16000, peak=peak)
        assert (tmp_path / "x.wav").read_bytes() == content


def test_flac_is_read(tmp_path):
    x = np.array([[0.5, -0.25, 0.0], [0.0, 0.125, 1.0 - 2.0**-15]])
    soundfile.write(tmp_path / "x.flac", x.T, 44100, subtype="PCM_16")
    read, fs = read_wav(tmp_path / "x.flac")
    np.testing.assert_array_equal(read, x)
    assert fs == 44100.0


def test_wav_of_unknown_size_is_read(tmp_path):
    write_wav(tmp_path / "x.wav", [0.5, -0.5], 16000)
    content = (tmp_path / "x.wav").read_bytes()
    (tmp_path / "x.wav").write_bytes(content[:4] + 4 * b"\xff" + content[8:])
    assert read_wav(tmp_path / "x.wav")[0].tolist() == [0.5, -0.5]


def test_audio_without_samples_or_with_nan_is_refused(tmp_path):
    soundfile.write(tmp_path / "x.wav", np.zeros((0, 2)), 16000)
    with pytest.raises(ValueError, match=r"the signal of .*x\.wav must have at least 1 value"):
        read_wav(tmp_path / "x.wav")
    soundfile.write(tmp_path / "x.wav", np.array([[0.0, np.nan]]).repeat(3, axis=0), 16000, subtype="FLOAT")
    with pytest.raises(ValueError, match=r"x\.wav must be finite, but holds NaN or Inf \(first at index \(1, 0\)\)"):
        read_wav(tmp_path / "x.wav")
    assert read_wav(tmp_path / "x.wav", channel=0)[0].tolist() == [0.0, 0.0, 0.0]


def test_wav_with_unknown_chunks_is_read_and_a_truncated_one_refused(tmp_path):
    path = tmp_path / "x.wav"
    write_wav(path, np.arange(100.0), 16000, peak=100.0)
    content = path.read_bytes()
    marked = content + b"cue " + struct.pack("<I", 4) + bytes(4)
    marked = marked[:4] + struct.pack("<I", len(marked) - 8) + marked[8:]
    path.write_bytes(marked)
    assert read_wav(path)[0].size == 100
    path.write_bytes(content[:-51])
    with pytest.raises(ValueError, match=r"x\.wav cannot be read as an audio file"):
        read_wav(path)


@pytest.mark.parametrize("content", [b"", b"RIFF", b"no wave file at all"])
def test_unreadable_wav_files(tmp_path, content):
    (tmp_path / "x.wav").write_bytes(content)
    with pytest.raises(ValueError, match=r"x\.wav cannot be read as an audio file"):
        read_wav(tmp_path / "x.wav")


def test_wav_refusals(tmp_path):
    path = tmp_path / "x.wav"
    with pytest.raises(FileNotFoundError, match=r"x\.wav does not exist"):
        read_wav(path)
    for arguments, message in (
        (([], 16000), r"signal must have at least 1 value"),
        (([np.nan, 1.0], 16000), r"signal must be finite.*index 0"),
        (([np.inf], 16000), r"signal must be finite"),
        (([[[1.0, 2.0]]], 16000), r"signal must be \(n_samples,\) or \(n_channels, n_samples\), got shape \(1, 1, 2\)"),
        (([[1.0], [2.0]], 16000), r"signal must have its channels first.*transpose it"),
        (([1.0], 16000.5), r"fs must be a whole number of Hz"),
        (([1.0], 0), r"fs must be greater than 0"),
    ):
        with pytest.raises(ValueError, match=message):
            write_wav(path, *arguments)
    with pytest.raises(ValueError, match=r"signal reaches 2, beyond peak = 1; raise peak"):
        write_wav(path, [2.0], 16000, peak=1.0)
    assert not path.exists()
    write_wav(path, [1.0], 16000)
    with pytest.raises(ValueError, match=r"is sampled at 16000 Hz, expected fs = 8000 Hz"):
        read_wav(path, 8000)
