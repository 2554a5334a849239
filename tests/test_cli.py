"""The command line: exit codes of real processes, one-line errors, JSON, files."""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import soundfile

from kfopc_filterpy import FxLMS, cli, noise_reduction_db, output_power, simulate
from kfopc_filterpy.bench import assess
from kfopc_filterpy.bench.assessment import SCHEMA
from kfopc_filterpy.cli_inputs import OPTIONS, in_options
from kfopc_filterpy.paths import resample_path
from kfopc_filterpy.signals import band_limited_noise, write_wav

FS = 8000
ROOT = Path(__file__).resolve().parents[1]
SCENE = ["noise.wav", "--primary", "P.wav", "--secondary", "S.wav"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Files of a scene: full control takes a power of 1 of it."""
    here = tmp_path_factory.mktemp("recordings")
    x = band_limited_noise((100, 1500), 3.0, fs=FS, rng=1, power=1.0)
    primary, secondary = np.eye(64)[26], np.eye(64)[12]
    signals = {"noise": x, "P": primary, "S": secondary, "d": np.convolve(x, primary)[: x.size], "stereo": [x, x]}
    for name, signal in signals.items():
        write_wav(here / f"{name}.wav", signal, FS)
    write_wav(here / "S16.wav", np.asarray(resample_path(secondary, 2 * FS, fs=FS)), 2 * FS)
    write_wav(here / "silent.wav", np.zeros(64), FS)
    write_wav(here / "short.wav", signals["d"][:20000], FS)
    (here / "empty.wav").write_bytes(b"")
    (here / "text.wav").write_text("these are words")
    return here


@pytest.fixture
def command(folder, monkeypatch, capsys):
    """Run the command in the folder; return its exit code, output and errors."""
    monkeypatch.chdir(folder)

    def run(*arguments: object) -> tuple[int, str, str]:
        try:
            code = cli.main([str(one) for one in arguments])
        except SystemExit as end:
            code = int(end.code or 0)
        return code, *capsys.readouterr()

    return run


def process(folder: Path, *arguments: str, standard_input: bytes | None = None) -> subprocess.CompletedProcess:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "kfopc_filterpy", *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, input=standard_input)


def test_a_process_ends_with_0_if_the_amplifier_is_enough_and_writes_what_it_says(folder, tmp_path):
    out = tmp_path / "out"
    rating = ["--watt", "10", "--ohm", "8", "--volts-per-unit", "4", "--pascal-per-unit", "1"]
    ended = process(folder, "verdict", *SCENE, *rating, "--taps", "32", "-o", str(out))
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.startswith(b"Enough: KF-PB reaches")
    assert sorted(path.name for path in out.iterdir()) == ["audio", "figures", "tables", "verdict.html", "verdict.json"]
    data = json.loads((out / "verdict.json").read_text(encoding="utf-8"))
    jsonschema.validate(data, json.loads(SCHEMA.read_text(encoding="utf-8")))
    assert data["enough"] is True
    assert data["rating"]["rated_power"] == pytest.approx(10 * 8 / 16)
    assert data["levels"]["before_dba"] > data["levels"]["after_dba"]


def test_a_process_ends_with_1_if_it_is_not_and_reads_its_standard_input(folder):
    scene = ["-", *SCENE[1:], "--rated-power", "0.05", "--taps", "32", "--json", "--quiet"]
    ended = process(folder, "verdict", *scene, standard_input=(folder / "noise.wav").read_bytes())
    assert ended.returncode == 1, ended.stderr
    data = json.loads(ended.stdout)
    assert data["limited_by"] == "amplifier"
    assert data["rating"]["ohm"] is None


def test_a_process_ends_with_2_and_one_line_if_the_input_is_wrong(folder):
    ended = process(folder, "verdict", "nose.wav", *SCENE[1:], "--rated-power", "1")
    assert ended.returncode == 2
    assert ended.stdout == b""
    assert ended.stderr.startswith(b"kfopc verdict: nose.wav does not exist")
    assert ended.stderr.count(b"\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["verdict"], "the following arguments are required: noise, --secondary; see kfopc verdict --help"),
        (["verdikt"], "invalid choice"),
        (["verdict", *SCENE], "a rating is needed: --watt 20 --ohm 8, or --rated-power 1.6"),
        (["verdict", *SCENE, "--watt", "20"], "need --ohm"),
        (["verdict", *SCENE, "--watt", "20", "--ohm", "8", "--rated-power", "1"], "leave out one of them"),
        (["verdict", *SCENE, "--watt", "twenty", "--ohm", "8"], "invalid float value: 'twenty'"),
        (["verdict", *SCENE, "--watt", "-20", "--ohm", "8"], "--watt must be greater than 0"),
        (
            ["verdict", "noise.wav", "--secondary", "S.wav", "--rated-power", "1"],
            "--primary or --disturbance is needed",
        ),
        (["verdict", "stereo.wav", *SCENE[1:], "--rated-power", "1"], "choose with --channel 0 to --channel 1"),
        (["verdict", "stereo.wav", *SCENE[1:], "--rated-power", "1", "--channel", "2"], "channel must be below the 2"),
        (["verdict", *SCENE[:3], "--secondary", "S16.wav", "--rated-power", "1"], "for example with --fs 16000"),
        (["verdict", "empty.wav", *SCENE[1:], "--rated-power", "1"], "empty.wav"),
        (["verdict", "text.wav", *SCENE[1:], "--rated-power", "1"], "cannot be read as an audio file"),
        (["verdict", *SCENE, "--rated-power", "1", "--algorithm", "KF"], "--algorithm must be one of 'KF-PB'"),
        (["verdict", *SCENE, "--rated-power", "1", "-o", "noise.wav"], "cannot be written"),
        (["verdict", *SCENE, "--loudspeaker-watt", "1"], "a loudspeaker's rating needs --ohm"),
        (["verdict", *SCENE, "--rated-power", "1", "--ohm", "8", "--x-max-mm", "1"], "must be given together"),
        (["compare", *SCENE, "--rated-power", "1", "--algorithm", "KF"], "--algorithm must be one of"),
        (
            ["compare", *SCENE, "--rated-power", "1", "--ohm", "-1", "--algorithm", "none"],
            "--ohm must be greater than 0",
        ),
        (["verdict", *SCENE, "--rated-power", "1", "--volts-per-unit", "0"], "--volts-per-unit must be greater than 0"),
        (["paths", "convert", "S.wav", "S.xyz"], "must end in .wav, .npy, .csv, .txt"),
        (["paths", "identify", "noise.wav", "d.wav", "--taps", "0", "-o", "S.npy"], "--taps must be at least 1"),
        (["verdict", *SCENE, "--rated-power", "1", "--want-db", "-3"], "--want-db must not be negative"),
        (["verdict", *SCENE, "--rated-power", "1", "--taps", "0"], "--taps must be at least 1"),
        (["verdict", *SCENE, "--rated-power", "1", "--path-error-samples", "-1"], "--path-error-samples must not be"),
        (
            ["verdict", *SCENE, "--ohm", "8", "--loudspeaker-watt", "1", "--programme-watt", "2"],
            "leave out one of them",
        ),
        # Files that do not go together are named.
        (
            ["verdict", "noise.wav", "--primary", "noise.wav", "--secondary", "S.wav", "--rated-power", "1"],
            "noise.wav has 24000 samples (3 s), noise.wav 24000 (3 s): an impulse response must be shorter",
        ),
        (
            ["compare", "S.wav", "--primary", "P.wav", "--secondary", "noise.wav", "--rated-power", "1"],
            "P.wav has 64 samples (0.008 s), S.wav 64 (0.008 s): an impulse response must be shorter than the noise, "
            "and at most 10 s long; cut the impulse response, or are the files swapped?",
        ),
        (["verdict", *SCENE[:3], "--secondary", "silent.wav", "--rated-power", "1"], "silent.wav is silent"),
        (
            ["verdict", "noise.wav", "--disturbance", "short.wav", "--secondary", "S.wav", "--rated-power", "1"],
            "short.wav has 20000 samples, noise.wav 24000: they must be recorded together",
        ),
        (
            ["paths", "identify", "noise.wav", "d.wav", "--taps", "20000", "-o", "x.npy"],
            "--taps must be at most 12000 for recordings of 24000 samples, got 20000",
        ),
        (["paths", "convert", "S.wav"], "S.wav -o S.csv"),
        (
            ["paths", "convert", "S.wav", "S.csv", "--bogus", "3"],
            "unrecognized arguments: --bogus 3; see kfopc paths convert",
        ),
    ],
    ids=lambda value: "-".join(value).replace("/", "") if isinstance(value, list) else "",
)
def test_an_error_is_one_line_that_says_what_to_do(command, arguments, message):
    code, out, err = command(*arguments)
    assert code == 2
    assert out == ""
    assert message in err
    assert err.count("\n") == 1
    assert err.startswith("kfopc")


@pytest.mark.parametrize("name", ["jinja2", "PIL"])
def test_a_missing_library_is_named_with_its_extra_before_anything_runs(command, monkeypatch, name, tmp_path):
    from kfopc_filterpy.bench import assessment_page

    found = assessment_page.find_spec
    monkeypatch.setattr(assessment_page, "find_spec", lambda one: None if one == name else found(one))
    code, _, err = command("verdict", *SCENE, "--rated-power", "1", "-o", tmp_path / "out")
    assert code == 2
    assert name in err
    assert "extra `studies`" in err
    assert not (tmp_path / "out").exists()


def test_a_missing_tqdm_is_named_with_its_extra(command, monkeypatch):
    monkeypatch.setitem(sys.modules, "tqdm", None)
    code, _, err = command("verdict", *SCENE, "--rated-power", "1")
    assert code == 2
    assert "tqdm" in err
    assert "extra `studies`" in err


@pytest.mark.parametrize(
    "arguments",
    [[], ["verdict"], ["compare"], ["paths"], ["paths", "identify"], ["paths", "inspect"], ["paths", "plot"]],
)
def test_help_says_what_it_does_and_shows_an_example(command, arguments):
    code, out, _ = command(*arguments, "--help")
    assert code == 0
    assert "usage: kfopc" in out
    if arguments != ["paths"]:
        assert "example" in out
        assert f"  kfopc {' '.join(arguments)}".rstrip() in out


def test_an_argument_is_translated_only_where_it_is_one():
    """It stands at the start, has a value, or is no word; and the command has the option."""
    options = argparse.Namespace(taps=1, fs=None, channel=None)
    assert in_options("n_taps must be 1, or n_taps=2; with fs=16000", options) == (
        "--taps must be 1, or --taps 2; with --fs 16000"
    )
    assert in_options("the channel of fs and n_taps.wav", options) == "the channel of fs and n_taps.wav"
    assert in_options("block must be 1, block=2", options) == "block must be 1, block=2"


def test_every_option_that_messages_name_exists(command):
    commands = (["verdict"], ["compare"], ["run"], ["paths", "resample"])
    helps = " ".join(command(*one, "--help")[1] for one in commands)
    assert [option for option in OPTIONS.values() if not re.search(rf"{option}\b", helps)] == []


def test_a_file_of_one_channel_is_left_alone_by_the_choice_of_a_channel(command):
    options = ["--rated-power", "4", "--taps", "32", "--json", "--algorithm", "FxLMS"]
    code, chosen, _ = command("verdict", "stereo.wav", *SCENE[1:], *options, "--channel", "1")
    assert code == 0
    assert chosen == command("verdict", *SCENE, *options)[1]


def test_a_verdict_names_options_in_its_advice_and_on_its_page(command, tmp_path):
    write = ["-o", tmp_path / "out"]
    code, out, _ = command("verdict", *SCENE, "--rated-power", "4", "--taps", "8", "--want-db", "12", *write)
    assert code == 1
    told = " ".join(out.split())
    assert "8 taps last 1 ms, but the noise arrives up to 1.9 ms later than the loudspeaker's sound" in told
    assert "take a longer filter with --taps 32." in told
    assert "--taps 32" in (tmp_path / "out" / "verdict.html").read_text(encoding="utf-8")


def test_a_verdict_notes_a_short_or_clipped_recording_in_terminal_and_json(command, folder):
    clipped = np.clip(band_limited_noise((100, 1500), 6.0, fs=FS, rng=1, power=1.0), -1, 1)
    write_wav(folder / "clipped.wav", clipped, FS)
    options = [*SCENE[1:], "--rated-power", "4", "--taps", "16", "--json", "--algorithm", "FxLMS"]
    _, out, err = command("verdict", "noise.wav", *options)
    assert any("lasts only 3 s" in note for note in json.loads(out)["notes"])
    assert "kfopc verdict: note: noise lasts only 3 s" in err
    for resampled in ([], ["--fs", "4000"]):  # which hides that samples are equal
        _, out, err = command("verdict", "clipped.wav", *options, *resampled)
        assert sum("is clipped" in note for note in json.loads(out)["notes"]) == 1
        assert "is clipped" in err


def test_rates_that_differ_are_resampled_each_in_its_way(command):
    """An impulse response keeps its gain, so that the power needed stays the same: 1 for full control."""
    scene = [*SCENE[:3], "--secondary", "S16.wav", "--rated-power", "4", "--taps", "32", "--json"]
    code, out, _ = command("verdict", *scene, "--fs", FS)
    assert code == 0
    assert json.loads(out)["unlimited_power"] == pytest.approx(1.0, rel=0.1)


def test_a_second_measurement_of_the_path_may_tell_how_well_it_is_known(command, folder):
    write_wav(folder / "other.wav", np.eye(64)[15], FS)  # three samples later: 150 % wrong at 700 Hz
    scene = [*SCENE, "--rated-power", "4", "--taps", "32", "--json"]
    same, _, _ = command("verdict", *scene, "--secondary-again", "S.wav")
    code, out, _ = command("verdict", *scene, "--secondary-again", "other.wav")
    assert (same, code) == (0, 0)
    assert json.loads(out)["limited_by"] is None  # the path is learned


def test_a_loudspeakers_curves_are_read_from_files(command, folder):
    (folder / "impedance.csv").write_text("20,7\n80,40\n300,6.4\n")
    (folder / "displacement.csv").write_text("20,0.5\n4000,0.5\n")
    rating = ["--watt", "100", "--ohm", "8", "--loudspeaker-watt", "1", "--impedance", "impedance.csv"]
    options = ["--taps", "32", "--json", "--algorithm", "KF-PB"]
    code, out, _ = command("verdict", *SCENE, *rating, *options)
    assert code == 0
    assert json.loads(out)["rating"]["rated_power"] == pytest.approx(6.4)
    excursion = ["--x-max-mm", "0.1", "--displacement", "displacement.csv"]
    code, out, _ = command("verdict", *SCENE, *rating, *excursion, *options)
    assert code == 1
    data = json.loads(out)
    assert data["rating"]["decided_by"] == "loudspeaker's excursion"
    assert data["rating"]["rated_power"] == pytest.approx((0.1 / 2 / 0.5) ** 2, rel=0.01)  # a response without colour
    (folder / "words.csv").write_text("Hz,mm\n")
    code, _, err = command("verdict", *SCENE, *rating, "--x-max-mm", "1", "--displacement", "words.csv")
    assert code == 2
    assert "words.csv must hold two numbers in a line" in err


# Paths.


def test_a_path_is_identified_from_a_recording(command, folder, tmp_path):
    rng = np.random.default_rng(0)
    sent = rng.standard_normal(2 * FS)
    taps = rng.standard_normal(24) * 0.8 ** np.arange(24)
    write_wav(folder / "sent.wav", sent, FS)
    write_wav(folder / "received.wav", np.convolve(sent, taps), FS)  # recorded a little longer
    code, out, _ = command("paths", "identify", "sent.wav", "received.wav", "--taps", 24, "-o", tmp_path / "S.wav")
    assert code == 0
    assert "24 taps" in out
    found, fs = soundfile.read(tmp_path / "S.wav")
    assert fs == FS
    np.testing.assert_allclose(found, taps, atol=1e-4)


def test_files_that_a_path_does_not_explain_are_refused_and_nothing_is_written(command, folder, tmp_path):
    write_wav(folder / "other.wav", band_limited_noise((100, 1500), 3.0, fs=FS, rng=2), FS)
    code, out, err = command("paths", "identify", "noise.wav", "other.wav", "--taps", 24, "-o", tmp_path / "S.wav")
    assert (code, out) == (2, "")
    assert re.search(
        r"noise.wav explains \d\.\d % of other.wav, hardly more than chance would: are the files swapped", err
    )
    assert not (tmp_path / "S.wav").exists()


def test_a_fit_that_leaves_much_unexplained_is_warned_of(command, folder, tmp_path):
    sent = np.random.default_rng(1).standard_normal(2 * FS)
    write_wav(folder / "sent.wav", sent, FS)
    write_wav(folder / "noisy.wav", sent + 0.3 * np.random.default_rng(2).standard_normal(sent.size), FS)
    code, out, err = command("paths", "identify", "sent.wav", "noisy.wav", "--taps", 8, "-o", tmp_path / "S.wav")
    assert code == 0
    assert "8 taps" in out
    assert "warning: sent.wav explains 91." in err  # 1 / 1.09
    assert "longer than 1 ms" in err
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


def test_a_written_path_may_be_named_by_an_option(command, tmp_path):
    for action, more in (("convert", []), ("resample", ["--fs", FS])):
        output = tmp_path / f"{action}.npy"
        assert command("paths", action, "S.wav", "-o", output, *more)[0] == 0
        np.testing.assert_array_equal(np.load(output), np.eye(64)[12])


@pytest.mark.parametrize("suffix", ["wav", "npy", "csv", "txt"])
def test_a_path_is_converted_without_loss(command, tmp_path, suffix):
    output = tmp_path / f"S.{suffix}"
    code, _, _ = command("paths", "convert", "S.wav", output)
    assert code == 0
    if suffix == "wav":
        taps = soundfile.read(output)[0]
    elif suffix == "npy":
        taps = np.load(output)
    else:
        times, taps = np.loadtxt(output, delimiter="," if suffix == "csv" else "\t").T
        np.testing.assert_allclose(times, np.arange(64) / FS, rtol=1e-12)
    np.testing.assert_array_equal(taps, np.eye(64)[12])


def test_a_path_is_resampled_with_its_gain(command, tmp_path):
    code, _, _ = command("paths", "resample", "S.wav", tmp_path / "S.wav", "--fs", 2 * FS)
    assert code == 0
    taps, fs = soundfile.read(tmp_path / "S.wav")
    assert fs == 2 * FS
    assert taps.sum() == pytest.approx(1.0, abs=0.01)
    assert int(np.argmax(np.abs(taps))) == 24


def test_a_path_is_inspected_and_plotted(command, tmp_path):
    code, out, _ = command("paths", "inspect", "S.wav", "--primary", "P.wav", "--json")
    assert code == 0
    facts = json.loads(out)
    assert facts["onset_s"] == pytest.approx(12 / FS)
    assert facts["causality_margin_s"] == pytest.approx(14 / FS)
    assert facts["power_gain_db"] == pytest.approx(0.0, abs=1e-9)
    code, out, _ = command("paths", "inspect", "P.wav", "--primary", "S.wav")
    assert code == 0
    assert "too late" in out
    code, _, _ = command("paths", "plot", "P.wav", "S.wav", "-o", tmp_path / "paths.png")
    assert code == 0
    assert (tmp_path / "paths.png").read_bytes().startswith(b"\x89PNG")
    code, out, _ = command("paths", "plot", "P.wav", "S.wav", "-o", tmp_path / "plots")
    assert out == f"{tmp_path / 'plots.png'} written\n"
    assert (tmp_path / "plots.png").is_file()


# Comparisons.


def test_algorithms_are_compared_on_ones_own_files(command, tmp_path):
    scene = [*SCENE, "--rated-power", "0.3", "--taps", "16", "--seconds", "1.5", "--algorithm", "FxLMS,KF-OPC"]
    code, out, _ = command("compare", *scene, "-o", tmp_path / "out")
    assert code == 0
    assert "FxLMS" in out
    assert "KF-OPC" in out
    assert (tmp_path / "out" / "report.html").is_file()
    results = json.loads((tmp_path / "out" / "results.json").read_text())["studies"]["own-data"]["algorithms"]
    assert results["FxLMS"]["output_power"] > 0.3  # without a constraint
    assert results["KF-OPC"]["output_power"] < 0.33


# Data.


def test_the_measured_data_are_listed_and_an_unknown_name_is_refused(command, tmp_path):
    code, out, _ = command("data", "list", "--folder", tmp_path, "--json")
    assert code == 0
    facts = json.loads(out)
    assert facts["duct"]["fs"] == 16000
    assert facts["duct"]["here"] is False
    assert facts["duct"]["licence"]
    code, out, _ = command("data", "where", "--folder", tmp_path)
    assert (code, out.strip()) == (0, str(tmp_path))
    code, _, err = command("data", "fetch", "fan")
    assert code == 2
    assert "there is no data set 'fan'; there are duct" in err


def test_a_folder_of_data_that_is_named_but_does_not_exist_is_said(command, tmp_path, monkeypatch):
    monkeypatch.setenv("KFOPC_DATA", str(tmp_path / "nowhere"))
    code, _, err = command("data", "list")
    assert code == 0
    assert f"the folder {tmp_path / 'nowhere'} does not exist: correct --folder or KFOPC_DATA" in err
    assert command("data", "list", "--folder", tmp_path)[2] == ""


def test_a_calibrators_recording_gives_the_levels(command, folder):
    """94 dB are 1 Pa rms, recorded here as 0.5: the noise of power 1 then has 2 Pa, 100 dB."""
    t = np.arange(FS) / FS
    write_wav(folder / "calibrator.wav", 0.5 * np.sqrt(2) * np.sin(2 * np.pi * 1000 * t), FS)
    options = [*SCENE, "--rated-power", "4", "--taps", "32", "--json", "--calibrator", "calibrator.wav"]
    code, out, _ = command("verdict", *options)
    assert code == 0
    bands = np.array(json.loads(out)["levels"]["before_db"])
    assert 10 * np.log10(np.sum(10 ** (bands / 10))) == pytest.approx(100.0, abs=0.3)
    code, _, err = command("verdict", *options, "--pascal-per-unit", "2")
    assert code == 2
    assert "leave out one of them" in err


# ---- Several loudspeakers and microphones


@pytest.fixture
def several(folder):
    """Two loudspeakers and two microphones: recordings of both microphones, and their paths, each way to give them."""
    x = band_limited_noise((100, 1500), 3.0, fs=FS, rng=1, power=1.0)
    primary, secondary = np.eye(64)[[26, 28]], np.zeros((2, 2, 64))  # (K, J, taps)
    secondary[[0, 0, 1, 1], [0, 1, 0, 1], [12, 15, 16, 12]] = [1.0, 0.2, 0.3, 0.8]
    write_wav(folder / "errors.wav", [np.convolve(x, p)[: x.size] for p in primary], FS)
    np.save(folder / "S.npy", secondary)
    write_wav(folder / "P1.wav", primary, FS)
    for j in (0, 1):
        write_wav(folder / f"S{j + 1}.wav", secondary[:, j], FS)
        write_wav(folder / f"P{j + 1}1.wav", primary[j], FS)
        for k in (0, 1):
            write_wav(folder / f"S{k + 1}{j + 1}.wav", secondary[k, j], FS)
    return x, primary[:, np.newaxis], secondary


WAYS = {
    "a file for each loudspeaker": [["P1.wav"], ["S1.wav", "S2.wav"], []],
    "a file for each path": [
        ["P11.wav", "P21.wav"],
        ["S11.wav", "S21.wav", "S12.wav", "S22.wav"],
        ["--microphones", 2],
    ],
    "one array": [["P1.wav"], ["S.npy"], ["--fs", FS]],  # it states no rate
}


@pytest.mark.parametrize("way", WAYS)
def test_several_channels_are_read_in_the_order_that_the_help_states(command, several, way):
    primary, secondary, options = WAYS[way]
    files = [part for name in primary for part in ("--primary", name)]
    files += [part for name in secondary for part in ("--secondary", name)]
    rating = ["--rated-power", 4, "--rated-power", 0.05]
    code, out, err = command("verdict", "noise.wav", *files, *options, *rating, "--taps", 32, "--json", "--quiet")
    x, p, s = several
    verdict = assess(x.astype(np.float32), p, s.astype(np.float32), rating=[4.0, 0.05], fs=FS, n_taps=32)
    data = json.loads(out)
    assert code == (0 if verdict.enough else 1), err
    assert data["channels"] == {"references": 1, "loudspeakers": 2, "microphones": 2}
    assert data["rating"]["rated_power"] == [4.0, 0.05]
    assert data["bound_db"] == pytest.approx(verdict.bound_db, abs=1e-3)
    assert data["noise_reduction_db"] == pytest.approx(verdict.noise_reduction_db, abs=0.05)
    assert data["unlimited_power"] == pytest.approx(verdict.unlimited_power.tolist(), rel=1e-3)


def test_the_exit_code_is_that_of_all_amplifiers_together(command, several):
    files = ["noise.wav", "--disturbance", "errors.wav", "--secondary", "S1.wav", "--secondary", "S2.wav"]
    options = ["--ohm", 8, "--taps", 32, "--quiet", "--algorithm", "KF-PB"]
    code, out, _ = command("verdict", *files, "--watt", 1, *options)
    assert code == 0
    assert out.startswith("Enough: KF-PB reaches")
    code, out, _ = command("verdict", *files, "--watt", 1, "--watt", 0.0001, *options)
    assert code == 1
    assert "1, 0.0001 W into 8 ohm" in out
    assert "The amplifier limits" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--primary", "P1.wav", "--secondary", "S1.wav", "--watt", "1", "--watt", "2", "--ohm", "8"],
            "--watt must be given once",
        ),
        (
            ["--primary", "P11.wav", "--secondary", "S1.wav", "--rated-power", "1"],
            "--primary must give a path from each",
        ),
        (
            ["--primary", "P1.wav", "--secondary", "S1.wav", "--secondary", "S12.wav", "--rated-power", "1"],
            "got 3 in all",
        ),
        (
            ["--disturbance", "d.wav", "--secondary", "S1.wav", "--rated-power", "1"],
            "disturbance must have a channel for each",
        ),
        (
            ["--primary", "P1.wav", "--secondary", "S.npy", "--secondary", "S1.wav", "--rated-power", "1"],
            "leave out the other",
        ),
        (
            ["--primary", "P1.wav", "--secondary", "S1.wav", "--microphones", "0", "--rated-power", "1"],
            "must be at least 1",
        ),
    ],
    ids=["ratings", "references", "uneven", "microphones", "matrix", "none"],
)
def test_channels_that_do_not_fit_are_refused(command, several, arguments, message):
    code, _, err = command("verdict", "noise.wav", *arguments, "--fs", FS, "--quiet")
    assert code == 2
    assert message in err


def test_a_matrix_of_paths_is_inspected(command, several, tmp_path):
    _, primary, secondary = several
    secondary = secondary.copy()
    secondary[0, 1] = 0.0
    np.save(tmp_path / "S.npy", secondary)
    np.save(tmp_path / "P.npy", primary)
    arguments = ["paths", "inspect", tmp_path / "S.npy", "--primary", tmp_path / "P.npy", "--fs", FS]
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


def test_several_channels_are_compared_each_loudspeaker_with_its_rating(command, several, tmp_path):
    """The run at the setting that the report states, made again; powers over the ratings, of which the largest counts."""
    files = ["noise.wav", "--primary", "P1.wav", "--secondary", "S1.wav", "--secondary", "S2.wav"]
    options = ["--rated-power", 4, "--rated-power", 0.05, "--taps", 32, "--seconds", 1.5, "--quiet"]
    code, out, err = command("compare", *files, *options, "-o", tmp_path / "out")
    assert code == 0, err
    assert "Output power of each loudspeaker over its rated power" in out
    study = json.loads((tmp_path / "out" / "results.json").read_text())["studies"]["own-data"]
    x, primary, secondary = several
    x = x[: round(1.5 * FS)] - np.mean(x[: round(1.5 * FS)])
    again = simulate(
        FxLMS(32, secondary, step_size=study["parameters"]["FxLMS mu"], n_references=1),
        x[np.newaxis],
        primary_path=primary,
        secondary_path=secondary,
        fs=FS,
        switch_on_s=0.15,
    )
    powers = output_power(again.control_signal) / [4.0, 0.05]
    figures = study["algorithms"]
    assert list(figures) == ["KF-PB", "MOV-FxLMS", "FxLMS"]
    assert figures["KF-PB"]["output_power"] < 1.1
    assert figures["FxLMS"]["clipped_fraction"] == 0.0  # a rated power alone states no peak
    assert powers.max() > 1.0
    assert figures["FxLMS"]["output_power"] == pytest.approx(powers.max(), rel=0.02)
    assert figures["FxLMS"]["noise_reduction_db"] == pytest.approx(
        noise_reduction_db(again.error, again.disturbance), abs=0.2
    )
    assert figures["MOV-FxLMS"]["output_power"] < 1.1
    assert {path.name for path in (tmp_path / "out" / "figures").glob("*power*.svg")} >= {
        "own-data-power-1.svg",
        "own-data-power-2.svg",
    }


def test_an_algorithm_of_one_channel_is_not_compared_with_several(command, several):
    files = ["noise.wav", "--primary", "P1.wav", "--secondary", "S1.wav", "--rated-power", 1]
    code, _, err = command("compare", *files, "--algorithm", "KF-OPC repaired", "--quiet")
    assert code == 2
    assert "--algorithm must be one of" in err
