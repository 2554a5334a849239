"""Files as recorders, oscilloscopes and spreadsheets write them: each gives its samples and its rate, or says what to do."""

from __future__ import annotations

import struct

import numpy as np
import pytest
import scipy.io
import soundfile
from helpers.files import FS, signal, write_uff

from kfopc_filterpy.paths import read_path
from kfopc_filterpy.signals import read_recording

# ---- text


SCOPE = "Time,Channel A\n({unit}),(V)\n\n{rows}"


@pytest.mark.parametrize(
    ("unit", "scale"), [("s", 1.0), ("ms", 1e3), ("us", 1e6), ("µs", 1e6), ("ns", 1e9)]
)
@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_a_line_of_units_gives_the_unit_of_the_times(tmp_path, unit, scale, encoding):
    rows = "".join(f"{n / 48000 * scale:.6f},{n % 3}\n" for n in range(300))
    (tmp_path / "x.csv").write_text(SCOPE.format(unit=unit, rows=rows), encoding=encoding)
    recording = read_recording(tmp_path / "x.csv")
    assert (recording.fs, recording.samples.shape) == (48000, (300,))


@pytest.mark.parametrize(
    "header", ["t/ms;p", "Time [ms];p", "Time_ms;p", '"Zeit (ms)";"Pegel (V)"', "# exported\nms;V"]
)
def test_a_heading_gives_the_unit_of_the_times(tmp_path, header):
    rows = "".join(f"{n * 0.020833:.6f};{n % 3}\n" for n in range(300))  # an interval that was rounded itself
    (tmp_path / "x.csv").write_text(f"{header}\n{rows}")
    assert read_recording(tmp_path / "x.csv").fs == 48000


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (",0\n0,0.0\n1,0.0\n2,1.0\n3,0.5\n", [0, 0, 1, 0.5]),  # a Series of pandas
        (",0\n0,2048\n1,2051\n", [2048, 2051]),
        (",a,b\n0,2048,1\n1,2051,2\n2,2049,3\n", [[2048, 2051, 2049], [1, 2, 3]]),
        ("0,2048\n1,2051\n2,2049\n", [2048, 2051, 2049]),  # the first column counts
        ("left,right\n5,2048\n3,2051\n9,7\n", [[5, 3, 9], [2048, 2051, 7]]),
        ("5,2048\n3,-2051\n9,7\n", [[5, 3, 9], [2048, -2051, 7]]),
        ("Pegel\n0,512\n-0,250\n", [0.512, -0.25]),
        ("0,512\n-0,250\n", [0.512, -0.25]),
        ("1,512\n2,05\n", [1.512, 2.05]),
        ("1,5E-1\n2,5E-1\n", [0.15, 0.25]),
        ("0,512 1,5\n0,250 2,5\n0,1 3,5\n", [[0.512, 0.25, 0.1], [1.5, 2.5, 3.5]]),
        ("t,p,\n0.000,0.5,\n0.125,1.5,\n0.250,2.5,\n", [0.5, 1.5, 2.5]),
        ('"0,0";"0,5"\n"0,125";"1,5"\n"0,25";"2,5"\n', [0.5, 1.5, 2.5]),
        ('"t","p"\n"0,0","0,5"\n"0,125","1,5"\n"0,25","2,5"\n', [0.5, 1.5, 2.5]),
        ('"0.5"\n"1.5"\n', [0.5, 1.5]),
    ],
)
def test_commas_and_quotes_are_what_the_whole_file_says(tmp_path, text, expected):
    (tmp_path / "x.csv").write_text(text)
    assert read_recording(tmp_path / "x.csv", fs=8).samples.tolist() == expected


@pytest.mark.parametrize("text", ["5,512\n3,250\n", "Level\n1,5\n2,5\n3,5\n"])
def test_a_comma_that_may_be_either_is_refused(tmp_path, text):
    (tmp_path / "x.csv").write_text(text)
    with pytest.raises(ValueError, match=r"x\.csv has a comma in each line that may separate .* or be a decimal comma"):
        read_recording(tmp_path / "x.csv", fs=8)


def test_an_empty_field_is_named(tmp_path):
    (tmp_path / "x.csv").write_text("t,a,p\n0.0,,0.5\n0.1,,0.5\n")
    with pytest.raises(ValueError, match=r"x\.csv is text that is no numbers.*; line 2 has an empty field"):
        read_recording(tmp_path / "x.csv", fs=8)


def labview(x_columns="One", decimal=".", comment="", segments=1, delta="1.000000E-4\t1.000000E-4"):
    """Return two channels as LabVIEW writes them, "Write To Measurement File" with one header."""
    text = (
        f"LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\nDecimal_Separator\t{decimal}\nX_Columns\t{x_columns}\n"
        "Time_Pref\tRelative\nDate\t2024/03/01\n***End_of_Header***\t\n\t\n"
    )
    rows = []
    for n in range(3):
        x = "" if x_columns == "No" else f"{n * 1e-4:.6f}"
        between = [x] if x_columns == "Multi" else []
        rows.append("\t".join([x, f"{n}.5", *between, f"-{n}.25", *([comment] if n == 0 and comment else [])]))
    names = ["X_Value", "Left", *(["X_Value"] if x_columns == "Multi" else []), "Right", "Comment"]
    segment = (
        f"Channels\t2\t\t\nSamples\t3\t3\t\nX_Dimension\tTime\tTime\t\nX0\t0.0\t0.0\t\nDelta_X\t{delta}\t\n"
        "***End_of_Header***\t\t\t\n" + "\t".join(names) + "\n" + "\n".join(rows) + "\n"
    )
    text += segment * segments
    return text if decimal == "." else text.replace("0.", "0,").replace("1.", "1,").replace("2.", "2,")


@pytest.mark.parametrize("x_columns", ["One", "No", "Multi"])
@pytest.mark.parametrize("decimal", [".", ","])
@pytest.mark.parametrize("comment", ["", "the fan # 2 starts"])
def test_labview_is_read_with_its_rate(tmp_path, x_columns, decimal, comment):
    (tmp_path / "x.lvm").write_text(labview(x_columns, decimal, comment))
    recording = read_recording(tmp_path / "x.lvm")
    assert recording.samples.tolist() == [[0.5, 1.5, 2.5], [-0.25, -1.25, -2.25]]
    assert (recording.fs, recording.file_fs) == (10000, 10000)


def test_labview_of_several_segments_or_rates_is_refused(tmp_path):
    for settings, message in (
        ({"segments": 3}, r"x\.lvm is a LabVIEW measurement of 3 segments, expected one: export a file for each"),
        ({"delta": "1E-4\t2E-4"}, r"x\.lvm holds channels of different rates"),
    ):
        (tmp_path / "x.lvm").write_text(labview(**settings))
        with pytest.raises(ValueError, match=message):
            read_recording(tmp_path / "x.lvm")


@pytest.mark.parametrize("read", [read_path, read_recording])
@pytest.mark.parametrize(
    "header", ["* Freq(Hz) SPL(dB) Phase(degrees)", "Frequency;SPL", "* Hz Ohms Deg", "* Frequency Step: 0.366 Hz\n* step SPL"]
)
def test_a_frequency_response_is_refused(tmp_path, read, header):
    rows = "".join(f"{20 + 0.366 * n:.3f} 80.0 -90.0\n" for n in range(300))
    (tmp_path / "x.txt").write_text(f"{header}\n{rows}")
    with pytest.raises(ValueError, match=r"x\.txt is a frequency response, .*: export the impulse response"):
        read(tmp_path / "x.txt", fs=16000)
