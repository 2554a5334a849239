"""`kfopc run`, on a simulated plant."""

from __future__ import annotations

import json
import re
from unittest.mock import Mock

import numpy as np
import pytest

from kfopc_filterpy.commands.run import describe, summarize
from kfopc_filterpy.realtime import RunReport
from kfopc_filterpy.signals import write_wav

FS = 8000
S = np.array([0.0, 0.8, -0.3])
PRIMARY = np.zeros(90)
PRIMARY[[70, 75, 82]] = 1.0, 0.5, -0.3
X = np.random.default_rng(5).standard_normal(8 * FS)


def plant(folder, **changes):
    """Write the files of a plant, and return the options that name them."""
    signals = {"noise": 0.1 * X, "P": PRIMARY, "S": S} | changes
    for name, signal in signals.items():
        write_wav(folder / f"{name}.wav", signal, FS)
    noise, primary, secondary = (str(folder / f"{name}.wav") for name in signals)
    return [noise, "--primary", primary, "--secondary", secondary]


def test_the_command_shows_levels_and_returns_what_ended_it(command, tmp_path):
    given = plant(tmp_path)
    options = ["--rated-power", "0.03", "--taps", "24", "--block", "32", "--identify", "1.5", "--listen", "1"]
    code, out, err = command("run", *given, *options, "--seconds", "6")
    assert code == 0
    assert " s under control, ended with the recording\n" in out
    assert "round trip 65 samples, 8.1 ms" in out
    assert "% of the rated power" in out
    told = re.search(r"the longest of \d+ blocks took (\d+) % of its duration; .*\nhealth: (.*)\n", out)
    late = r"\d+ block\(s\) too slow" if int(told[1]) > 100 else "nothing noticed"  # the machine may be busy
    assert re.fullmatch(late, told[2])
    assert "--block" not in out  # the bound is high enough
    assert err.startswith("kfopc run: warning: ")
    assert "noise.wav lasts 8 s, of which listening takes 1 s and identifying 1.5 s" in err
    assert "5.5 s of control are left of the 6 s asked for" in err
    assert re.search(r"5\.0 s +reduction +[1-9]\d\.\d dB +power [\d.e-]+ \(\d+ %\) +load", err)
    for wrong, message in (
        (options, "a recording with --primary and --secondary is needed"),
        ([*given[:3], *options], "--secondary is needed"),
        ([*given, *options, "--latency", "3"], "latency must be at least a block, 32 samples, got 3"),
        ([*given, "--disturbance", given[0], *options], "--disturbance stands in place of --primary: leave out one"),
        ([*given, *options, "--device", "3"], "--device, --references and --errors do not go with a recording"),
        ([*given, *options, "--seconds", "nan"], "--seconds must be finite, got nan"),
        (
            ["--references", "0", "--errors", "1", *options],
            "the sample rate of the sound card is missing: give one that it",
        ),
        (
            ["--references", "0", "--errors", "0", "--fs", "8000", *options],
            "references and errors must be different inputs",
        ),
        (["--references", "0", "x", "--errors", "1", *options], "--references must be a whole number, got 'x'"),
        ([*given, *options, "--identify", "8"], "identifying 8 s: nothing is left to control; give a longer recording"),
        ([*given[:4], given[0], *options], "noise.wav has 64000 samples (8 s)"),
        ([given[0], "--disturbance", given[2], *given[3:], *options], "P.wav has 90 samples, "),
    ):
        code, _, error = command("run", *wrong)
        assert code == 2
        assert message in error
        assert len([line for line in error.splitlines() if "warning" not in line]) == 1


def test_the_command_says_if_its_blocks_make_the_anti_noise_late(command, tmp_path):
    """With one tap of the primary path, an eighth of the noise's power, within the reach of blocks of 40 samples."""
    primary = np.zeros(130)
    primary[[70, 125]] = 1.0, 1.0
    given = plant(tmp_path, P=primary)
    options = ["--rated-power", "0.03", "--taps", "48", "--identify", "1.5", "--listen", "1", "--quiet"]
    code, out, err = command("run", *given, *options, "--block", "40", "--seconds", "1")
    assert code == 0
    assert "if the anti-noise comes too late, use a smaller --block: two blocks of 40 samples are 10 ms" in out
    assert err == ""
    code, printed, err = command("run", *given, *options, "--block", "40", "--seconds", "1", "--json")
    facts = json.loads(printed)
    assert (code, err, facts["stopped_by"], facts["health"]) == (0, "", "end", [])
    assert f"reach {facts['possible_db']:.1f} dB, and one that adapts perhaps more" in out
    assert "1.0 s under control, as asked for\n" in out
    assert f"noise reduction {facts['reduction_db'][0]:.1f} dB" in out
    assert f"output power {facts['powers'][0]:.3g} (" in out


@pytest.mark.parametrize(
    ("overruns", "counts", "told"),
    [
        (0, {}, ""),
        (209, {}, "209 block(s) too slow"),
        (0, {"clipped": 2}, "2 clipped"),
        (1, {"clipped": 2}, "1 block(s) too slow, 2 clipped"),
    ],
)
def test_a_run_with_late_blocks_is_not_called_healthy(overruns, counts, told):
    status = {
        "seconds": 2.0,
        "reduction_db": np.array([9.0]),
        "powers": np.array([0.1]),
        "rated_power": np.array([0.2]),
    }
    status |= {"load": 4.53, "overruns": overruns, "lost": 0, "underflows": 0, "health": Mock(counts=counts, events=[])}
    report = RunReport(
        **status,
        stopped_by="user",
        round_trip_samples=None,
        secondary=None,
        possible_db=np.nan,
        blocks=9,
        controller=None,
    )
    assert describe(report).endswith(f"load 453 %  {told or 'healthy'}")
    summary = summarize(report, FS, 32)
    assert summary.endswith(f"health: {told or 'nothing noticed'}")
    assert f"{overruns} of" not in summary  # they are told once


@pytest.mark.parametrize("source", [[], ["--disturbance", "ear.wav"]], ids=["feedback", "hybrid"])
def test_the_error_microphone_can_be_a_reference(command, tmp_path, source):
    tone = 0.1 * np.sin(0.15 * np.arange(X.size))
    for name, signal in (("noise", 0.1 * X), ("ear", tone + 0.005 * X), ("S", S)):
        write_wav(tmp_path / f"{name}.wav", signal, FS)
    noise = "noise.wav" if source else "ear.wav"
    given = [
        part if part.startswith("--") else str(tmp_path / part) for part in (noise, "--secondary", "S.wav", *source)
    ]
    options = ["--feedback", "--rated-power", "0.1", "--taps", "24", "--block", "32", "--quiet", "--json"]
    code, out, err = command("run", *given, *options, "--identify", "2", "--listen", "1")
    assert (code, err) == (0, "")
    facts = json.loads(out)
    assert facts["reduction_db"][0] > 15.0
    assert (facts["stopped_by"], facts["health"]) == ("end", [])


def test_a_plant_of_several_channels_is_simulated(command, tmp_path):
    paths = np.zeros((2, 2, 4))
    paths[:, :, 1] = [[0.9, 0.2], [0.1, 0.8]]
    given = plant(tmp_path, noise=0.1 * X[: 5 * FS], P=np.stack((PRIMARY, np.roll(0.7 * PRIMARY, 3))))
    np.save(tmp_path / "S.npy", paths)
    given[-1] = str(tmp_path / "S.npy")
    options = ["--rated-power", "0.03", "--taps", "24", "--block", "32", "--identify", "1.5", "--listen", "0.5"]
    code, out, err = command("run", *given, *options, "--file-fs", str(FS), "--quiet")
    assert code == 0, err
    (powers,) = re.findall(r"output power (.*)", out)
    assert powers.count("% of the rated power") == 2
