"""Files as recorders, oscilloscopes and spreadsheets write them: each gives its samples and its rate, or says what to do."""

from __future__ import annotations

import struct
import warnings
import zipfile

import numpy as np
import pytest
import scipy.io
import soundfile
from helpers.files import FS, signal

from kfopc_filterpy.paths import read_path
from kfopc_filterpy.signals import read_recording

# ---- text


@pytest.mark.parametrize(
    ("header", "unit"),
    [
        *((f"Time,Channel A\n({unit}),(V)\n", unit) for unit in ("s", "ms", "us", "µs", "ns")),  # of an oscilloscope
        *((header, "ms") for header in ("t/ms,p", "Time [ms],p", "Time_ms,p", '"Zeit (ms)","Pegel (V)"')),
        ("# exported\nms,V", "ms"),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", "utf-16"])
def test_a_heading_gives_the_unit_of_the_times(tmp_path, header, unit, encoding):
    interval = {"s": 1.0, "ms": 1e3, "ns": 1e9}.get(unit, 1e6) / 48000
    interval = interval if unit == "s" else round(interval, 6)  # some round it before they multiply
    rows = "".join(f"{n * interval:.6f},{n % 3}\n" for n in range(300))
    (tmp_path / "x.csv").write_text(f"{header}\n{rows}", encoding=encoding)
    recording = read_recording(tmp_path / "x.csv")
    assert (recording.fs, recording.samples.shape) == (48000, (300,))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0.5\n-0.25\n1.0\n", [0.5, -0.25, 1]),
        ("# a comment\n\n  0.5 \r\n -0.25\r\n 1.0", [0.5, -0.25, 1]),
        ("t;p\n0,000;0,5\n0,125;-0,25\n0,250;1,0\n", [0.5, -0.25, 1]),
        ("t\tp\n0,000\t0,5\n0,125\t-0,25\n0,250\t1,0\n", [0.5, -0.25, 1]),
        ("\ufefft [s], p [Pa]\n0, 5e-1\n.125, -25E-2\n.25, 1\n", [0.5, -0.25, 1]),
        (",0\n0,0.0\n1,0.0\n2,1.0\n3,0.5\n", [0, 0, 1, 0.5]),  # a Series of pandas
        (",a,b\n0,2048,1\n1,2051,2\n2,2049,3\n", [[2048, 2051, 2049], [1, 2, 3]]),
        ("0,2048\n1,2051\n2,2049\n", [2048, 2051, 2049]),  # the first column counts
        ("left,right\n5,2048\n3,2051\n9,7\n", [[5, 3, 9], [2048, 2051, 7]]),
        ("left,right\n0,1\n1,2\n3,3\n4,4\n", [[0, 1, 3, 4], [1, 2, 3, 4]]),  # that rises, and is no time
        ("5,2048\n3,-2051\n9,7\n", [[5, 3, 9], [2048, -2051, 7]]),
        ("Pegel\n0,512\n-0,250\n", [0.512, -0.25]),
        ("0,512\n-0,250\n", [0.512, -0.25]),
        ("1,5E-1\n2,5E-1\n", [0.15, 0.25]),
        ("0,512 1,5\n0,250 2,5\n0,1 3,5\n", [[0.512, 0.25, 0.1], [1.5, 2.5, 3.5]]),
        ("t,p,\n0.000,0.5,\n0.125,1.5,\n0.250,2.5,\n", [0.5, 1.5, 2.5]),
        ('"0,0";"0,5"\n"0,125";"1,5"\n"0,25";"2,5"\n', [0.5, 1.5, 2.5]),
        ('"t","p"\n"0,0","0,5"\n"0,125","1,5"\n"0,25","2,5"\n', [0.5, 1.5, 2.5]),
        ('"0.5"\n"1.5"\n', [0.5, 1.5]),
    ],
)
def test_separators_commas_and_quotes_are_what_the_whole_file_says(tmp_path, text, expected):
    (tmp_path / "x.csv").write_text(text, encoding="utf-8")
    recording = read_recording(tmp_path / "x.csv", fs=8)
    assert recording.samples.tolist() == expected
    assert recording.file_fs == (8 if "125" in text else None)  # times


@pytest.mark.parametrize(
    ("header", "row", "n_before"),
    [
        ("X,CH1,Start,Increment,\nSequence,Volt,4.0e-05,2.0e-05,\n", "{n},{value},,\n", 2),
        (";Scopy version,48ab2e8\n;Sample rate,50000\nSample,Time(S),CH1(V)\n", "{n},{time:.6f},{value}\n", 0),
        (",time (ms),p\n", "{n},{ms:.3f},{value}\n", 0),  # a table of pandas
        ("Sample Time(ms) p\n", "{n} {ms:.3f} {value}\n", 0),
    ],
)
def test_a_number_of_each_sample_hides_neither_times_nor_rate(tmp_path, header, row, n_before):
    rows = [row.format(n=n, time=n / 50000, ms=n / 50, value=value) for n, value in enumerate(signal())]
    (tmp_path / "x.csv").write_text(header + "".join(rows))
    recording = read_recording(tmp_path / "x.csv")
    assert recording.fs == 50000
    np.testing.assert_array_equal(recording.samples, signal())
    np.testing.assert_array_equal(read_path(tmp_path / "x.csv").samples, [0.0] * n_before + signal().tolist())


@pytest.mark.parametrize("read", [read_path, read_recording])
@pytest.mark.parametrize(
    "header",
    ["* Freq(Hz) SPL(dB) Phase(degrees)", "Frequency;SPL", "* Hz Ohms Deg", "* Frequency Step: 0.366 Hz\n* step SPL"],
)
def test_a_frequency_response_is_refused(tmp_path, read, header):
    rows = "".join(f"{20 + 0.366 * n:.3f} 80.0 -90.0\n" for n in range(300))
    (tmp_path / "x.txt").write_text(f"{header}\n{rows}")
    with pytest.raises(ValueError, match=r"x\.txt is a frequency response, .*: export the impulse response"):
        read(tmp_path / "x.txt", fs=16000)


# ---- sound


def wav(samples, bits: int, block: int, *, claimed: int | None = None, is_extensible: bool = False) -> bytes:
    """Return a WAV file of one channel with the bits and the block size that its header states."""
    data = samples.tobytes() if isinstance(samples, np.ndarray) else samples
    size = len(data) if claimed is None else claimed
    riff = size if size == 0xFFFFFFFF else size + 36
    form = struct.pack("<HHIIHH", 1, 1, FS, FS * block, block, bits)
    if is_extensible:  # its bits are those of the block; the valid ones follow
        form = struct.pack("<HHIIHH", 0xFFFE, 1, FS, FS * block, block, 8 * block)
        form += struct.pack("<HHIIHH8s", 22, bits, 4, 1, 0, 16, b"\x80\0\0\xaa\0\x38\x9b\x71")
        riff = riff if size == 0xFFFFFFFF else riff + 24
    head = struct.pack("<4sI8sI", b"RIFF", riff, b"WAVEfmt ", len(form))
    return head + form + struct.pack("<4sI", b"data", size) + data


def low_bits(bits: int, n_bytes: int) -> np.ndarray:
    """Return a sine of 0.1 as whole numbers in the low bits."""
    whole = np.round(0.1 * np.sin(2 * np.pi * 440 * np.arange(FS) / FS) * 2 ** (bits - 1)).astype("<i4")
    return whole.view(np.uint8).reshape(-1, 4)[:, :n_bytes]


@pytest.mark.parametrize(("bits", "n_bytes"), [(24, 4), (20, 3), (12, 2)])
@pytest.mark.parametrize("high", [False, True])
@pytest.mark.parametrize("is_extensible", [False, True])
def test_samples_with_more_room_than_bits_keep_their_level(tmp_path, bits, n_bytes, high, is_extensible):
    samples = low_bits(bits, n_bytes)
    if high:
        whole = np.pad(samples, ((0, 0), (0, 4 - n_bytes))).copy().view("<i4") << (8 * n_bytes - bits)
        samples = whole.view(np.uint8).reshape(-1, 4)[:, :n_bytes]
    content = wav(np.ascontiguousarray(samples), bits, n_bytes, is_extensible=is_extensible)
    (tmp_path / "x.wav").write_bytes(content)
    level = np.sqrt(np.mean(read_recording(tmp_path / "x.wav").samples ** 2))
    assert level == pytest.approx(0.1 / np.sqrt(2), rel=1e-3)  # 12 bits: steps of 0.5 % of the sine


def test_32_bits_that_may_be_24_in_the_low_ones_are_warned_of(tmp_path):
    """As arecord 1.2.10 and later write S24_LE; a quiet recording, or one with 24 high bits, may look similar."""
    for samples, is_told in (
        (low_bits(24, 4), True),
        (low_bits(32, 4), False),
        (low_bits(24, 4).view("<i4") // 512 * 256, False),
    ):
        (tmp_path / "x.wav").write_bytes(wav(np.ascontiguousarray(samples), 32, 4))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            read_recording(tmp_path / "x.wav")
        assert ["S24_LE, its numbers are 48 dB too small" in str(one.message) for one in caught] == [True] * is_told


@pytest.mark.parametrize(
    "after",
    [
        *(b"\0" * 500, b"LIST\x04\0\0\0INFO", b"\0id3 \x02\0\0\0ab", b"TAG" + b"song" * 31 + b"\0", b"\r\n"),
        *(b"odd \x01\0\0\0x", b"cue \x04\0\0\0" + bytes(4)),
    ],
)
@pytest.mark.parametrize("is_counted", [True, False])
def test_what_follows_the_samples_and_is_no_sound_is_passed_over(tmp_path, after, is_counted):
    content = wav((signal() * 2**15).astype("<i2"), 16, 2)
    size = len(content) - 8 + len(after) * is_counted
    (tmp_path / "x.wav").write_bytes(content[:4] + struct.pack("<I", size) + content[8:] + after)
    np.testing.assert_array_equal(read_recording(tmp_path / "x.wav").samples, signal())


# ---- MATLAB


SIGNAL = signal()[:, None]
TIMES = np.arange(300)[:, None] / FS
SCOPE_5 = {"Tstart": -10 / FS, "Tinterval": 1 / FS, "Length": 300.0, "A": SIGNAL.astype(np.float32)}


@pytest.mark.parametrize(
    ("content", "version"),
    [
        ({"p": SIGNAL, "Tinterval": 1 / FS}, "4"),
        ({"p": SIGNAL, "t": TIMES}, "4"),
        ({"p": SIGNAL, "t": TIMES.astype(np.float32) + 5}, "5"),
        ({"p": SIGNAL, "dt": 1 / FS, "fs": float(FS)}, "5"),
        (SCOPE_5, "5"),
        ({"meas": {"p": SIGNAL, "Fs": float(FS)}, "fs": 1.0}, "5"),
        ({"meas": {"p": SIGNAL}, "fs": float(FS)}, "5"),
        ({"meas": {"p": SIGNAL, "time": TIMES}}, "5"),
    ],
)
def test_matlab_files_have_their_own_rate(tmp_path, content, version):
    scipy.io.savemat(tmp_path / "x.mat", content, format=version)
    recording = read_recording(tmp_path / "x.mat")
    np.testing.assert_array_equal(recording.samples, signal())
    assert (recording.fs, recording.file_fs) == (FS, FS)
    assert read_recording(tmp_path / "x.mat", fs=FS / 2).samples.shape == (150,)  # resampled, not relabelled


def test_a_path_from_a_scope_begins_at_its_trigger(tmp_path):
    taps = np.where(TIMES < 10 / FS, 0, SIGNAL)
    scipy.io.savemat(tmp_path / "x.mat", SCOPE_5 | {"A": taps})
    np.testing.assert_array_equal(read_path(tmp_path / "x.mat").samples, taps[10:, 0])


@pytest.mark.parametrize(("asked", "fs"), [({"file_fs": 48000}, 48000), ({"file_fs": 48}, 48), ({"fs": 48}, 48)])
@pytest.mark.parametrize("read", [read_path, read_recording])
def test_a_rate_that_may_be_in_khz_is_confirmed(tmp_path, asked, fs, read):
    scipy.io.savemat(tmp_path / "x.mat", {"p": SIGNAL, "fs": 48.0})
    recording = read(tmp_path / "x.mat", **asked)
    np.testing.assert_array_equal(recording.samples, signal())
    assert (recording.fs, recording.file_fs) == (fs, 48 if "fs" in asked else None)


def hdf5_struct(path, content):
    """Write a struct as MATLAB's `save -v7.3` does: a group, its fields with swapped axes."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, fields in content.items():
            group = file.create_group(name)
            group.attrs["MATLAB_class"] = np.bytes_("struct")
            for field, value in fields.items():
                is_text = isinstance(value, str)
                value = np.array([*map(ord, value)], np.uint16) if is_text else value
                data = group.create_dataset(field, data=np.atleast_2d(value).T)
                data.attrs["MATLAB_class"] = np.bytes_("char" if is_text else "double")
        group["itself"] = group  # which only a damaged file has
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")


@pytest.mark.parametrize("write", [scipy.io.savemat, hdf5_struct])
def test_the_fields_of_a_struct_are_named(tmp_path, write):
    path = tmp_path / "x.mat"
    write(path, {"P": {"ir": SIGNAL, "fs": 8000.0}, "S": {"ir": 2 * SIGNAL, "fs": float(FS)}})
    with pytest.raises(ValueError, match=r"holds several variables: P\.fs .*, P\.ir .*; choose .* x\.mat:P\.ir\)"):
        read_path(path)
    chosen = read_path(path, variable="S.ir")
    assert chosen.fs == FS
    np.testing.assert_array_equal(chosen.samples, 2 * signal())
    with pytest.raises(ValueError, match=r"variable 'S' of .*x\.mat must hold real numbers, got (a )?struct"):
        read_path(path, variable="S")


@pytest.mark.parametrize("shape", [(32, 4, 4), (4, 32, 4), (4, 4, 4)])
@pytest.mark.parametrize("suffix", ["mat", "npy"])
def test_a_matrix_of_paths_whose_taps_are_not_last_is_asked_for_its_axes(tmp_path, shape, suffix):
    path, taps = tmp_path / f"x.{suffix}", np.ones(shape)
    scipy.io.savemat(path, {"S": taps}) if suffix == "mat" else np.save(path, taps)
    with pytest.raises(ValueError, match=rf"\({shape[0]}, {shape[1]}, 4\).*microphones, loudspeakers, taps"):
        read_path(path, fs=FS)


# ---- what a file states


def times(form, fs, n=400, unit_s=1.0):
    return "".join(f"{n / fs / unit_s:{form}},{300 + n % 7}\n" for n in range(n))


def a_simulink_structure(path):
    """Write what Simulink's To Workspace logs as "Structure With Time"."""
    one = np.empty((1, 1), [(name, object) for name in ("values", "dimensions", "label")])
    one[0, 0] = (SIGNAL, 1.0, "p")
    whole = np.empty((1, 1), [(name, object) for name in ("time", "signals", "blockName")])
    whole[0, 0] = (TIMES, one, "fan/To Workspace")
    scipy.io.savemat(path, {"simout": whole})


def a_flac_from_a_pipe(path):
    soundfile.write(path, signal(), FS)
    content = bytearray(path.read_bytes())
    content[21] &= 0xF0  # the 36 bits of the number of samples in STREAMINFO
    content[22:26] = bytes(4)
    path.write_bytes(content)


def a_bw64(path):
    soundfile.write(path, signal(), FS, format="RF64", subtype="PCM_16")
    path.write_bytes(b"BW64" + path.read_bytes()[4:])


def a_short_bw64(path):
    path.write_bytes(b"BW64" + wav(np.int16(2**15 * signal()), 16, 2)[4:])


def a_workbook(path):
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("[Content_Types].xml", "<Types/>")
        file.writestr("xl/workbook.xml", "<workbook/>")


def quiet_or_16_bits_in_the_low_24(path):
    path.write_bytes(wav(np.resize(np.int32(2**15 * signal()) * 256, FS).view(np.uint8), 24, 4))


def rows(row):
    return "t,p\n" + "".join(f"{row(n)}\n" for n in range(300))


def an_older_tektronix():
    """Its columns stand beside its header."""
    facts = ["Record Length,300,Points", "Sample Interval,2e-5,s", '"Trigger Time","0 12:00:00",'] + 297 * [",,"]
    times = [(n - 100) * 2e-5 for n in range(300)]
    return "".join(f"{one},{t:.12f},   {x:.5f},\n" for one, t, x in zip(facts, times, signal(), strict=True))


def variables(**beside):
    return lambda path: scipy.io.savemat(path, {"p": SIGNAL, **beside})


def a_file(content):
    return lambda path: path.write_bytes(content)


def a_wav(samples, bits, block, **options):
    return lambda path: path.write_bytes(wav(np.ascontiguousarray(samples), bits, block, **options))


def sound(kind, coding=None):
    return lambda path: soundfile.write(path, signal(1, 48000), 48000, format=kind, subtype=coding)


def two_units(path):
    np.savez(path, p=np.c_[SIGNAL, SIGNAL], units=["mPa", "V"], fs=FS)


DIGITS = "\n".join(f"{abs(value):.9f}" for value in signal())
# A file's name; its text, or what writes it; how it is asked for; its rate, unit and first samples, or the error.
STATED = [
    ("rate.txt", "Sample Rate: 48000 Hz. Linear scale\n0.5\n1\n", {"fs": 48000}, (48000, "1", [0.5, 1])),
    ("khz.csv", "fs [kHz];51,2\np [kPa]\n0,5\n1,0\n", {}, (51200, "Pa", [500, 1000])),
    ("thousands.txt", "Sampling frequency = 48,000 Hz\n0.5\n1\n", {}, (48000, "1", [0.5, 1])),
    ("step.txt", "sample interval: 20 us\n0.5\n1\n", {}, (50000, "1", [0.5, 1])),
    ("scale.txt", "FS: 10 V\n0.5\n1\n", {"fs": 8000}, (8000, "1", [0.5, 1])),
    ("two.csv", "Sample Rate,8000\nt,p\n" + times(".6f", 16000), {}, "states a sampling rate of 8000 Hz, but its times give 16000"),
    ("one.csv", "Sample Rate,16000\nt,p\n" + times(".6f", 16000), {}, (16000, "1", [300, 301])),
    ("given.txt", "Sample Rate: 48000 Hz\n0.5\n1\n", {"file_fs": 16000}, "a sampling rate of 48000 Hz, but file_fs = 16000"),
    ("mpa.csv", "t (s),P (mPa)\n" + times(".7f", 16000), {"unit": "Pa"}, (16000, "Pa", [0.3, 0.301])),
    ("own.csv", "t (s),P (mPa)\n" + times(".7f", 16000), {}, (16000, "Pa", [0.3, 0.301])),
    ("volt.csv", "Time,A\n(ms),(mV)\n" + times(".4f", 16000, unit_s=1e-3), {"unit": "Pa", "unit_per_full_scale": 20}, (16000, "Pa", [6, 6.02])),
    ("other.csv", "t (s),u [V]\n" + times(".7f", 16000), {"unit": "Pa"}, "is in V, but unit = 'Pa': .* unit_per_full_scale"),
    ("twice.csv", "t (s),P (Pa)\n" + times(".7f", 16000), {"unit": "Pa", "unit_per_full_scale": 2}, "is in Pa, .* already"),
    ("both.csv", "P (Pa);u (V)\n1,5;2\n2,5;3\n0;1\n", {"fs": 8000}, (8000, "Pa, V", [[1.5, 2.5, 0], [2, 3, 1]])),
    ("one.csv", "P (mPa);u (V)\n1,5;2\n2,5;3\n0;1\n", {"fs": 8000, "channel": 0, "unit": "Pa"}, (8000, "Pa", [1.5e-3, 2.5e-3, 0])),
    ("name.csv", "t,A\n" + times(".6f", 16000), {"unit": "Pa"}, (16000, "Pa", [300, 301])),
    ("ampere.csv", "t,I\ns,mA\n" + times(".6f", 16000), {}, (16000, "A", [0.3, 0.301])),
    ("delta.txt", "Delta_X\t2.0E-5\t2.0E-5\nLeft\tRight\n0.5\t1\n1\t2\n0\t1\n", {}, (50000, "1", [[0.5, 1, 0], [1, 2, 1]])),
    ("path.txt", "S [mPa/mV]\n0.5\n1\n", {"fs": 8000}, (8000, "Pa/V", [0.5, 1])),
    ("alone.txt", "mPa/V\n0.5\n1\n", {"fs": 8000}, (8000, "Pa/V", [5e-4, 1e-3])),
    ("slash.txt", "S/mPa/V\n0.5\n1\n", {"fs": 8000}, (8000, "Pa/V", [5e-4, 1e-3])),
    ("none.txt", "S (counts/V)\n0.5\n1\n", {"fs": 8000}, (8000, "1", [0.5, 1])),
    ("unit.mat", variables(unit="mPa", fs="16 kHz"), {}, (FS, "Pa", signal()[:2] / 1e3)),
    ("unit.mat", variables(p_units="V", units="Pa", fs="16000"), {"unit": "Pa"}, "is in V, but unit = 'Pa'"),
    ("unit.mat", variables(unit="counts", fs_kHz=16), {}, (FS, "counts", signal()[:2])),
    ("unit.mat", variables(unit="Pa", fs="16 kHz", dt_us=50), {}, r"several sampling rates beside 'p', \[16000.0, 20000.0\]"),
    ("unit.mat", variables(fs=-16e3), {}, "must be greater than 0 Hz, got -16000"),
    ("unit.mat", variables(unit="Pa", Fs="16"), {}, "a sampling rate of 16 Hz: is it in kHz"),
    ("unit7.mat", lambda path: hdf5_struct(path, {"m": {"p": SIGNAL, "units": "mV", "fs": FS}}), {}, (FS, "V", signal()[:2] / 1e3)),
    ("unit.npz", lambda path: np.savez(path, p=SIGNAL, unit="mPa", t_ms=1e3 * TIMES), {}, (FS, "Pa", signal()[:2] / 1e3)),
    ("units.npz", two_units, {"channel": 1}, (FS, "V", signal()[:2])),
    ("units.npz", two_units, {}, (FS, "Pa, V", np.array([1e-3, 1])[:, None] * signal()[:2])),
    ("units.mat", variables(units=np.array(["Pa", "V"], object), fs=FS), {}, r"states 2 units in 'units', \['Pa', 'V'\], for 1 "),
    ("few.csv", "t,p\n" + times(".5f", 44100), {}, (44100, "1", [300, 301])),
    ("fewer.csv", "t,p\n" + times(".5f", 48000), {}, (48000, "1", [300, 301])),
    ("odd.csv", "t,p\n" + times(".5f", 44000), {}, (44000, "1", [300, 301])),
    ("empty.csv", ",0.1,0.5\n,0.2,1\n,0.0,7\n", {"fs": 8000}, (8000, "1", [[0.1, 0.2, 0], [0.5, 1, 7]])),
    ("fortran.txt", " 1.0D-03\n -2.D+00\n", {"fs": 8000}, (8000, "1", [0.001, -2])),
    ("rows.txt", "1 2 3\n4 5 6\n7 8\n", {"fs": 8000}, "number of columns changed from 3 to 2 at row 3"),
    ("hash.txt", "1.5\n2.5\n#3\n4.5\n", {"fs": 8000}, "'#3' among its numbers"),
    ("hash.txt", "1.5\n2.5\n# a door\n4.5\n", {"fs": 8000}, (8000, "1", [1.5, 2.5, 4.5])),
    *(("cut.txt", DIGITS[:-cut], {"fs": 8000}, "ends within a line") for cut in (1, 5, 9)),
    *(("whole.txt", DIGITS + end, {"fs": 8000}, (8000, "1", np.round(np.abs(signal()), 9))) for end in ("", "\n")),
    *((name, a_file(content), {"fs": 8000}, rf"{name} (is text that is no numbers|is neither text nor)")
      for name in ("x.csv", "x.unknown")
      for content in (b"Dear Sir or Madam,\nno numbers\n", bytes(range(128, 256)) * 9, b"\n\n\n", b"\0" * 99)),
    ("end.txt", "1\n2\nstopped by user\n", {"fs": 8000}, r"end\.txt is damaged or cut short, .* columns changed from 1 to 3 at row 3"),
    ("square.npy", lambda path: np.save(path, np.eye(4)), {"fs": 8000}, r"\(4, 4\): which axis is time"),
    ("t.npy", lambda path: np.save(path, np.c_[TIMES, SIGNAL]), {}, (FS, "1", signal()[:2])),
    ("t.mat", lambda path: scipy.io.savemat(path, {"to_file": np.c_[TIMES, SIGNAL].T}), {}, (FS, "1", signal()[:2])),
    ("t8.mat", lambda path: scipy.io.savemat(path, {"a": np.c_[TIMES, SIGNAL], "fs": 8e3}), {}, "8000 Hz, but its times give 16000"),
    ("simulink.mat", a_simulink_structure, {}, (FS, "1", signal()[:2])),
    ("ragged.mat", lambda path: scipy.io.savemat(path, {"m": {"ir": [np.ones(3), np.ones(4)]}}), {}, r"m\.ir \(a cell or struct array: store"),
    ("pipe.flac", a_flac_from_a_pipe, {}, (FS, "1", signal()[:2])),
    ("bw64.wav", a_bw64, {}, (FS, "1", signal()[:2])),
    ("short.wav", a_short_bw64, {}, (FS, "1", signal()[:2])),
    ("sheet.xlsx", a_workbook, {}, r"an archive without arrays: .* save the sheet as \.csv"),
    ("s24.wav", quiet_or_16_bits_in_the_low_24, {}, r"fit the high as well as the low .*S24_LE; record it"),
    ("a fan.ogg", lambda path: soundfile.write(path, signal(), FS), {}, "ffmpeg -i 'a fan.ogg' -c:a pcm_f32le 'a fan-pcm.wav'"),
    ("scope.csv", an_older_tektronix(), {}, (50000, "1", np.round(signal(), 5))),
    *(("x.csv", text, {"fs": 8}, r"x\.csv has commas that may separate columns or be decimal commas")
      for text in ("5,512\n3,250\n", "Level\n1,5\n2,5\n3,5\n", "t,p\n0,000,0,5\n0,125,1,5\n")),
    ("x.csv", "t,a,p\n0.0,,0.5\n0.1,,0.5\n", {"fs": 8}, r"x\.csv is text that is no numbers.*; line 2 has an empty field"),
    ("x.txt", "*1000Hz -38.6\n" + "".join(f"{20 * 1.02**n:.2f} 0.1\n" for n in range(300)), {"fs": FS},
     r"x\.txt .* of a frequency response or a microphone's calibration file, export"),
    ("x.csv", rows(lambda n: f"{n / 50000:.4f},1"), {}, r"rises in uneven steps, from 0 to 0\.0001: export .* all digits"),
    ("x.csv", rows(lambda n: f"{n // 2 / 25000:.6f},1"), {}, "rises in uneven steps"),  # the least and the largest of each
    ("x.csv", "p (kPa)\n1e308\n", {"fs": FS}, r"x\.csv must be finite"),
    ("x.csv", "0 1\n1 2\ninf 3\n", {"fs": FS}, r"x\.csv must be finite"),
    ("x.csv", "-1.7e308 1\n0 2\n1.7e308 3\n", {"fs": FS}, (FS, "1", [[-1.7e308, 0, 1.7e308], [1, 2, 3]])),
    ("x.csv", rows(lambda n: f"{20 * n},0.5"), {}, r"rises in steps of 20 without a unit: .* \"Time \(ms\)\""),
    ("x.csv", rows(lambda n: f"{n / 50000:.6f},1.#INF"), {}, r"x\.csv is text that is no numbers"),
    ("x.csv", rows(lambda n: f"{n / 50000:.6f},{'1.#INF' if n == 200 else 1}"), {}, r"damaged or cut short, .*'1\.#INF' .* at row 200"),
    ("x.csv", rows(lambda n: f"{n / 50000:.6f},{'1'[: n != 200]}"), {}, "cut short, or has an empty field: .* at row 201$"),
    ("x.csv", rows(lambda n: f"{n / 50000:.6f}\0,0.5"), {}, r"x\.csv is neither text nor of a kind that is read"),
    ("x.csv", rows(lambda n: f"12:00:{n / 50000:09.6f},0.5"), {}, r"times of day \(hh:mm:ss\) are not read"),
    ("x.csv", rows(lambda n: f"{n / 50:.6f},0.5"), {}, "a sampling rate of 50 Hz: is it in kHz, .* file_fs=50000 or 50 "),
    ("bits.wav", a_wav(low_bits(24, 4), 20, 4), {}, r"bits\.wav states 20 bits in blocks of 4 bytes"),
    ("bits.wav", a_wav(low_bits(30, 4), 24, 4, is_extensible=True), {}, r"bits\.wav states 24 bits in blocks of 4 bytes"),
    *(("pipe.wav", a_wav(np.int16(2**15 * signal()), 16, 2, claimed=claimed), {}, (FS, "1", signal()))
      for claimed in (0xFFFFFFFF, 0x7FFFF000, 0x80000000)),
    *(("x.wav", a_wav(low_bits(16, 2), 16, 2, claimed=claimed), {},  # of a recorder that was interrupted
       rf"for {32000 - claimed} bytes after the end of its samples .* ffmpeg -ignore_length 1 -i x\.wav ") for claimed in (0, 10000)),
    *((f"x.{suffix}", content, {}, rf"x\.{suffix} .*convert it to WAV, for example with: ffmpeg -i x\.{suffix} ")
      for suffix, content in {
          "mp3": sound("MP3"), "ogg": sound("OGG", "VORBIS"), "opus": sound("OGG", "OPUS"), "au": sound("AU", "PCM_16"),
          "w64": sound("W64", "PCM_16"), "caf": sound("CAF", "PCM_16"), "bin": sound("CAF", "PCM_16"),
          "m4a": lambda path: path.write_bytes(b"\0\0\0\x20ftypM4A \0\0\0\0" + bytes(2000))}.items()),
    *(("x.wav", sound(*kind), {}, r"x\.wav .*record it again") for kind in (("WAV", "IMA_ADPCM"), ("WAV", "ULAW"), ("OGG", "VORBIS"))),
    ("x.mat", variables(fs=8000.0, dt=1e-4), {}, r"states several sampling rates beside 'p', \[8000\.0, 10000\.0\] Hz"),
    ("x.mat", variables(t=TIMES**2), {}, r"x\.mat has times in uneven steps"),
    ("x.mat", variables(dt=0.0), {}, r"x\.mat states a sample interval of 0 s"),
    ("x.mat", variables(dt=1000 / FS), {}, r"x\.mat states a sampling rate of 16 Hz: is it in kHz"),
    ("x.mat", variables(Fs=51.2), {}, r"51\.2 Hz: is it in kHz, .* file_fs=51200 or 51\.2 \(in a command --file-fs\)"),
    ("x.mat", lambda path: scipy.io.savemat(path, {"ir": np.array([SIGNAL, "text"], dtype=object), "fs": float(FS)}), {},
     r"x\.mat holds no signal: fs \(1, 1\), ir \(cell\); choose .* x\.mat:ir\)"),  # a rate beside it is none
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "asked", "expected"), STATED, ids=[one[0] for one in STATED])
@pytest.mark.filterwarnings("ignore:.*times of few digits")
def test_what_a_file_states_is_read_or_asked_about(tmp_path, name, content, asked, expected):
    path = tmp_path / name
    path.write_text(content, encoding="utf-8") if isinstance(content, str) else content(path)
    if isinstance(expected, str):
        with pytest.raises(ValueError, match=expected):
            read_recording(path, **asked)
        return
    recording = read_recording(path, **asked)
    assert (recording.fs, recording.unit) == expected[:2]
    n = np.shape(expected[2])[-1]
    np.testing.assert_allclose(recording.samples[..., :n], expected[2], rtol=1e-14)


def test_an_open_file_is_refused(tmp_path):
    (tmp_path / "x.txt").write_text("0.5\n")
    with open(tmp_path / "x.txt", "rb") as file, pytest.raises(TypeError, match="path of a file, got BufferedReader: "):
        read_recording(file)


def test_a_rate_by_times_of_few_digits_is_said(tmp_path):
    (tmp_path / "x.csv").write_text("t,p\n" + times(".5f", 44100))
    numbers = np.loadtxt(tmp_path / "x.csv", delimiter=",", skiprows=1)
    scipy.io.savemat(tmp_path / "x.mat", {"a": numbers})
    scipy.io.savemat(tmp_path / "t.mat", {"a": numbers[:, 1], "t": numbers[:, 0]})
    for name in ("x.csv", "x.mat", "t.mat"):
        with pytest.warns(UserWarning, match=r"which allow 44088 Hz \+- 49 Hz: it is taken to be sampled at 44100 Hz"):
            read_recording(tmp_path / name)
