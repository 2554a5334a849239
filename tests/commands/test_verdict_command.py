"""`kfopc verdict`: exit codes of real processes, JSON, pages, ratings, channels."""

from __future__ import annotations

import json
import re
import shlex
import sys
from argparse import Namespace
from inspect import signature
from pathlib import Path
from unittest.mock import Mock

import jsonschema
import numpy as np
import pytest
import scipy.io
import soundfile
from helpers.commands import FS, ROOT, SCENE, process

from kfopc_filterpy import Plant, verdict
from kfopc_filterpy.commands import main
from kfopc_filterpy.commands.amplifiers import amplifiers_in
from kfopc_filterpy.commands.inputs import calibration_of
from kfopc_filterpy.controllers.kf_pb import DEFAULT_UNCERTAINTY
from kfopc_filterpy.paths import PathTolerance
from kfopc_filterpy.signals import band_limited_noise, read_recording, write_wav
from kfopc_filterpy.verdict import assess
from kfopc_filterpy.verdict.assessment import SCHEMA
from kfopc_filterpy.verdict.candidates import CANDIDATES


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
    assert data["origin"]["Command"] == shlex.join(
        ["kfopc", "verdict", *SCENE, *rating, "--taps", "32", "-o", str(out)]
    )
    assert data["origin"]["Files"].startswith("noise.wav, 24000 samples at 8000 Hz; P.wav, 64 taps at 8000 Hz; S.wav")


@pytest.mark.slow
def test_the_readmes_verdict_runs_as_pasted_on_the_files_of_the_demo(inside, capsys, monkeypatch):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    lines = text.splitlines()
    start = next(number for number, line in enumerate(lines) if "kfopc demo" in line and line.startswith(".venv"))
    _, write, folder = lines[start].split()
    assert main([write, folder]) == 0
    pasted = lines[start + 1].split()
    assert pasted[0] == ".venv/bin/kfopc"
    assert main(pasted[1:]) == 0
    assert Path(folder, "out", "verdict.html").is_file()
    printed = capsys.readouterr().out
    assert printed.endswith("\n" + re.search(r"^```text\n(.*?)^```$", text, flags=re.M | re.S)[1])
    watt = re.search(r"About (\S+) W into 8 ohm would do", printed)[1]
    typed_back = (
        " ".join(pasted[1:-2])
        .replace("--watt 50", f"--watt {watt}")
        .replace("--disturbance demo/d", "--primary demo/P")
    )
    assert main(typed_back.split()) == 0  # d.wav is what P.wav makes of noise.wav, and some noise of the microphone
    monkeypatch.setattr(sys, "argv", ["my venv/bin/kfopc"])
    monkeypatch.setenv("PATH", "")
    capsys.readouterr()
    assert main(["demo", "my files"]) == 0
    _, *commands = capsys.readouterr().out.splitlines()
    assert [shlex.split(command)[:2] for command in commands] == [
        ["my venv/bin/kfopc", one] for one in ("verdict", "run", "export")
    ]
    for command in commands[1:]:  # the verdict is the one above
        assert main(shlex.split(command)[1:]) == 0
    assert float(re.search(r"noise reduction (\S+) dB", capsys.readouterr().out)[1]) > 12.0
    assert Path("my files", "firmware", "anc.c").is_file()
    assert main(["demo", "my files"]) == 2
    assert (
        "S.wav, my files/controller.toml, my files/trained.npz would be overwritten: choose another folder"
        in capsys.readouterr().err
    )


def test_of_a_list_of_amplifiers_the_cheapest_that_is_enough_is_first(command, folder):
    rows = ["Big;1,0;8;250", "Small;0,001;8;9,5", "Other load;0,04;4;80", "Middle;0,02;8;45"]
    (folder / "list.csv").write_text("\n".join(["Name;Watt;Ohm;Price (EUR)", *rows, ""]))
    scene = [*SCENE, "--taps", "32", "--volts-per-unit", "1", "--quiet"]
    code, out, _ = command("verdict", *scene, "--amplifiers", "list.csv", "--json")
    data = json.loads(out)
    told = [text.split(": enough ") for text in data["origin"]["Amplifiers"].split("; ")]
    alone = {}  # what each verdict on one of them says
    for row in rows:
        name, watt, ohm, _ = row.replace(",", ".").split(";")
        alone[name] = "no" if command("verdict", *scene, "--watt", watt, "--ohm", ohm)[0] else "yes"
    assert {name: answer.split(",")[0] for name, answer in told} == alone
    by_price = ["Small", "Middle", "Other load", "Big"]
    assert [name for name, _ in told] == sorted(by_price, key=lambda name: alone[name] == "no")
    assert set(alone.values()) == {"yes", "no"}
    first = told[0][0]
    assert (code, data["enough"], data["rating"]["rated_power"]) == (
        0,
        True,
        {"Middle": 0.16, "Other load": 0.16, "Big": 8.0}[first],
    )
    assert "Amplifier" in command("verdict", *scene, "--amplifiers", "list.csv")[1]


@pytest.mark.parametrize(
    ("text", "more", "message"),
    [
        (
            "name,watt,ohm\nA,ten,8\n",
            [],
            "list.csv has no column 'price': its first line must have the headings name, watt, ohm, price\n",
        ),
        ("\n", [], "list.csv has no column 'name'"),
        ("", [], "list.csv is empty (0 bytes)"),
        ("\ufeff", [], "list.csv has no column 'name'"),
        ("name,watt,ohm,price\nA,ten,8,50\n", [], "list.csv, line 2: watt is 'ten', not a number\n"),
        ("name,watt,ohm,price\nB,1,8,5\n\nA,1,8,nan\n", [], "list.csv, line 4: price must be finite, got nan"),
        ("name,watt,ohm,price\nA,-1,8,5\n", [], "list.csv, line 2: watt must be greater than 0, got -1"),
        ("name,watt,ohm,price\nA,1,8\n", [], "list.csv, line 2 must have 4 cells, as the headings, got 3"),
        ("name,watt,ohm,price\nA,1,5,8,9\n", [], "line 2 must have 4 cells, as the headings, got 5"),  # 1,5 W
        ("name,watt,ohm,price\n", [], "list.csv lists no amplifier"),
        (
            "name,watt,ohm,price\na,1,8,1\n",
            ["--watt", "20"],
            "--watt would not be used: --amplifiers has a column for it",
        ),
    ],
)
def test_a_list_of_amplifiers_that_is_wrong_is_refused(command, folder, text, more, message):
    (folder / "list.csv").write_text(text, encoding="utf-8")
    code, _, err = command("verdict", *SCENE, "--amplifiers", "list.csv", *more)
    assert code == 2
    assert message in err


@pytest.mark.parametrize(
    "text",
    [
        "\n\nname,watt,ohm,price,note\nA,1,8,5\n,,,,\n",
        "\n;;;\nname;watt;ohm;price\nA;1,0;8;5;good\n",
        "name,watt,ohm,price\nA,1,8,5,\n",
    ],
    ids=["blank lines, a cell less", "semicolons, a cell more", "an empty cell more"],
)
def test_a_list_of_amplifiers_needs_only_its_columns(tmp_path, text):
    (tmp_path / "list.csv").write_text(text)
    assert amplifiers_in(tmp_path / "list.csv") == [["A", 1.0, 8.0, 5.0]]


def test_a_verdict_names_options_in_its_advice_and_on_its_page(command, tmp_path):
    write = ["-o", tmp_path / "out"]
    code, out, _ = command("verdict", *SCENE, "--rated-power", "4", "--taps", "8", "--want-db", "12", *write)
    assert code == 1
    told = " ".join(out.split())
    assert "8 taps last 1 ms, but the noise arrives up to 1.9 ms later than the loudspeaker's sound" in told
    assert "take a longer filter with --taps 32." in told
    assert "--taps 32" in (tmp_path / "out" / "verdict.html").read_text(encoding="utf-8")


def test_all_algorithms_are_printed_as_a_table(command, folder):
    code, out, _ = command("verdict", *SCENE, "--rated-power", "4", "--taps", "8", "--all")
    verdict, table, settings = out.split("\n\n")
    assert verdict.startswith("Enough" if code == 0 else "Not enough")
    names = [line.split("  ")[0] for line in table.splitlines()]
    assert names == ["Controller", *CANDIDATES]
    assert re.findall(r" (yes|no) ", table) == ["yes"] + ["no"] * (len(CANDIDATES) - 1)  # a limiter
    assert [line.split("  ")[0] for line in settings.splitlines()] == [
        "Controller",
        *[*CANDIDATES][1:],
    ]  # KF-PB has none


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


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ([], signature(assess).parameters["secondary_path_uncertainty"].default),
        (["--path-error-samples", 2], PathTolerance(delay_samples=2.0)),
        (["--path-error-deg", 10, "--path-error-db", 3], PathTolerance(phase_deg=10.0, gain_db=3.0)),
    ],
)
def test_a_path_error_is_the_one_that_is_stated_or_the_default_of_assess(command, monkeypatch, options, expected):
    asked = Mock(side_effect=ValueError("enough"))
    monkeypatch.setattr(verdict, "assess", asked)
    command("verdict", *SCENE, "--rated-power", 1, *options)
    assert asked.call_args.kwargs["secondary_path_uncertainty"] == expected
    told = " ".join(command("verdict", "--help")[1].split())
    assert f"(default: a relative rms error of {DEFAULT_UNCERTAINTY:g})" in told


def test_a_second_measurement_of_the_path_may_tell_how_well_it_is_known(command, folder):
    write_wav(folder / "other.wav", np.eye(64)[15], FS)  # three samples later: 150 % wrong at 700 Hz
    scene = [*SCENE, "--rated-power", "4", "--taps", "32", "--json"]
    same, _, _ = command("verdict", *scene, "--secondary-again", "S.wav")
    code, out, _ = command("verdict", *scene, "--secondary-again", "other.wav")
    assert (same, code) == (0, 0)
    assert json.loads(out)["limited_by"] is None  # the path is learned


def test_the_rating_of_a_loudspeaker_counts_beside_that_of_the_amplifier(command):
    rating = ["--watt", 100, "--ohm", 8, "--loudspeaker-watt", 0.8, "--volts-per-unit", 1]
    out = command("verdict", *SCENE, *rating, "--taps", 16, "--json", "--algorithm", "FxLMS")[1]
    found = json.loads(out)["rating"]
    assert found["rated_power"] == pytest.approx(6.4)
    assert found["decided_by"] == "loudspeaker's power"


def test_units_that_files_state_count_and_are_not_contradicted(command, folder):
    for name, unit in (("noise", "V"), ("d", "Pa"), ("S", "mPa/mV"), ("d", "V")):
        scipy.io.savemat(
            folder / f"{name}_{unit[0]}.mat", {"p": soundfile.read(folder / f"{name}.wav")[0], "fs": FS, "unit": unit}
        )
    scene = ["verdict", "noise_V.mat", "--secondary", "S_m.mat", "--watt", "10", "--ohm", "8", "--json", "--taps", "64"]
    both = [soundfile.read(folder / f"{name}.wav")[0] for name in ("noise", "d")]
    scipy.io.savemat(folder / "both.mat", {"p": both, "fs": FS, "unit": np.array(["V", "Pa"], dtype=object)})
    stated = json.loads(command(*scene, "--disturbance", "both.mat:1")[1])
    plain = ["verdict", "noise.wav", "--disturbance", "d.wav", "--secondary", "S.wav", *scene[4:]]
    given = json.loads(command(*plain, "--pascal-per-unit", "1", "--volts-per-unit", "1")[1])
    assert stated | {"origin": None} == given | {"origin": None}
    for more, message in (
        (["d_P.mat", "--pascal-per-unit", "2.5"], "d_P.mat is in Pa, .*but --pascal-per-unit gives 2.5 Pa for 1"),
        (["d_P.mat", "--volts-per-unit", "10"], "S_m.mat is in Pa/V, .* but --volts-per-unit is 10: leave it out"),
        (["d_V.mat"], "d_V.mat is in V, S_m.mat is in Pa/V: the error microphones need one unit"),
    ):
        code, _, err = command(*scene, "--disturbance", *more)
        assert code == 2
        assert re.search(message, err)


def test_pascals_may_be_given_for_volts():
    options = Namespace(pascal_per_unit=[20.0], calibrator=None, noise="x", disturbance="d", secondary=["S"])
    assert calibration_of(options, Mock(units={"d": "V", "S": "V/V"}), 1) == 20.0
    with pytest.raises(ValueError, match=r"d is in Pa, V, S is in V/V, .* need one unit"):
        calibration_of(options, Mock(units={"d": "Pa, V", "S": "V/V"}), 2)


def test_channels_and_variables_are_named_with_their_files(command, folder):
    """Noise and disturbance in one sound file, and both paths in one .mat file, are as good as four files."""
    signals = {name: soundfile.read(folder / f"{name}.wav")[0] for name in ("noise", "d", "P", "S")}
    write_wav(folder / "both.wav", [signals["d"], signals["noise"]], FS)
    scipy.io.savemat(folder / "paths.mat", {"P": {"ir": signals["P"], "fs": FS}, "S": {"ir": signals["S"], "fs": FS}})
    options = ["--rated-power", 4, "--taps", 32, "--json", "--algorithm", "FxLMS"]
    apart = command("verdict", "noise.wav", "--disturbance", "d.wav", "--secondary", "S.wav", *options)
    named = command("verdict", "both.wav:1", "--disturbance", "both.wav:0", "--secondary", "paths.mat:S.ir", *options)
    assert named[0] == apart[0] == 0
    one, other = json.loads(named[1]), json.loads(apart[1])
    assert one["noise_reduction_db"] == other["noise_reduction_db"]
    assert one["bound_db"] == other["bound_db"]
    paths = ["--primary", "paths.mat:P.ir", "--secondary", "paths.mat:S.ir"]
    assert command("verdict", "both.wav:1", *paths, *options)[0] == 0


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


@pytest.mark.parametrize(("unit", "message"), [("V", ""), ("Pa", "got V: read it without unit, or remove the unit")])
def test_a_calibrators_recording_in_volts_gives_pascals_per_volt(unit, message, command, folder):
    """What the microphone recorded must be in volts, too."""
    tone = 0.5 * np.sqrt(2) * np.sin(2 * np.pi * 1000 * np.arange(FS) / FS)
    for name, signal, own in (("noise", soundfile.read(folder / "noise.wav")[0], unit), ("calibrator", tone, "V")):
        scipy.io.savemat(folder / f"{name}.mat", {"p": signal, "fs": FS, "unit": own})
    scene = ["noise.mat", "--secondary", "S.wav", "--feedback", "--rated-power", "4", "--taps", "32", "--json"]
    code, out, err = command("verdict", *scene, "--calibrator", "calibrator.mat")
    assert message in err
    if code != 2:
        bands = np.array(json.loads(out)["levels"]["before_db"])
        assert 10 * np.log10(np.sum(10 ** (bands / 10))) == pytest.approx(100.0, abs=0.3)  # as above
    assert (code == 2) == bool(message)


WAYS = {
    "a file for each loudspeaker": [["P1.wav"], ["S1.wav", "S2.wav"], []],
    "a file for each path": [
        ["P11.wav", "P21.wav"],
        ["S11.wav", "S21.wav", "S12.wav", "S22.wav"],
        ["--microphones", 2],
    ],
    "one array": [["P1.wav"], ["S.npy"], ["--file-fs", FS]],  # it states no rate
}


@pytest.mark.parametrize("way", WAYS)
def test_several_channels_are_read_in_the_order_that_the_help_states(command, several, way):
    primary, secondary, options = WAYS[way]
    files = [part for name in primary for part in ("--primary", name)]
    files += [part for name in secondary for part in ("--secondary", name)]
    rating = ["--rated-power", 4, "--rated-power", 0.05]
    code, out, err = command("verdict", "noise.wav", *files, *options, *rating, "--taps", 32, "--json", "--quiet")
    x, p, s = several
    verdict = assess(x.astype(np.float32), Plant(s.astype(np.float32), p, fs=FS), rating=[4.0, 0.05], n_taps=32)
    data = json.loads(out)
    assert code == (0 if verdict.enough else 1), err
    assert data["channels"] == {"references": 1, "loudspeakers": 2, "microphones": 2}
    assert data["rating"]["rated_power"] == [4.0, 0.05]
    assert data["bound_db"] == pytest.approx(verdict.bound_db, abs=1e-3)
    assert data["noise_reduction_db"] == pytest.approx(verdict.noise_reduction_db, abs=0.05)
    assert data["unlimited_power"] == pytest.approx(verdict.unlimited_power.tolist(), rel=1e-3)


def test_without_a_reference_microphone_the_noise_is_that_of_the_ear(command, folder, tmp_path):
    rating = ["--rated-power", "1", "--taps", "32", "--want-db", "3"]
    code, out, err = command(
        "verdict", "d.wav", "--feedback", "--secondary", "S.wav", *rating, "--json", "-o", tmp_path / "out"
    )
    assert code in (0, 1), err
    data = json.loads(out)
    jsonschema.validate(data, json.loads(SCHEMA.read_text(encoding="utf-8")))
    assert 0 < data["loop"]["path_error"] < 10
    page = (tmp_path / "out" / "verdict.html").read_text("utf-8")
    assert "settled loop tolerates a secondary path that is wrong by" in page
    assert data["ceilings"]["coherence_db"] is None


def test_a_settled_loop_that_a_measured_path_makes_unstable_is_refused(command, folder):
    """A path of the other sign: the loop's gain is then -2 T, and |T| is nearly 1 where the noise is."""
    write_wav(folder / "tone.wav", np.sin(0.5 * np.arange(24000)), FS)
    write_wav(folder / "turned.wav", -2 * read_recording(folder / "S.wav").one_channel(), FS)
    scene = ["tone.wav", "--feedback", "--secondary", "S.wav", "--secondary-again", "turned.wav", "--rated-power", "2"]
    code, _, err = command("verdict", *scene, "--taps", "16", "--algorithm", "KF-OPC")
    assert code == 2
    assert "has no margin" in err
