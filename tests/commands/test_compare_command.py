"""`kfopc compare`: the algorithms on files, of one channel and several."""

from __future__ import annotations

import json

import numpy as np
import pytest
from helpers.commands import FS, SCENE

from kfopc_filterpy import FxLMS, noise_reduction_db, output_power, simulate


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
    assert (tmp_path / "out" / "figures" / "own-data-power.svg").is_file()


@pytest.mark.parametrize("action", ["compare", "verdict"])
def test_a_folder_that_cannot_be_written_is_refused_before_anything_is_read(action, command):
    code, _, err = command(action, "missing.wav", *SCENE[1:], "--rated-power", 1, "-o", "noise.wav/out")
    assert code == 2
    assert "'noise.wav/out' cannot be written" in err


def test_an_algorithm_of_one_channel_is_not_compared_with_several(command, several):
    files = ["noise.wav", "--primary", "P1.wav", "--secondary", "S1.wav", "--rated-power", 1]
    code, _, err = command("compare", *files, "--algorithm", "KF-OPC repaired", "--quiet")
    assert code == 2
    assert "--algorithm must be one of" in err
