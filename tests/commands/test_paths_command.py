"""`kfopc paths`: impulse responses from recordings, and what they are like."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from helpers.commands import FS

from kfopc_filterpy.paths import read_path
from kfopc_filterpy.signals import band_limited_noise, write_wav


@pytest.mark.parametrize("suffix", ["wav", "npy", "csv", "txt"])
def test_a_path_is_identified_from_a_recording(command, folder, tmp_path, suffix):
    rng = np.random.default_rng(0)
    sent = rng.standard_normal(2 * FS)
    taps = rng.standard_normal(24) * 0.8 ** np.arange(24)
    write_wav(folder / "sent.wav", sent, FS)
    write_wav(folder / "received.wav", np.convolve(sent, taps), FS)  # recorded a little longer
    output = tmp_path / f"S.{suffix}"
    code, out, _ = command("paths", "identify", "sent.wav", "received.wav", "--taps", 24, "-o", output)
    assert code == 0
    assert "24 taps" in out
    found = read_path(output, file_fs=FS if suffix == "npy" else None)
    assert found.fs == FS
    if suffix in ("csv", "txt"):
        assert np.loadtxt(output, delimiter="," if suffix == "csv" else "\t").shape == (24, 2)
    np.testing.assert_allclose(found.samples, taps, atol=1e-4)


@pytest.mark.parametrize(("low", "high", "is_narrow"), [(300, 600, True), (20, 150, True), (100, 1500, False)])
def test_the_band_in_which_a_path_is_known_is_told(command, folder, tmp_path, low, high, is_narrow):
    sent = band_limited_noise((low, high), 4.0, fs=FS, rng=3)
    heard = np.convolve(sent, np.eye(16)[5]) + 1e-3 * np.random.default_rng(4).standard_normal(sent.size + 15)
    write_wav(folder / "sent.wav", sent, FS)
    write_wav(folder / "received.wav", heard, FS)
    fit = ["paths", "identify", "sent.wav", "received.wav", "--taps", 16, "-o", tmp_path / "S.wav"]
    code, out, err = command(*fit)
    assert code == 0
    share, db, *edges = re.search(
        r"all but (\S+) % of the response \((\S+) dB\); excited from (\d+) to (\d+) Hz", out
    ).groups()
    assert 10 * np.log10(float(share) / 100) == pytest.approx(float(db), abs=2.0)  # one digit
    assert [int(edge) for edge in edges] == pytest.approx([low, high], abs=50)
    assert (f"sent.wav excites the path from {edges[0]} to {edges[1]} Hz only: " in err) == is_narrow
    facts = json.loads(command(*fit, "--json")[1])
    assert [f"{facts[f'excited_{edge}_hz']:.0f}" for edge in ("low", "high")] == edges


def test_noise_of_the_whole_band_is_not_narrow_at_a_low_rate(command, folder, tmp_path):
    sent = np.random.default_rng(3).standard_normal(3001)
    for name, signal in (("sent.txt", sent), ("received.txt", np.convolve(sent, np.eye(16)[5])[: sent.size])):
        np.savetxt(folder / name, signal)
    fit = ["paths", "identify", "sent.txt", "received.txt", "--taps", 16, "-o", tmp_path / "S.npy", "--file-fs"]
    code, out, err = command(*fit, 250)
    assert (code, err) == (0, "")
    assert "excited from 0 to 125 Hz" in out


def test_files_that_a_path_does_not_explain_are_refused_and_nothing_is_written(command, folder, tmp_path):
    write_wav(folder / "other.wav", band_limited_noise((100, 1500), 3.0, fs=FS, rng=2), FS)
    code, out, err = command("paths", "identify", "noise.wav", "other.wav", "--taps", 24, "-o", tmp_path / "S.wav")
    assert (code, out) == (2, "")
    assert re.search(
        r"noise.wav explains \d\.\d % of other.wav, hardly more than chance would: are the files swapped", err
    )
    assert not (tmp_path / "S.wav").exists()


def test_a_path_has_the_units_of_its_recordings(command, folder, tmp_path):
    sent = np.random.default_rng(1).standard_normal(FS)
    for name, unit, signal in (("sent", "V", sent), ("heard", "Pa", 0.5 * sent)):
        np.savetxt(folder / f"{name}.csv", signal, header=f"x ({unit})", comments="")
    fit = ("paths", "identify", "sent.csv", "heard.csv", "--file-fs", FS, "--taps", 4, "-o", tmp_path / "S.csv")
    assert command(*fit)[0] == 0
    path = read_path(tmp_path / "S.csv")
    assert (path.unit, path.fs) == ("Pa/V", FS)
    np.testing.assert_allclose(path.samples, [0.5, 0, 0, 0], atol=1e-4)


def test_a_latency_that_is_longer_than_the_fit_is_named(command, folder, tmp_path):
    sent = np.random.default_rng(1).standard_normal(2 * FS)
    write_wav(folder / "sent.wav", sent, FS)
    write_wav(folder / "late.wav", np.convolve(np.eye(1000)[920], sent)[: sent.size], FS)
    fit = ("paths", "identify", "sent.wav", "late.wav", "-o", tmp_path / "S.wav", "--taps")
    code, _, err = command(*fit, 512)
    assert code == 2
    assert "late.wav comes 115 ms after sent.wav, but --taps 512 last 64 ms: give --taps 1432, or" in err
    assert command(*fit, 1432)[0] == 0


def test_a_fit_that_leaves_much_unexplained_is_warned_of(command, folder, tmp_path):
    sent = np.random.default_rng(1).standard_normal(2 * FS)
    write_wav(folder / "sent.wav", sent, FS)
    write_wav(folder / "noisy.wav", sent + 0.3 * np.random.default_rng(2).standard_normal(sent.size), FS)
    code, out, err = command("paths", "identify", "sent.wav", "noisy.wav", "--taps", 8, "-o", tmp_path / "S.wav")
    assert code == 0
    assert "8 taps" in out
    assert "warning: sent.wav explains 91." in err  # 1 / 1.09
    assert "-10.8 dB are noise, or come later than 1 ms" in err
    write_wav(folder / "heard.wav", sent + 0.05 * np.random.default_rng(2).standard_normal(sent.size), FS)
    assert command("paths", "identify", "sent.wav", "heard.wav", "--taps", 8, "-o", tmp_path / "S.wav")[2] == ""


def test_a_recording_given_as_a_path_is_analysed_with_a_warning(command, folder):
    write_wav(folder / "long.wav", np.random.default_rng(0).standard_normal(8 * FS), FS)
    code, out, err = command("paths", "inspect", "long.wav", "--primary", "long.wav")
    assert code == 0
    assert "64000 taps at 8000 Hz, 8 s;" in out
    assert (
        "kfopc paths inspect: warning: long.wav lasts 8 s, too long for an impulse response: is it a recording?" in err
    )
    assert command("paths", "inspect", "S.wav")[2] == ""


def test_a_path_is_inspected(command):
    code, out, _ = command("paths", "inspect", "S.wav", "--primary", "P.wav", "--json")
    assert code == 0
    facts = json.loads(out)
    assert facts["onset_s"] == pytest.approx(12 / FS)
    assert facts["causality_margin_s"] == pytest.approx(14 / FS)
    assert facts["power_gain_db"] == pytest.approx(0.0, abs=1e-9)
    code, out, _ = command("paths", "inspect", "P.wav", "--primary", "S.wav")
    assert code == 0
    assert "too late" in out


@pytest.mark.parametrize("output", ["no/S.wav", "S.mp3"])
def test_a_path_that_could_not_be_written_is_refused_before_it_is_made(command, output):
    code, _, err = command("paths", "identify", "missing.wav", "missing.wav", "--taps", 8, "-o", output)
    assert code == 2
    assert output.split("/")[0] in err
    assert "missing.wav" not in err


def test_a_matrix_of_paths_is_inspected(command, several, tmp_path):
    _, primary, secondary = several
    secondary = secondary.copy()
    secondary[0, 1] = 0.0
    np.save(tmp_path / "S.npy", secondary)
    np.save(tmp_path / "P.npy", primary)
    arguments = ["paths", "inspect", tmp_path / "S.npy", "--primary", tmp_path / "P.npy", "--file-fs", FS]
    code, out, _ = command(*arguments, "--json")
    assert code == 0
    facts = json.loads(out)
    assert [(one["microphone"], one["loudspeaker"]) for one in facts["paths"]] == [(1, 1), (1, 2), (2, 1), (2, 2)]
    assert [one["onset_s"] for one in facts["paths"]] == [12 / FS, None, 16 / FS, 12 / FS]
    assert [one["power_gain_db"] for one in facts["paths"]] == pytest.approx(
        [0.0, None, 20 * np.log10(0.3), 20 * np.log10(0.8)], abs=1e-9
    )
    assert facts["causality_margin_s"] == pytest.approx(14 / FS)  # 26 - 12 and 28 - 12 samples
    code, out, _ = command(*arguments)
    assert code == 0
    assert "microphone 1, loudspeaker 2:\n64 taps at 8000 Hz, 8 ms; silent" in out
    assert "early enough" in out
