"""`kfopc export`: every algorithm from a settings file or a checkpoint, with the files that Python writes."""

from __future__ import annotations

import re
import zipfile

import numpy as np
import pytest
from helpers.commands import FS

from kfopc_filterpy import (
    HardClipAmplifier,
    OutputLimiter,
    OutputPowerConstraint,
    Plant,
    SoftSaturationAmplifier,
    fx_lms,
    kf_opc,
    kf_pb,
    simulate,
)
from kfopc_filterpy.controllers import FeedbackNeutralizer
from kfopc_filterpy.controllers.table import CORE
from kfopc_filterpy.export import export_c, export_fmu
from kfopc_filterpy.paths import PathTolerance, read_path

STEP, NOISES = {"step_size": 1e-3}, {"state_noise": 1e-7, "measurement_noise": 1e-2}
SETTINGS = {
    "KF-OPC": NOISES | {"rated_power": 0.5, "fs": 16000.0},
    "KF-PB": {"rated_power": 0.5, "fs": 16000.0},
    "FxRLS": {},
    "MOV-FxLMS": STEP | {"rated_power": 0.5, "fs": 16000.0, "penalty_factor": 0.2},
    "MOV-MFxLMS": STEP | {"rated_power": 0.5, "fs": 16000.0},
    "clipping FxLMS": STEP | {"amplitude_limit": 0.8},
}


def described(**settings):
    """Return a settings file."""
    return "\n".join(f"{name} = {'true' if value is True else repr(value)}" for name, value in settings.items())


def same_as_of_python(controller, made, folder, dtype="float64"):
    """Tell whether the files of the command are those that `export_c` writes of a controller."""
    export_c(controller, folder / "python", dtype=dtype)
    files = sorted(path.name for path in (folder / "python").iterdir())
    assert files == ["README.md", "anc.c", "anc.h", "main.c"]
    return all((folder / "python" / name).read_bytes() == (made / name).read_bytes() for name in files)


@pytest.mark.parametrize("name", SETTINGS)
def test_an_algorithm_is_described_by_its_name_and_settings(name, command, folder, tmp_path):
    path = [0.0, 0.8, 0.3]
    (folder / "c.toml").write_text(described(algorithm=name, n_taps=8, secondary=path, **SETTINGS[name]))
    code, out, err = command("export", "c.toml", "-o", tmp_path / "out")
    assert (code, err) == (0, "")
    made = tmp_path / "out" / "anc.c"
    assert re.fullmatch(rf"{re.escape(str(made))} and anc.h: {name}, 8 taps, float64, state of [\d,]+ bytes\n", out)
    assert same_as_of_python(CORE[name](8, path, **SETTINGS[name]), tmp_path / "out", tmp_path)


def test_parts_rate_and_several_loudspeakers(command, folder, several, tmp_path):
    _, _, paths = several
    controller = kf_opc(
        8,
        paths,
        constraint=[OutputPowerConstraint(power, fs=FS) for power in (0.5, 0.4)],
        limiter=[OutputLimiter(power, fs=FS, window_s=0.05) for power in (0.5, 0.4)],
        amplifier=[HardClipAmplifier(1.5), SoftSaturationAmplifier(1.2, 3.0)],
        **NOISES,
    )
    controller.secondary_path_uncertainty = PathTolerance(phase_deg=10.0)
    parts = """
[[limiter]]
rated_power = 0.5
window_s = 0.05
[[limiter]]
rated_power = 0.4
window_s = 0.05
[[amplifier]]
limit = 1.5
[[amplifier]]
limit = 1.2
sharpness = 3.0
[secondary_path_uncertainty]
phase_deg = 10.0
"""
    own = {"algorithm": "KF-OPC", "n_taps": 8, "rated_power": [0.5, 0.4], **NOISES}
    (folder / "c.toml").write_text(described(secondary=["S1.wav", "S2.wav"], **own) + parts)
    code, _, err = command("export", "c.toml", "-o", tmp_path / "out", "--dtype", "float32")
    assert (code, err) == (0, "")
    assert same_as_of_python(controller, tmp_path / "out", tmp_path, "float32")


@pytest.mark.parametrize(
    ("file", "fs", "options"), [("S.wav", None, ()), ("S16.wav", FS, ()), ("S16.wav", 3 * FS, ("--fs", FS))]
)
def test_the_rate_is_that_of_the_option_the_settings_or_the_file(file, fs, options, command, folder, tmp_path):
    settings = {"algorithm": "KF-PB", "n_taps": 8, "rated_power": 0.5, "secondary": file}
    (folder / "c.toml").write_text(described(**settings | ({} if fs is None else {"fs": fs})))
    code, _, err = command("export", "c.toml", "-o", tmp_path / "out", *options)
    assert (code, err) == (0, "")
    path = read_path(folder / file, fs=FS).samples
    assert same_as_of_python(kf_pb(8, path, rated_power=0.5, fs=FS), tmp_path / "out", tmp_path)


def test_a_controller_that_python_saved_goes_on(command, folder, tmp_path):
    controller = fx_lms(8, [0.0, 1.0], step_size=0.01)
    simulate(controller, np.random.default_rng(0).standard_normal(500), Plant([0, 1.0], [0, 0, 1.0], fs=16000))
    controller.save(folder / "trained.npz")
    code, _, err = command("export", "trained.npz", "-o", tmp_path / "out", "--name", "anc")
    assert (code, err) == (0, "")
    assert same_as_of_python(controller, tmp_path / "out", tmp_path)


@pytest.mark.slow  # zig compiles for two systems
def test_an_fmu_is_that_of_python(command, folder, tmp_path):
    pytest.importorskip("ziglang", reason="zig compiles the libraries")
    (folder / "c.toml").write_text(described(algorithm="FxLMS", n_taps=8, secondary="S.wav", step_size=0.01))
    code, out, err = command("export", "c.toml", "-o", tmp_path / "out", "--fmu", "--name", "left")
    assert (code, err) == (0, "")
    assert out.rstrip() == str(tmp_path / "out" / "left.fmu")
    controller = fx_lms(8, read_path(folder / "S.wav").samples, step_size=0.01)
    expected = export_fmu(controller, tmp_path / "left.fmu", fs=FS)
    assert (tmp_path / "out" / "left.fmu").read_bytes() == expected.read_bytes()
    assert "binaries/x86_64-windows/left.dll" in zipfile.ZipFile(expected).namelist()


GOOD = {"algorithm": "FxLMS", "n_taps": 8, "secondary": [0.0, 1.0], "step_size": 0.01}
RATED_TWICE = GOOD | {"algorithm": "KF-OPC", "rated_power": 1.0, "fs": 8000} | NOISES
RATED_TWICE.pop("step_size")
WRONG = {
    "unknown algorithm": (GOOD | {"algorithm": "FXLMS"}, "", "algorithm in c.toml must be one of 'KF-ANC'.*'FXLMS'"),
    "unknown setting": (GOOD | {"step": 1.0}, "", "c.toml: there is no setting step, but n_taps, secondary"),
    "unknown setting of a part": (
        GOOD,
        "[limiter]\nwatt = 1",
        r"\[limiter\]: there is no setting watt, but rated_power",
    ),
    "bad setting": (GOOD | {"step_size": -1.0}, "", "c.toml: step_size must be greater than 0, got -1"),
    "missing setting": ({"algorithm": "FxLMS", "n_taps": 8}, "", "c.toml: .*missing.*'secondary'"),
    "no TOML": ({}, "algorithm: FxLMS", "c.toml is not TOML: "),
    "no end of brackets": ({}, "x = " + 5000 * "[", "c.toml is not TOML: "),
    "a truth for a number": (GOOD | {"n_taps": True}, "", "c.toml: n_taps must be a whole number, got True"),
    "no path": (GOOD | {"secondary": []}, "", "secondary must be taps or names of files, got an empty list"),
    "missing file": (GOOD | {"secondary": "none.wav"}, "", "none.wav"),
    "two budgets": (RATED_TWICE, "[constraint]\nrated_power = 1.0", "give either rated_power= or constraint="),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_in_a_settings_file_is_said_in_one_line(case, command, folder, tmp_path):
    settings, parts, message = WRONG[case]
    (folder / "c.toml").write_text(f"{described(**settings)}\n{parts}")
    code, _, err = command("export", "c.toml", "-o", tmp_path / "out")
    assert code == 2
    assert re.fullmatch(f"kfopc export: .*{message}.*\n", err)
    assert not (tmp_path / "out").exists()


def test_other_wrong_input(command, folder, tmp_path):
    FeedbackNeutralizer(fx_lms(8, [0.0, 1.0], step_size=0.01), [0.0, 0.1]).save(folder / "wrapped.npz")
    (folder / "c.toml").write_text(described(**GOOD))
    for arguments, message in {
        ("wrapped.npz",): r"FxLMS .* \(FeedbackNeutralizer\) is not in the core and cannot be exported",
        ("text.wav",): "text.wav",
        ("c.toml", "--name", "main"): "name must not be 'main'",
        ("c.toml", "--fmu"): "an FMU needs the sample rate: give --fs, or fs in the settings file",
    }.items():
        code, _, err = command("export", *arguments, "-o", tmp_path / "out")
        assert code == 2
        assert re.search(message, err)
        assert not (tmp_path / "out").exists()
