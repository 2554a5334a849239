"""Recordings: every format against what wrote it, units and rates; and files that are wrong, each with its message."""

from __future__ import annotations

import io
import pickle
import struct
import wave
import zipfile
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import soundfile
from helpers.files import FS, WRITERS, signal, write_sofa, write_uff

from kfopc_filterpy.signals import Recording, calibration_factor, read_recording, write_wav

# ---- every format


@pytest.mark.parametrize("name", [name for name in WRITERS if name not in ("x.npy", "x.csv", "x.sofa", "rew.txt")])
def test_every_format_gives_what_was_written(name, tmp_path):
    WRITERS[name](tmp_path / name)
    recording = read_recording(tmp_path / name)
    expected = signal(2) if recording.samples.ndim == 2 else signal()
    # UFF has 13 digits, the text with times 17, single precision holds 16 bits exactly.
    np.testing.assert_allclose(recording.samples, expected, rtol=0, atol=1e-11 if name.endswith("uff") else 0)
    assert (recording.samples.dtype, recording.samples.flags.c_contiguous) == (np.float64, True)
    assert (recording.fs, recording.file_fs, recording.name) == (FS, FS, name)
    assert recording.unit == ("Pa" if name.endswith("uff") else "1")


@pytest.mark.parametrize("name", ["x.npy", "x.csv"])
def test_a_format_without_a_rate_needs_one(name, tmp_path):
    WRITERS[name](tmp_path / name)
    with pytest.raises(ValueError, match=rf"{name} states no sampling rate: pass fs, the rate in Hz"):
        read_recording(tmp_path / name)
    given = read_recording(tmp_path / name, fs=FS)
    np.testing.assert_array_equal(given.samples, signal(2))
    assert (given.fs, given.file_fs) == (FS, None)
    assert "(not stated in the file)" in repr(given)
    slower = read_recording(tmp_path / name, fs=8000, file_fs=FS)
    assert (slower.fs, slower.samples.shape) == (8000, (2, 150))


@pytest.mark.parametrize(
    "name", ["pcm16.wav", "x.flac", "x.aiff", "x.npz", "new.mat", "plain.mat", "timed.csv", "x.uff"]
)
def test_a_file_without_a_known_suffix_is_known_by_how_it_begins(name, tmp_path):
    WRITERS[name](tmp_path / name)
    (tmp_path / "recording.bin").write_bytes((tmp_path / name).read_bytes())
    expected = read_recording(tmp_path / name).samples
    np.testing.assert_array_equal(read_recording(tmp_path / "recording.bin").samples, expected)


@pytest.mark.parametrize(
    ("width", "stored"),
    [
        (1, bytes([0, 128, 192])),
        (2, struct.pack("<3h", -32768, 0, 16384)),
        (3, b"\x00\x00\x80" + b"\x00\x00\x00" + b"\x00\x00\x40"),
        (4, struct.pack("<3i", -(2**31), 0, 2**30)),
    ],
)
def test_wav_by_another_writer_is_read(tmp_path, width, stored):
    with wave.open(str(tmp_path / "x.wav"), "wb") as file:
        file.setparams((1, width, 8000, 3, "NONE", ""))
        file.writeframes(stored)
    recording = read_recording(tmp_path / "x.wav")
    assert (recording.samples.tolist(), recording.fs) == ([-1.0, 0.0, 0.5], 8000.0)


@pytest.mark.parametrize(("shape", "kind"), [((5, 1), np.float64), ((1, 5), np.float32), ((5,), np.int16)])
@pytest.mark.parametrize("suffix", ["mat", "npy", "npz"])
def test_vectors_of_any_shape_and_type_are_read(tmp_path, shape, kind, suffix):
    values, path = np.arange(5).astype(kind).reshape(shape), tmp_path / f"x.{suffix}"
    if suffix == "mat":
        scipy.io.savemat(path, {"x": values}, oned_as="column")
    else:
        (np.savez if suffix == "npz" else np.save)(path, values)
    read = read_recording(path, fs=FS)
    assert read.samples.dtype == np.float64
    assert read.samples.tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("order", ["C", "F"])
def test_the_longer_axis_of_an_array_is_time(tmp_path, order):
    table = np.array(signal(3, 10).T, order=order)
    np.save(tmp_path / "x.npy", table)
    np.testing.assert_array_equal(read_recording(tmp_path / "x.npy", fs=FS).samples, table.T)
    np.save(tmp_path / "x.npy", table.T)
    np.testing.assert_array_equal(read_recording(tmp_path / "x.npy", fs=FS).samples, table.T)


def test_a_variable_of_several_is_chosen_by_name(tmp_path):
    scipy.io.savemat(tmp_path / "x.mat", {"b": [1.0, 2.0], "a": [3.0, 4.0], "Fs": 8000.0, "who": "me", "z": [1j, 2.0]})
    with pytest.raises(
        ValueError, match=r"x\.mat holds several variables: Fs \(1, 1\), a \(1, 2\), b \(1, 2\), z \(1, 2\); choose"
    ):
        read_recording(tmp_path / "x.mat")
    chosen = read_recording(tmp_path / "x.mat", variable="a")
    assert (chosen.samples.tolist(), chosen.fs) == ([3.0, 4.0], 8000.0)
    with pytest.raises(ValueError, match=r"variable 'c' is not in .*; it holds: Fs .*, a .*, b "):
        read_recording(tmp_path / "x.mat", variable="c")
    with pytest.raises(ValueError, match=r"variable 'who' of .* must hold real numbers, got char"):
        read_recording(tmp_path / "x.mat", variable="who")
    with pytest.raises(ValueError, match=r"variable 'z' of .* must hold real numbers, got complex128"):
        read_recording(tmp_path / "x.mat", variable="z")
    np.savez(tmp_path / "x.npz", a=[1.0, 2.0], b=[3.0, 4.0])
    with pytest.raises(
        ValueError, match=r"x\.npz holds several variables: a \(2,\), b \(2,\); choose one with the option variable"
    ):
        read_recording(tmp_path / "x.npz", fs=FS)
    assert read_recording(tmp_path / "x.npz", variable="b", fs=FS).samples.tolist() == [3.0, 4.0]
    write_wav(tmp_path / "x.wav", [1.0, 2.0], FS)
    with pytest.raises(
        ValueError, match=r"x\.wav is an audio file, which has no named variables: leave out the option variable"
    ):
        read_recording(tmp_path / "x.wav", variable="b")


def test_matlab_7_3_has_what_matlab_would_show(tmp_path):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "x.mat"
    WRITERS["new.mat"](path)
    with h5py.File(path, "r+") as file:
        file.create_dataset("two", data=signal(2).astype(np.float32).T).attrs["MATLAB_class"] = np.bytes_("single")
        paths = np.arange(24.0).reshape(2, 3, 4)
        file.create_dataset("paths", data=paths.T).attrs["MATLAB_class"] = np.bytes_("double")
        empty = file.create_dataset("none", data=np.uint64([0, 3]))
        empty.attrs["MATLAB_class"], empty.attrs["MATLAB_empty"] = np.bytes_("double"), np.uint8(1)
        complex_numbers = np.zeros((1, 3), dtype=[("real", "f8"), ("imag", "f8")])
        file.create_dataset("z", data=complex_numbers).attrs["MATLAB_class"] = np.bytes_("double")
        file["elsewhere"] = h5py.ExternalLink(str(tmp_path / "other.mat"), "noise")
        outside = file.create_dataset("outside", (4,), "f8", external=[(str(path), 0, 32)])
        outside.attrs["MATLAB_class"] = np.bytes_("double")
    np.testing.assert_array_equal(read_recording(path, variable="two").samples, signal(2).astype(np.float32))
    for name, message in (
        ("none", r"variable 'none' of .* is empty"),
        ("z", r"variable 'z' of .* must hold real numbers, got complex numbers"),
        ("text", r"variable 'text' of .* must hold real numbers, got char"),
        ("elsewhere", r"variable 'elsewhere' of .* must hold real numbers, got a link to another file"),
        ("outside", r"'outside' of .* refers to other files"),
        ("paths", r"must hold signals, .* got shape \(2, 3, 4\); read impulse responses with paths\.read_path"),
    ):
        with pytest.raises(ValueError, match=message):
            read_recording(path, variable=name)


# ---- text


@pytest.mark.parametrize(
    "text",
    [
        "0.5\n-0.25\n1.0\n",
        "pressure\n0.5\n-0.25\n1.0\n",
        "# a comment\n\n  0.5 \r\n -0.25\r\n 1.0",
        "t,p\n0.000,0.5\n0.00125,-0.25\n0.00250,1.0\n",
        "t;p\n0,000;0,5\n0,00125;-0,25\n0,00250;1,0\n",
        "t\tp\n0,000\t0,5\n0,00125\t-0,25\n0,00250\t1,0\n",
        "1,0.5\n2,-0.25\n3,1.0\n",
        "\ufefft [s], p [Pa]\n0, 5e-1\n.00125, -25E-2\n.0025, 1\n",
    ],
)
def test_text_of_any_layout_is_read(tmp_path, text):
    has_time = "125" in text
    for encoding in ("utf-8", "utf-16"):
        (tmp_path / "x.txt").write_bytes(text.encode(encoding))
        recording = read_recording(tmp_path / "x.txt", file_fs=None if has_time else 800)
        assert recording.samples.tolist() == [0.5, -0.25, 1.0]
        assert (recording.fs, recording.file_fs) == (800, 800 if has_time else None)


def test_a_first_column_that_is_no_time_is_a_channel(tmp_path):
    (tmp_path / "x.csv").write_text("left,right\n0,1\n1,2\n3,3\n4,4\n")
    assert read_recording(tmp_path / "x.csv", fs=8).samples.tolist() == [[0.0, 1.0, 3.0, 4.0], [1.0, 2.0, 3.0, 4.0]]


def test_times_in_uneven_steps_are_refused(tmp_path):
    times = np.cumsum(np.linspace(1, 2, 200))
    np.savetxt(tmp_path / "x.csv", np.column_stack([times, times]), delimiter=",")
    with pytest.raises(ValueError, match=r"x\.csv has a first column that rises in uneven steps, from 1\.\d* to 2"):
        read_recording(tmp_path / "x.csv", fs=8)


def test_the_rate_of_rounded_times_is_a_whole_number_of_hz(tmp_path):
    times = np.arange(3000) / 44100
    np.savetxt(tmp_path / "x.csv", np.column_stack([times, times]), fmt="%.6f", delimiter=",")
    assert read_recording(tmp_path / "x.csv").fs == 44100


# ---- rates and units


def test_a_recording_is_resampled_and_keeps_its_height(tmp_path):
    t = np.arange(44100) / 44100
    write_wav(tmp_path / "x.wav", [np.sin(2 * np.pi * 1000 * t), np.cos(2 * np.pi * 300 * t)], 44100)
    recording = read_recording(tmp_path / "x.wav", fs=16000)
    assert recording.samples.shape == (2, 16000)
    assert (recording.fs, recording.file_fs) == (16000, 44100)
    assert "2 x 16000 samples at 16000 Hz (44100 Hz in the file)" in repr(recording)
    t = np.arange(16000) / 16000
    inner = slice(100, -100)
    expected = np.array([np.sin(2 * np.pi * 1000 * t), np.cos(2 * np.pi * 300 * t)])
    # The filter of resample_poly ripples by less than 0.3 % in its pass band.
    np.testing.assert_allclose(recording.samples[:, inner], expected[:, inner], atol=3e-3)


def test_rates_that_contradict_or_have_no_ratio_are_refused(tmp_path):
    write_wav(tmp_path / "x.wav", np.ones(200), FS)
    with pytest.raises(
        ValueError, match=r"x\.wav states a sampling rate of 16000 Hz, but file_fs = 8000 Hz: leave it out"
    ):
        read_recording(tmp_path / "x.wav", file_fs=8000)
    with pytest.raises(ValueError, match=r"sample rates must be in a ratio of whole numbers"):
        read_recording(tmp_path / "x.wav", fs=16000 * np.pi)
    for fs in (0, -1, np.nan):
        with pytest.raises(ValueError, match=r"fs must be"):
            read_recording(tmp_path / "x.wav", fs=fs)
    with pytest.raises(ValueError, match=r"resampled from 16000 to 8e\+08 Hz it has 1e\+07 samples"):
        read_recording(tmp_path / "x.wav", fs=FS * 50_000)


def test_a_scale_comes_with_its_unit(tmp_path):
    write_wav(tmp_path / "x.wav", [0.5, -0.25], FS)
    scaled = read_recording(tmp_path / "x.wav", unit="Pa", unit_per_full_scale=8)
    assert (scaled.samples.tolist(), scaled.unit) == ([4.0, -2.0], "Pa")
    assert repr(scaled).endswith("at 16000 Hz, in Pa>")
    named = read_recording(tmp_path / "x.wav", unit="V")
    assert (named.samples.tolist(), named.unit) == ([0.5, -0.25], "V")
    with pytest.raises(ValueError, match=r'unit_per_full_scale needs the unit of its result: pass unit="Pa"'):
        read_recording(tmp_path / "x.wav", unit_per_full_scale=8)
    with pytest.raises(ValueError, match=r"unit_per_full_scale must be greater than 0"):
        read_recording(tmp_path / "x.wav", unit="Pa", unit_per_full_scale=0)
    with pytest.raises(ValueError, match=r"calibrator gives scale and unit \(Pa\): leave out unit"):
        read_recording(tmp_path / "x.wav", unit="V", calibrator=tmp_path / "x.wav")


def tone(level: float = 0.1, seconds: float = 2.0, hz: float = 1000.0, fs: float = 48000) -> np.ndarray:
    return level * np.sqrt(2) * np.sin(2 * np.pi * hz * np.arange(int(seconds * fs)) / fs + 0.3)


@pytest.mark.parametrize(
    ("level_db", "pascal", "hz"), [(94.0, 1.0024, 997.3), (114.0, 10.024, 250.0), (93.9794, 1.0, 997.3)]
)
def test_the_tone_of_a_calibrator_becomes_its_level(tmp_path, rng, level_db, pascal, hz):
    hum = 0.002 * np.sin(2 * np.pi * 50 * np.arange(96000) / 48000)
    noise = 0.002 * rng.standard_normal(96000)
    write_wav(tmp_path / "calibrator.wav", tone(0.1, hz=hz) + hum + noise + 0.01, 48000)
    x = rng.standard_normal((2, 1000)) / 8
    write_wav(tmp_path / "x.wav", x, FS)
    recording = read_recording(tmp_path / "x.wav", calibrator=tmp_path / "calibrator.wav", level_db=level_db)
    # An rms of 0.1 is the level's pressure; offset, hum and noise (0.06 % of the power) do not count.
    np.testing.assert_allclose(recording.samples, x * pascal / 0.1, rtol=5e-4)
    assert recording.unit == "Pa"


def test_each_channel_has_its_own_calibrator_tone(tmp_path):
    write_wav(tmp_path / "calibrator.wav", [tone(0.1), tone(0.05)], 48000)
    write_wav(tmp_path / "x.wav", [[0.5, 0.5], [0.5, 0.5]], FS)
    for channel, expected in ((0, 5.012), (1, 10.024)):
        read = read_recording(tmp_path / "x.wav", channel=channel, calibrator=tmp_path / "calibrator.wav")
        np.testing.assert_allclose(read.samples, expected, rtol=1e-4)
    with pytest.raises(
        ValueError, match=r"calibrator\.wav has 2 channels where one is needed: read it with channel=0 to"
    ):
        read_recording(tmp_path / "x.wav", calibrator=tmp_path / "calibrator.wav")
    write_wav(tmp_path / "mono.wav", tone(0.1), 48000)
    assert read_recording(tmp_path / "x.wav", channel=1, calibrator=tmp_path / "mono.wav").samples[0] == pytest.approx(
        5.012, 1e-4
    )


@pytest.mark.parametrize(
    ("samples", "message"),
    [
        (tone(seconds=0.4), r"must last 0\.5 s or more, got 0\.4 s"),
        (np.zeros(48000), r"is silent"),
        (tone() * np.linspace(1, 2, 96000), r"must have a steady level, but it drifts by 4\.\d dB"),
        (np.sign(tone()), r"must be one tone, but only 8\d % of its power is.*unclipped"),
        (np.random.default_rng(1).standard_normal(96000), r"must be one tone, but only \d+ % of its power is"),
    ],
)
def test_what_is_no_calibrator_is_refused(samples, message):
    with pytest.raises(ValueError, match=message):
        calibration_factor(Recording(samples, 48000, name="calibrator.wav"))
    with pytest.raises(ValueError, match=r"calibrator must not be scaled yet, got Pa"):
        calibration_factor(Recording(tone(), 48000, unit="Pa"))


# ---- channels


def test_channels_lead_and_one_is_chosen(tmp_path):
    with wave.open(str(tmp_path / "x.wav"), "wb") as file:
        file.setparams((2, 2, 8000, 3, "NONE", ""))
        file.writeframes(struct.pack("<6h", 16384, 0, -16384, 8192, 0, 1))
    both = read_recording(tmp_path / "x.wav")
    assert both.samples.tolist() == [[0.5, -0.5, 0.0], [0.0, 0.25, 2.0**-15]]
    with pytest.raises(
        ValueError, match=r"x\.wav has 2 channels where one is needed: read it with channel=0 to channel=1"
    ):
        both.one_channel()
    for channel in (0, 1):
        assert (
            read_recording(tmp_path / "x.wav", channel=channel).one_channel().tolist() == both.samples[channel].tolist()
        )
    with pytest.raises(ValueError, match=r"channel must be below the 2 channel\(s\) of .*x\.wav, got 2"):
        read_recording(tmp_path / "x.wav", channel=2)
    with pytest.raises(ValueError, match=r"channel must be at least 0"):
        read_recording(tmp_path / "x.wav", channel=-1)
    with pytest.raises(TypeError, match=r"channel must be a whole number"):
        read_recording(tmp_path / "x.wav", channel="left")


def test_a_recording_cannot_be_changed_or_made_of_nothing():
    recording = Recording([1, 2], 8000)
    with pytest.raises(AttributeError):
        recording.fs = 1
    assert repr(recording) == "<Recording: 0.00025 s, 2 samples at 8000 Hz>"
    with pytest.raises(ValueError, match=r"samples must have at least 1 value"):
        Recording([], 8000)
    with pytest.raises(ValueError, match=r"the signal of x must be finite"):
        Recording([np.inf], 8000, name="x")
    with pytest.raises(ValueError, match=r"fs must be greater than 0"):
        Recording([1], 0)


# ---- files that are wrong


@pytest.mark.parametrize("name", ["pcm16.wav", "x.npz", "plain.mat", "x.csv", "x.uff", "x.sofa", "x.unknown"])
def test_a_missing_or_empty_file_is_refused(name, tmp_path):
    with pytest.raises(FileNotFoundError, match=rf"{name} does not exist or is not a file; the current folder is"):
        read_recording(tmp_path / name)
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(ValueError, match=rf"{name} is empty \(0 bytes\): record or export it again"):
        read_recording(tmp_path / name)


CUT = {
    "pcm16.wav": "is cut short: its header claims 1244 bytes, 1044 are there",
    "float.wav": "is cut short: its header claims",
    "long.rf64": "is cut short: its header claims",
    "x.aiff": "is cut short: its header claims",
    "x.flac": "cannot be read as an audio file|is cut short",
    "x.npy": "cannot be read as a .npy file: cannot reshape .* cut short",
    "x.npz": "cannot be read as a .npz file: File is not a zip file",
    "packed.mat": "cannot be read as a MAT file.* cut short",
    "plain.mat": "cannot be read as a MAT file.* cut short",
    "four.mat": "cannot be read as a MAT file",
    "new.mat": "cannot be read as a MAT file",
    "rew.txt": r"is damaged or cut short: its header claims 300 samples, got \(2\d\d,\)",
    "x.uff": "has no whole data set 58|is damaged or cut short",
    "binary.uff": "has no whole data set 58|is damaged or cut short",
    "x.sofa": "cannot be read as a SOFA file",
}


@pytest.mark.parametrize("name", CUT)
def test_a_truncated_file_is_refused(name, tmp_path):
    path = tmp_path / name
    WRITERS[name](path)
    path.write_bytes(path.read_bytes()[:-200])
    if name.endswith(".uff"):  # a file with one data set
        write_uff(path, signal(), binary=name == "binary.uff")
        path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(ValueError, match=rf"{name} ({CUT[name]})"):
        read_recording(path, fs=FS)


def put(path: Path, at: int, what: bytes) -> None:
    content = path.read_bytes()
    path.write_bytes(content[:at] + what + content[at + len(what) :])


def test_a_header_that_lies_is_refused(tmp_path):
    for name in ("pcm16.wav", "x.aiff", "x.flac", "x.npy", "four.mat", "plain.mat"):
        WRITERS[name](tmp_path / name)
    content = (tmp_path / "pcm16.wav").read_bytes()
    put(tmp_path / "pcm16.wav", content.index(b"data") + 4, struct.pack("<I", 10**9))
    content = (tmp_path / "x.aiff").read_bytes()
    put(tmp_path / "x.aiff", content.index(b"SSND") + 4, struct.pack(">I", 10**9))
    put(tmp_path / "x.flac", 18 + 5, struct.pack(">I", 10**6))  # the low half of STREAMINFO's 36-bit number of samples
    content = (tmp_path / "x.npy").read_bytes()
    put(tmp_path / "x.npy", content.index(b"300"), b"999")
    put(tmp_path / "four.mat", 4, struct.pack("<i", 10**9))
    content = (tmp_path / "plain.mat").read_bytes()
    put(tmp_path / "plain.mat", content.index(struct.pack("<I", 300)), struct.pack("<I", 10**9))
    for name, message in (
        ("pcm16.wav", r"is cut short: its header claims 10000000\d\d bytes, 1244 are there"),
        ("x.aiff", r"is cut short: its header claims 10000000\d\d bytes, 1254 are there"),
        ("x.flac", r"is cut short|cannot be read as an audio file"),
        ("x.npy", r"cannot be read as a .npy file: cannot reshape array of size 600 into shape \(2,999\)"),
        ("four.mat", r"claims 1e\+09 samples"),
        ("plain.mat", r"claims 1e\+09 samples"),
    ):
        with pytest.raises(ValueError, match=rf"{name}.* {message}|{message}"):
            read_recording(tmp_path / name, fs=FS)


def test_a_file_without_samples_is_refused(tmp_path):
    h5py = pytest.importorskip("h5py")
    for name in ("x.wav", "x.aiff", "x.flac"):
        soundfile.write(tmp_path / name, np.zeros((0, 2)), FS)
    np.save(tmp_path / "x.npy", np.zeros((2, 0)))
    np.savez(tmp_path / "x.npz", noise=np.zeros(0))
    scipy.io.savemat(tmp_path / "x.mat", {"noise": np.zeros((0, 0))})
    with h5py.File(tmp_path / "new.mat", "w", userblock_size=512) as file:
        empty = file.create_dataset("noise", data=np.uint64([0, 0]))
        empty.attrs["MATLAB_class"], empty.attrs["MATLAB_empty"] = np.bytes_("double"), np.uint8(1)
    put(tmp_path / "new.mat", 0, b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    (tmp_path / "x.csv").write_text("left,right\n")
    for name, message in (
        ("x.wav", r"holds no samples: its header claims zero frames"),
        ("x.aiff", r"holds no samples: its header claims zero frames"),
        ("x.flac", r"is empty \(0 bytes\)"),  # libsndfile writes nothing
        ("x.npy", r"holds no samples, shape \(2, 0\)"),
        ("x.npz", r"variable 'noise' of .*x\.npz is empty"),
        ("x.mat", r"variable 'noise' of .*x\.mat is empty"),
        ("new.mat", r"variable 'noise' of .*new\.mat is empty"),
        ("x.csv", r"is text that is no numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            read_recording(tmp_path / name, fs=FS)


def test_nan_is_refused_with_its_place_and_only_in_the_channel_that_is_read(tmp_path):
    table = np.array([[0.0, np.nan, 0.0], [0.0, 0.0, 1.0]])
    soundfile.write(tmp_path / "x.wav", table.T, FS, subtype="FLOAT")
    np.save(tmp_path / "x.npy", table)
    np.savetxt(tmp_path / "x.csv", table.T, delimiter=",")
    scipy.io.savemat(tmp_path / "x.mat", {"noise": table})
    for name in ("x.wav", "x.npy", "x.csv", "x.mat"):
        with pytest.raises(
            ValueError, match=rf"{name} must be finite, but holds NaN or Inf \(first at index \(0, 1\)\)"
        ):
            read_recording(tmp_path / name, fs=FS)
        assert read_recording(tmp_path / name, channel=1, fs=FS).samples.tolist() == [0.0, 0.0, 1.0]


@pytest.mark.parametrize("name", ["x.csv", "x.unknown"])
@pytest.mark.parametrize(
    "content", [b"Dear Sir or Madam,\nno numbers\n", bytes(range(128, 256)) * 9, b"\n\n\n", b"\0" * 99]
)
def test_text_that_is_no_numbers_is_refused(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"{name} (is text that is no numbers|is neither text nor)"):
        read_recording(tmp_path / name, fs=FS)


@pytest.mark.parametrize("text", ["0.5,1\n0.25,2\n0.125", "1\n2\nstopped by user\n"])
def test_a_row_of_another_length_is_refused(tmp_path, text):
    (tmp_path / "x.csv").write_text(text)
    with pytest.raises(
        ValueError, match=r"x\.csv is damaged or cut short, .*, the number of columns changed from \d to \d at row \d+$"
    ):
        read_recording(tmp_path / "x.csv", fs=FS)


@pytest.mark.parametrize("name", ["x.wav", "x.flac", "x.mat", "x.npy", "x.npz", "x.sofa", "x.uff"])
@pytest.mark.parametrize("content", [b"RIFF", bytes(range(256)) * 8])
def test_a_file_that_is_something_else_is_refused(tmp_path, name, content):
    if name in ("x.sofa", "x.uff"):
        pytest.importorskip("h5py" if name == "x.sofa" else "pyuff")
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=name):
        read_recording(tmp_path / name, fs=FS)


@pytest.mark.parametrize(
    ("kind", "coding"),
    [("OGG", "VORBIS"), ("AU", "PCM_16"), ("MP3", "MPEG_LAYER_III"), ("WAV", "IMA_ADPCM"), ("WAV", "ULAW")],
)
def test_formats_that_lose_something_or_are_not_checked_are_refused(tmp_path, kind, coding):
    soundfile.write(tmp_path / "x.wav", signal(1, 4000), FS, format=kind, subtype=coding)
    with pytest.raises(ValueError, match=r"x\.wav is .*, .*, expected WAV, AIFF or FLAC without loss: record it again"):
        read_recording(tmp_path / "x.wav")


def test_nothing_is_unpickled(tmp_path):
    class Trap:
        def __reduce__(self):
            return open, (str(tmp_path / "sprung"), "w")

    np.save(tmp_path / "x.npy", np.array([Trap(), Trap()], dtype=object), allow_pickle=True)
    np.savez(tmp_path / "x.npz", noise=np.array([Trap(), Trap()], dtype=object))
    (tmp_path / "pickled.npy").write_bytes(pickle.dumps(Trap()))
    for name, message in (
        ("x.npy", r"x\.npy must hold real numbers, got object"),
        ("x.npz", r"x\.npz holds no signal: no array of real numbers"),
        ("pickled.npy", r"pickled\.npy cannot be read as a \.npy file"),
    ):
        with pytest.raises(ValueError, match=message):
            read_recording(tmp_path / name, fs=FS)
    with pytest.raises(ValueError, match=r"variable 'noise' of .* must hold real numbers, got object"):
        read_recording(tmp_path / "x.npz", variable="noise", fs=FS)
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize(("name", "library"), [("new.mat", "h5py"), ("x.sofa", "h5py"), ("x.uff", "pyuff")])
def test_without_its_library_the_error_names_the_extra(name, library, tmp_path, uninstall):
    WRITERS[name](tmp_path / name)
    uninstall(library)
    with pytest.raises(
        ModuleNotFoundError,
        match=rf"{name} is .* which needs {library}: install the extra `formats`, .*pip install -e .\.\[formats\].",
    ):
        read_recording(tmp_path / name)


def test_uff_of_other_things_than_signals_is_refused(tmp_path):
    write_uff(tmp_path / "x.uff", signal(), func_type=4)
    with pytest.raises(ValueError, match=r"holds no signal in time, function type 1, but the types \[4\]"):
        read_recording(tmp_path / "x.uff")
    write_uff(tmp_path / "x.uff", signal())
    other = tmp_path / "other.uff"
    write_uff(other, signal()[:100])
    with open(tmp_path / "x.uff", "ab") as file:
        file.write(other.read_bytes())
    with pytest.raises(ValueError, match=r"holds signals of different lengths or rates, 100 samples .*, 300 samples"):
        read_recording(tmp_path / "x.uff")


def test_a_sofa_file_is_no_recording(tmp_path):
    write_sofa(tmp_path / "x.sofa", signal(2)[None, :, :50])
    with pytest.raises(
        ValueError, match=r"x\.sofa must hold signals, .*; read impulse responses with paths\.read_path"
    ):
        read_recording(tmp_path / "x.sofa")


def test_a_wav_of_unknown_size_is_read_and_unknown_chunks_are_passed_over(tmp_path):
    write_wav(tmp_path / "x.wav", [0.5, -0.5], FS)
    content = (tmp_path / "x.wav").read_bytes()
    (tmp_path / "x.wav").write_bytes(content[:4] + 4 * b"\xff" + content[8:])
    assert read_recording(tmp_path / "x.wav").samples.tolist() == [0.5, -0.5]
    marked = content + b"cue " + struct.pack("<I", 4) + bytes(4)
    (tmp_path / "x.wav").write_bytes(marked[:4] + struct.pack("<I", len(marked) - 8) + marked[8:])
    assert read_recording(tmp_path / "x.wav").samples.tolist() == [0.5, -0.5]


def test_an_archive_that_is_damaged_inside_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "x.npz", "w") as archive:
        archive.writestr("noise.npy", b"no array")
    with pytest.raises(ValueError, match=r"x\.npz cannot be read as a \.npz file: the magic string is not correct"):
        read_recording(tmp_path / "x.npz", fs=FS)
    buffer = io.BytesIO()
    np.save(buffer, np.zeros(100))
    with zipfile.ZipFile(tmp_path / "x.npz", "w") as archive:
        archive.writestr("noise.npy", buffer.getvalue()[:-8])
    with pytest.raises(ValueError, match=r"x\.npz cannot be read as a \.npz file: cannot reshape"):
        read_recording(tmp_path / "x.npz", fs=FS)


# ---- writing


def test_wav_with_one_peak_shares_one_scale(tmp_path):
    loud = np.array([4.0, -4.0, 1.0])
    for name, samples in (("loud", loud), ("soft", loud / 10)):
        write_wav(tmp_path / f"{name}.wav", samples, 16000, peak=4.0)
        with wave.open(str(tmp_path / f"{name}.wav")) as file:
            assert (file.getsampwidth(), file.getnchannels(), file.getframerate()) == (2, 1, 16000)
            stored = np.frombuffer(file.readframes(3), "<i2")
        np.testing.assert_array_equal(stored, np.round(samples / 4.0 * 32767))


def test_wav_writes_the_tail_of_a_diverged_run_as_silence(tmp_path):
    write_wav(tmp_path / "x.wav", [[1.0, 2.0, np.nan], [1.0, np.nan, np.nan]], 16000)
    assert read_recording(tmp_path / "x.wav").samples.tolist() == [[1.0, 2.0, 0.0], [1.0, 0.0, 0.0]]
    for peak in (None, 2.0):
        write_wav(tmp_path / "x.wav", [1.0, -2.0, np.nan, np.nan], 16000, peak=peak)
        assert read_recording(tmp_path / "x.wav").samples[2:].tolist() == [0.0, 0.0]
    write_wav(tmp_path / "x.wav", [np.nan], 16000)
    assert read_recording(tmp_path / "x.wav").samples.tolist() == [0.0]


@pytest.mark.parametrize("peak", [None, 8.0])
def test_two_channels_come_back_as_they_were_written(tmp_path, peak):
    x = np.clip(np.random.default_rng(1).normal(0, 2, (2, 1000)), -8, 8)
    write_wav(tmp_path / "x.wav", x, 16000, peak=peak)
    assert soundfile.info(tmp_path / "x.wav").channels == 2
    read = read_recording(tmp_path / "x.wav").samples
    expected = x.astype(np.float32) if peak is None else np.round(x / peak * 32767) / 32768
    np.testing.assert_array_equal(read, expected)
    write_wav(tmp_path / "y.wav", x[:1], 16000, peak=peak)
    np.testing.assert_array_equal(read_recording(tmp_path / "y.wav").samples, expected[0])  # one channel drops its axis


def test_the_same_signal_gives_the_same_bytes(tmp_path):
    for peak in (None, 1.0):
        write_wav(tmp_path / "x.wav", [0.5, -0.5], 16000, peak=peak)
        content = (tmp_path / "x.wav").read_bytes()
        assert b"PEAK" not in content  # a chunk with the time of writing
        write_wav(tmp_path / "x.wav", [0.5, -0.5], 16000, peak=peak)
        assert (tmp_path / "x.wav").read_bytes() == content


def test_wav_refusals(tmp_path):
    path = tmp_path / "x.wav"
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
