"""What all subcommands share: errors of one line, help, and how files are read."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
from helpers.commands import FS, ROOT, SCENE, process


def test_a_process_ends_with_2_and_one_line_if_the_input_is_wrong(folder):
    ended = process(folder, "verdict", "nose.wav", *SCENE[1:], "--rated-power", "1")
    assert ended.returncode == 2
    assert ended.stdout == b""
    assert ended.stderr.startswith(b"kfopc verdict: nose.wav does not exist")
    assert ended.stderr.count(b"\n") == 1


PATHS = "--primary P.wav --secondary S.wav"
ERRORS = {
    "verdict": "the following arguments are required: noise, --secondary; see kfopc verdict --help",
    "verdikt": "invalid choice",
    "verdict noise.wav PATHS --rated-power 1 --tap 8": "unrecognized arguments: --tap 8; see kfopc verdict --help",
    "paths inspect S.wav --bogus 3": "unrecognized arguments: --bogus 3; see kfopc paths inspect",
    # Ratings.
    "verdict noise.wav PATHS": "a rating is needed: --watt 20 --ohm 8 --volts-per-unit 10, or --rated-power 1.6",
    "verdict noise.wav PATHS --volts-per-unit 2": "a rating is needed: --watt 20 --ohm 8, or --rated-power 1.6",
    "verdict noise.wav PATHS --watt 20": "need --ohm",
    "verdict noise.wav PATHS --watt 20 --ohm 8 --rated-power 1": "leave out one of them",
    "verdict noise.wav PATHS --watt twenty --ohm 8": "--watt must be a single number in W, got 'twenty'",
    "verdict noise.wav PATHS --watt -20 --ohm 8": "--watt must be greater than 0 W, got -20; see kfopc verdict --help",
    "verdict noise.wav PATHS --watt 20 --ohm 8": "watts and volts need --volts-per-unit, the volts at the loudspeaker",
    "verdict noise.wav PATHS --amplifiers list.csv": "watts and volts need --volts-per-unit",
    "verdict noise.wav PATHS --loudspeaker-watt 1 --ohm 8": "watts and volts need --volts-per-unit",
    "verdict noise.wav PATHS --loudspeaker-watt 1": "a loudspeaker's rating needs --ohm",
    "verdict noise.wav PATHS --rated-power 1 --ohm -1": "--ohm must be greater than 0",
    # The option that an argument of the package comes from is named.
    "verdict noise.wav PATHS --rated-power 1 --algorithm KF": "--algorithm must be one of 'KF-PB'",
    "verdict noise.wav PATHS --rated-power 1 --want-db -3": "--want-db must not be negative",
    "verdict noise.wav PATHS --rated-power 1 --taps 4.5": "--taps must be a whole number, got '4.5'",
    "verdict noise.wav PATHS --rated-power 1 --memory 0": "--memory must be greater than 0 s, got 0",
    "verdict noise.wav PATHS --rated-power 1 --path-error-samples -1": "--path-error-samples must not be",
    "verdict noise.wav PATHS --rated-power 1 --path-error-db 30": "--path-error-db must be at most 20, got 30",
    "verdict noise.wav PATHS --rated-power 1 --pascal-per-unit 1 --pascal-per-unit 1": "must be given once",
    "verdict noise.wav PATHS --rated-power 1 -o noise.wav": "noise.wav is a file: name a folder",
    # Files.
    "verdict noise.wav --secondary S.wav --rated-power 1": "--primary or --disturbance is needed",
    "verdict empty.wav PATHS --rated-power 1": "empty.wav",
    "verdict text.wav PATHS --rated-power 1": "cannot be read as an audio file",
    "verdict noise.wav --primary P.wav --secondary silent.wav --rated-power 1": "silent.wav must not be silent",
    "verdict noise.wav --primary noise.wav --secondary S.wav --rated-power 1": "an impulse response must be shorter",
    "verdict noise.wav --secondary S.wav --rated-power 1 --disturbance short.wav": "they must be recorded together",
    "paths identify noise.wav d.wav --taps 20000 -o x.npy": "--taps must be at most 12000",
    "paths inspect S.wav --primary silent.wav": "silent.wav must not be silent",
    "paths identify noise.wav d.wav --taps 8 -o S.xyz": "must end in .wav, .npy, .csv, .txt",
    "paths identify noise.wav d.wav --taps 64 -o x.wav --fs 8000.5": "take another --fs, or write .csv",
    # Sampling rates.
    "verdict noise.wav --primary P.wav --secondary S16.wav --rated-power 1": "for example with --fs 16000",
    "verdict noise.wav PATHS --rated-power 1 --fs -1": "--fs must be greater than 0 Hz, got -1",
    "verdict noise.wav --primary P.wav --secondary untimed.npy --rated-power 1": "untimed.npy states no sampling",
    "paths inspect S.wav --file-fs 8000": "--file-fs is for files that state no rate",
    "paths inspect untimed.npy --fs 8000": "for example with --file-fs 48000",
    # Channels.
    "verdict stereo.wav --secondary S.wav --rated-power 1": "name both, as in stereo.wav:0 --disturbance stereo.wav:1",
    "verdict stereo.wav PATHS --rated-power 1": "choose a channel, as in stereo.wav:0",
    "verdict stereo.wav:2 PATHS --rated-power 1": "stereo.wav has channels 0 and 1 (counted from 0), got channel 2",
    "verdict noise.wav --secondary S.wav --rated-power 1 --disturbance stereo.wav:1": "noise.wav and --disturbance",
    "verdict stereo.wav --secondary S.wav --rated-power 1 --disturbance ./stereo.wav:1": "is channel 0 of stereo.wav",
    "paths identify noise.wav d.wav --taps 8 -o none/x.npy": "the folder none does not exist: make it first",
    "paths identify stereo.wav d.wav --taps 8 -o x.npy": "name one of stereo.wav:0 to stereo.wav:1",
    "paths inspect S.wav:1": "S.wav has only channel 0 (counted from 0), got channel 1",
    "paths inspect S.wav:0:1": "S.wav:0:1 does not exist",
    "paths inspect S.wav:S": "S.wav is an audio file, which has no named variables",
    "paths identify stereo.wav:0 stereo.wav:0 --taps 8 -o x.npy": "stereo.wav:0 and stereo.wav:0 are the same signal: give",
    "verdict noise.wav --secondary S.wav --rated-power 1 --disturbance noise.wav": "noise.wav and --disturbance noise.wav are "
    "the same signal: give the error microphone's recording",
    "export S.wav -o fw": "S.wav is a sound file: give a settings file, *.toml, that names it as its secondary path, or",
    # Several channels.
    "verdict noise.wav --primary P1.wav --secondary S1.wav --watt 1 --watt 2 --ohm 8 --fs 8000": "--watt must be given once",
    "verdict noise.wav --primary P11.wav --secondary S1.wav --rated-power 1 --fs 8000": "--primary must give a path from each",
    "verdict noise.wav --primary P1.wav --secondary S1.wav --secondary S12.wav --rated-power 1 --fs 8000": "got 3 in all",
    "verdict noise.wav --disturbance d.wav --secondary S1.wav --rated-power 1 --fs 8000": "d.wav must have a channel for each",
    "verdict noise.wav --feedback --secondary S1.wav --rated-power 1 --fs 8000": "a channel for each of the 2 microphone(s)",
    "verdict noise.wav --primary P1.wav --secondary S.npy --secondary S1.wav --file-fs 8000 --fs 8000": "leave out the other",
    "verdict noise.wav --primary P1.wav --secondary S1.wav --microphones 0 --rated-power 1 --fs 8000": "must be at least 1",
    # An option that nothing uses.
    "verdict noise.wav PATHS --rated-power 1 --ohm 8 --volts-per-unit 2": "--ohm and --volts-per-unit would",
    "verdict noise.wav PATHS --rated-power 1 --rating sine": "--rating would not be used",
    "run --references 0 --errors 1 --rated-power 1 --file-fs 8000 --microphones 1": "--microphones and --file-fs would not",
}


@pytest.mark.parametrize("arguments", ERRORS, ids=lambda arguments: arguments.replace("/", ""))
def test_an_error_is_one_line_that_says_what_to_do(command, several, arguments):
    code, out, err = command(*arguments.replace("PATHS", PATHS).split())
    assert (code, out) == (2, "")
    assert ERRORS[arguments] in err
    assert err.count("\n") == 1
    assert err.startswith("kfopc")


@pytest.mark.parametrize("arguments", [[], ["verdict"], ["paths"], ["paths", "identify"]])
def test_help_says_what_it_does_and_shows_an_example(command, arguments):
    code, out, _ = command(*arguments, "--help")
    assert code == 0
    assert "usage: kfopc" in out
    if arguments != ["paths"]:
        assert "example" in out
        assert f"  kfopc {' '.join(arguments)}".rstrip() in out


def test_a_reader_that_goes_away_ends_the_command_without_a_word(folder):
    """As `head` does, after it has read enough."""
    with subprocess.Popen(
        [sys.executable, "-m", "kfopc_filterpy", "paths", "inspect", "S.wav"], cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as process:  # fmt: skip
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 141


def test_an_interrupt_while_python_loads_the_command_gives_one_line(tmp_path):
    """In the process, numpy is a file that is interrupted."""
    (tmp_path / "numpy.py").write_text("raise KeyboardInterrupt", encoding="utf-8")
    ended = subprocess.run(
        [sys.executable, "-m", "kfopc_filterpy", "--version"], capture_output=True, text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])},
    )  # fmt: skip
    assert (ended.returncode, ended.stdout) == (130, "")
    assert ended.stderr == "kfopc: interrupted; each file is as it was, or was written whole\n"


def test_rates_that_differ_are_resampled_each_in_its_way(command):
    """An impulse response keeps its gain, so that the power needed stays the same: 1 for full control."""
    scene = [*SCENE[:3], "--secondary", "S16.wav", "--rated-power", "4", "--taps", "32", "--json"]
    code, out, _ = command("verdict", *scene, "--fs", FS)
    assert code == 0
    assert json.loads(out)["unlimited_power"] == pytest.approx(1.0, rel=0.1)


def test_without_arguments_the_command_shows_its_help(command):
    code, out, err = command()
    assert (code, err) == (0, "")
    assert out.startswith("usage: kfopc")
