"""Recordings: every format against what wrote it, units and rates; and files that are wrong, each with its message."""

from __future__ import annotations

import pickle
import struct
import sys
import wave

import numpy as np
import pytest
import scipy.io
import soundfile
from helpers.files import FS, WRITERS, signal

from kfopc_filterpy.paths import read_path
from kfopc_filterpy.signals import Recording, read_recording, write_wav
from kfopc_filterpy.signals.recordings import calibration_factor

# ---- every format


@pytest.mark.parametrize("read", [read_recording, read_path])
@pytest.mark.parametrize("name", [name for name in WRITERS if name not in ("x.npy", "x.csv")])
def test_every_format_gives_what_was_written(name, read, tmp_path):
    WRITERS[name](tmp_path / name)
    recording = read(tmp_path / name)
    expected = signal(2) if recording.samples.ndim == 2 else signal()
    np.testing.assert_array_equal(recording.samples, expected)  # text has 17 digits, single precision 16 bits exactly
    assert (recording.samples.dtype, recording.samples.flags.c_contiguous) == (np.float64, True)
    assert (recording.fs, recording.file_fs, recording.name) == (FS, FS, name)
    assert recording.unit == "1"


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


@pytest.mark.parametrize("name", ["pcm16.wav", "x.flac", "x.aiff", "x.npz", "new.mat", "plain.mat", "timed.csv"])
def test_a_file_without_a_known_suffix_is_known_by_how_it_begins(name, tmp_path):
    WRITERS[name](tmp_path / name)
    (tmp_path / "recording.bin").write_bytes((tmp_path / name).read_bytes())
    expected = read_recording(tmp_path / name).samples
    np.testing.assert_array_equal(read_recording(tmp_path / "recording.bin").samples, expected)


@pytest.mark.parametrize(("shape", "kind"), [((5, 1), np.float64), ((1, 5), np.float32), ((5,), np.int16)])
@pytest.mark.parametrize("write", [np.save, np.savez, lambda path, x: scipy.io.savemat(path, {"x": x})])
def test_vectors_of_any_shape_and_type_are_read(tmp_path, shape, kind, write):
    write(tmp_path / "x", np.arange(5).astype(kind).reshape(shape))
    (path,) = tmp_path.iterdir()
    read = read_recording(path, fs=FS).samples
    assert (read.dtype, read.tolist()) == (np.float64, [0, 1, 2, 3, 4])


@pytest.mark.parametrize("order", ["C", "F"])
def test_the_longer_axis_of_an_array_is_time(tmp_path, order):
    table = np.array(signal(3, 10), order=order)
    for stored in (table, table.T):
        np.save(tmp_path / "x.npy", stored)
        np.testing.assert_array_equal(read_recording(tmp_path / "x.npy", fs=FS).samples, table)


def test_a_variable_of_several_is_chosen_by_name(tmp_path):
    scipy.io.savemat(tmp_path / "x.mat", {"b": [1.0, 2.0], "a": [3.0, 4.0], "Fs": 8000.0, "who": "me", "z": [1j, 2.0]})
    np.savez(tmp_path / "x.npz", a=[1.0, 2.0], b=[3.0, 4.0])
    write_wav(tmp_path / "x.wav", [1.0, 2.0], FS)
    chosen = read_recording(tmp_path / "x.mat", variable="a")
    assert (chosen.samples.tolist(), chosen.fs) == ([3.0, 4.0], 8000.0)
    assert read_recording(tmp_path / "x.npz", variable="b", fs=FS).samples.tolist() == [3.0, 4.0]
    for name, variable, message in (
        ("x.mat", None, r"holds several variables: Fs \(1, 1\), a \(1, 2\), b \(1, 2\), z \(1, 2\); choose"),
        ("x.mat", "c", r"variable 'c' is not in .*; it holds: Fs .*, a .*, b "),
        ("x.mat", "who", "variable 'who' of .* must hold real numbers, got text"),
        ("x.mat", "z", "variable 'z' of .* must hold real numbers, got complex128"),
        ("x.npz", None, r"holds several variables: a \(2,\), b \(2,\); choose one with the option variable"),
        ("x.wav", "b", "is an audio file, which has no named variables: leave out the option variable"),
    ):
        with pytest.raises(ValueError, match=message):
            read_recording(tmp_path / name, variable=variable)


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
        text = file.create_dataset("unit", data=np.uint64([0, 0]))  # MATLAB's ''
        text.attrs["MATLAB_class"], text.attrs["MATLAB_empty"] = np.bytes_("char"), np.uint8(1)
        complex_numbers = np.zeros((1, 3), dtype=[("real", "f8"), ("imag", "f8")])
        file.create_dataset("z", data=complex_numbers).attrs["MATLAB_class"] = np.bytes_("double")
        file["elsewhere"] = h5py.ExternalLink(str(tmp_path / "other.mat"), "noise")
        outside = file.create_dataset("outside", (4,), "f8", external=[(str(path), 0, 32)])
        outside.attrs["MATLAB_class"] = np.bytes_("double")
    two = read_recording(path, variable="two")
    np.testing.assert_array_equal(two.samples, signal(2).astype(np.float32))
    assert two.unit == "1"
    for name, message in (
        ("none", r"variable 'none' of .* is empty"),
        ("z", r"variable 'z' of .* must hold real numbers, got complex numbers"),
        ("text", r"variable 'text' of .* must hold real numbers, got text"),
        ("elsewhere", r"variable 'elsewhere' of .* must hold real numbers, got a link to another file"),
        ("outside", r"'outside' of .* refers to other files"),
        ("paths", r"must hold signals, .* got shape \(2, 3, 4\); read impulse responses with paths\.read_path"),
    ):
        with pytest.raises(ValueError, match=message):
            read_recording(path, variable=name)


# ---- rates and units


def test_a_recording_is_resampled_and_keeps_its_height(tmp_path):
    def tones(fs):
        t = np.arange(fs) / fs
        return np.array([np.sin(2 * np.pi * 1000 * t), np.cos(2 * np.pi * 300 * t)])

    write_wav(tmp_path / "x.wav", tones(44100), 44100)
    recording = read_recording(tmp_path / "x.wav", fs=16000)
    assert (recording.samples.shape, recording.fs, recording.file_fs) == ((2, 16000), 16000, 44100)
    assert "2 x 16000 samples at 16000 Hz (44100 Hz in the file)" in repr(recording)
    # The filter of resample_poly ripples by less than 0.3 % in its pass band.
    np.testing.assert_allclose(recording.samples[:, 100:-100], tones(16000)[:, 100:-100], atol=3e-3)


def test_rates_that_contradict_or_have_no_ratio_are_refused(tmp_path):
    write_wav(tmp_path / "x.wav", np.ones(200), FS)
    for rates, message in (
        ({"file_fs": 8000}, r"x\.wav states a sampling rate of 16000 Hz, but file_fs = 8000 Hz: leave it out"),
        ({"fs": 16000 * np.pi}, "sample rates must be in a ratio of whole numbers"),
        ({"fs": 1e308}, "fs must be a sampling rate from"),
        ({"fs": FS * 50_000}, r"resampled from 16000 to 8e\+08 Hz it has 1e\+07 samples"),
    ):
        with pytest.raises(ValueError, match=message):
            read_recording(tmp_path / "x.wav", **rates)


def test_a_scale_comes_with_its_unit(tmp_path):
    write_wav(tmp_path / "x.wav", [0.5, -0.25], FS)
    scaled = read_recording(tmp_path / "x.wav", unit="Pa", unit_per_full_scale=8)
    assert (scaled.samples.tolist(), scaled.unit) == ([4.0, -2.0], "Pa")
    assert repr(scaled).endswith("in Pa>")
    named = read_recording(tmp_path / "x.wav", unit="V")
    assert (named.samples.tolist(), named.unit) == ([0.5, -0.25], "V")
    for options, message in (
        ({"unit_per_full_scale": 8}, "unit_per_full_scale needs the unit of its result"),
        ({"unit": "Pa", "unit_per_full_scale": 0}, "unit_per_full_scale must be greater than 0"),
        ({"unit": "V", "calibrator": tmp_path / "x.wav"}, "calibrator gives scale and unit"),
    ):
        with pytest.raises(ValueError, match=message):
            read_recording(tmp_path / "x.wav", **options)


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
    write_wav(tmp_path / "mono.wav", tone(0.1), 48000)
    write_wav(tmp_path / "x.wav", [[0.5, 0.5], [0.5, 0.5]], FS)
    for channel, calibrator, expected in ((0, "calibrator", 5.012), (1, "calibrator", 10.024), (1, "mono", 5.012)):
        read = read_recording(tmp_path / "x.wav", channel=channel, calibrator=tmp_path / f"{calibrator}.wav")
        np.testing.assert_allclose(read.samples, expected, rtol=1e-4)
    with pytest.raises(ValueError, match=r"calibrator\.wav has 2 channels where one is needed"):
        read_recording(tmp_path / "x.wav", calibrator=tmp_path / "calibrator.wav")


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
    with pytest.raises(ValueError, match=r"has 2 channels where one is needed: read it with channel=0 to channel=1"):
        both.one_channel()
    for channel in (0, 1):
        one = read_recording(tmp_path / "x.wav", channel=channel)
        np.testing.assert_array_equal(one.one_channel(), both.samples[channel])
    with pytest.raises(ValueError, match=r"x\.wav has channels 0 and 1 \(counted from 0\), got channel 2"):
        read_recording(tmp_path / "x.wav", channel=2)
    with pytest.raises(ValueError, match="channel must be at least 0"):
        read_recording(tmp_path / "x.wav", channel=-1)


def test_a_recording_cannot_be_changed_or_made_of_nothing():
    recording = Recording([1, 2], 8000)
    with pytest.raises(AttributeError):
        recording.fs = 1
    assert repr(recording) == "<Recording: 0.00025 s, 2 samples at 8000 Hz>"
    for samples, fs, message in (([], 1, "at least 1 value"), ([np.inf], 1, "the signal of x must be"), ([1], 0, "fs")):
        with pytest.raises(ValueError, match=message):
            Recording(samples, fs, name="x")


# ---- files that are wrong


@pytest.mark.parametrize("name", ["x.wav", "x.flac", "x.mat", "x.npy", "x.npz", "x.csv", "x.unknown"])
def test_a_file_that_is_missing_empty_or_something_else_is_refused(name, tmp_path):
    with pytest.raises(FileNotFoundError, match=rf"{name} does not exist or is not a file; the current folder is"):
        read_recording(tmp_path / name)
    for content, message in (
        (b"", r" is empty \(0 bytes\): record or export it again"),
        (b"RIFF", ""),
        (bytes(range(256)) * 8, ""),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=name + message):
            read_recording(tmp_path / name, fs=FS)


@pytest.mark.parametrize("name", [name for name in WRITERS if not name.endswith(".csv")])
def test_a_truncated_file_is_refused(name, tmp_path):
    path = tmp_path / name
    WRITERS[name](path)
    content = path.read_bytes()
    for n_bytes in (200, 2) if b"fmt " in content[:64] else (200,):  # WAV says how long it is
        path.write_bytes(content[:-n_bytes])
        with pytest.raises(ValueError, match=f"{name} (is cut short|is damaged|cannot be read as a)"):
            read_recording(path, fs=FS)


def test_a_file_without_samples_is_refused(tmp_path):
    for name in ("x.wav", "x.aiff", "x.flac"):
        soundfile.write(tmp_path / name, np.zeros((0, 2)), FS)
    np.save(tmp_path / "x.npy", np.zeros((2, 0)))
    with open(tmp_path / "two.npy", "wb") as file:
        np.save(file, signal())
        np.save(file, signal())
    np.savez(tmp_path / "x.npz", noise=np.zeros(0))
    scipy.io.savemat(tmp_path / "x.mat", {"noise": np.zeros((0, 0))})
    (tmp_path / "x.csv").write_text("left,right\n")
    for name, message in (
        ("x.wav", "holds no samples: its header claims zero frames"),
        ("x.aiff", "holds no samples: its header claims zero frames"),
        ("x.flac", r"is empty \(0 bytes\)"),  # libsndfile writes nothing
        ("x.npy", r"holds no samples, shape \(2, 0\)"),
        ("two.npy", "goes on after its array: save one array"),
        *((name, rf"variable 'noise' of .*{name} is empty") for name in ("x.npz", "x.mat")),
        ("x.csv", "is text that is no numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            read_recording(tmp_path / name, fs=FS)


def test_nan_is_refused_with_its_place_and_only_in_the_channel_that_is_read(tmp_path):
    table = np.array([[0.0, np.nan, 0.0], [0.0, 0.0, 1.0]])
    soundfile.write(tmp_path / "x.wav", table.T, FS, subtype="FLOAT")
    np.save(tmp_path / "x.npy", table)
    np.savetxt(tmp_path / "x.csv", table.T, delimiter=",")
    scipy.io.savemat(tmp_path / "x.mat", {"noise": table})
    for name, time in {"x.wav": f", {1 / FS:g} s", "x.npy": "", "x.csv": "", "x.mat": ""}.items():
        with pytest.raises(
            ValueError, match=rf"{name} must be finite, .* \(0, 1\){time}\); export it again without gaps"
        ):
            read_recording(tmp_path / name, fs=FS)
        assert read_recording(tmp_path / name, channel=1, fs=FS).samples.tolist() == [0.0, 0.0, 1.0]


def test_nothing_is_unpickled(tmp_path):
    class Trap:
        def __reduce__(self):
            return open, (str(tmp_path / "sprung"), "w")

    np.save(tmp_path / "x.npy", np.array([Trap(), Trap()], dtype=object), allow_pickle=True)
    np.savez(tmp_path / "x.npz", noise=np.array([Trap(), Trap()], dtype=object))
    (tmp_path / "pickled.npy").write_bytes(pickle.dumps(Trap()))
    for name, variable, message in (
        ("x.npy", None, r"x\.npy must hold real numbers, got object"),
        ("x.npz", None, r"x\.npz holds no signal: no array of real numbers"),
        ("x.npz", "noise", "variable 'noise' of .* must hold real numbers, got object"),
        ("pickled.npy", None, r"pickled\.npy cannot be read as a \.npy file"),
    ):
        with pytest.raises(ValueError, match=message):
            read_recording(tmp_path / name, variable=variable, fs=FS)
    assert not (tmp_path / "sprung").exists()


def test_without_its_library_the_error_names_the_extra(tmp_path, monkeypatch):
    WRITERS["new.mat"](tmp_path / "new.mat")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ModuleNotFoundError, match=r"new\.mat is .* which needs h5py: .*pip install -e .\.\[formats\]."):
        read_recording(tmp_path / "new.mat")


# ---- writing


def test_wav_writes_the_tail_of_a_diverged_run_as_silence(tmp_path):
    write_wav(tmp_path / "x.wav", [[1.0, 2.0, np.nan], [1.0, np.nan, np.nan]], 16000)
    assert read_recording(tmp_path / "x.wav").samples.tolist() == [[1.0, 2.0, 0.0], [1.0, 0.0, 0.0]]
    for peak in (None, 2.0):
        write_wav(tmp_path / "x.wav", [1.0, -2.0, np.nan, np.nan], 16000, peak=peak)
        assert read_recording(tmp_path / "x.wav").samples[2:].tolist() == [0.0, 0.0]
    write_wav(tmp_path / "x.wav", [np.nan], 16000)
    assert read_recording(tmp_path / "x.wav").samples.tolist() == [0.0]


def test_two_channels_come_back_as_they_were_written_and_one_without_its_axis(tmp_path):
    x = np.clip(np.random.default_rng(1).normal(0, 2, (2, 1000)), -8, 8)
    for peak, expected in ((None, x.astype(np.float32)), (8.0, np.round(x / 8 * 32767) / 32768)):
        for rows in (slice(2), slice(1)):
            write_wav(tmp_path / "x.wav", x[rows], 16000, peak=peak)
            np.testing.assert_array_equal(read_recording(tmp_path / "x.wav").samples, np.squeeze(expected[rows]))


def test_the_same_signal_gives_the_same_bytes(tmp_path):
    for peak in (None, 1.0):
        write_wav(tmp_path / "x.wav", [0.5, -0.5], 16000, peak=peak)
        content = (tmp_path / "x.wav").read_bytes()
        assert b"PEAK" not in content  # a chunk with the time of writing
        write_wav(tmp_path / "x.wav", [0.5, -0.5], 16000, peak=peak)
        assert (tmp_path / "x.wav").read_bytes() == content


@pytest.mark.parametrize(
    ("signal", "options", "message"),
    [
        ([np.nan, 1.0], {}, "signal must be finite.*index 0"),  # no tail
        ([np.inf], {}, "signal must be finite"),
        ([[1.0], [2.0]], {}, "signal must have its channels first"),
        ([1.0], {"fs": 16000.5}, "fs must be a whole number of Hz"),
        ([2.0], {"peak": 1.0}, "signal reaches 2, beyond peak = 1; raise peak"),
    ],
)
def test_wav_refusals(signal, options, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        write_wav(tmp_path / "x.wav", signal, **{"fs": 16000} | options)
    assert not (tmp_path / "x.wav").exists()
