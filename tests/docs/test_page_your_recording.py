"""The tutorial that asks whether an amplifier is powerful enough: its own figures, and the files of someone else."""

from __future__ import annotations

import json

import numpy as np
import pytest
import soundfile
from helpers.pages import Page

from kfopc_filterpy import noise_reduction_db, output_power
from kfopc_filterpy.bounds import wiener_solution
from kfopc_filterpy.metrics import overshoot
from kfopc_filterpy.paths import Duct, duct_paths, path_taps
from kfopc_filterpy.signals import band_limited_noise, write_wav


@pytest.mark.slow
def test_the_figures_say_what_the_page_says():
    page = Page("your_recording")

    v = page.run(until="The verdict")
    assert 2.7 < v.noise.file_fs / v.fs < 2.8
    assert 7.55 < (v.noise.file_fs / v.fs) ** 2 < 7.65

    v = page.run(until="What the rating promises")
    verdict = v.verdict
    assert verdict.enough
    assert (verdict.algorithm, verdict.settings.n_taps) == ("KF-PB", 256)
    for name, run in verdict.runs.items():
        keeps = overshoot(run.control_signal, 20 * v.ohm, v.fs, window_s=0.1) <= 1 + 1e-6
        assert keeps == (name == "KF-PB")
        assert (output_power(run.control_signal) > 20 * v.ohm) == (name != "KF-PB")
    assert v.p.size == v.s.size == 918
    begins = np.flatnonzero(verdict.runs["KF-PB"].control_signal)[0] / v.fs
    assert 0.9 < begins < 1.3  # the first solution, in s from the switch-on
    c, half = verdict.ceilings, v.x.size // 2
    free = wiener_solution(v.x[half:], np.convolve(v.x, v.p)[half : v.x.size], v.s, 256)
    assert abs(c.filter_db - free.noise_reduction_db) < 0.5  # another stretch of the record
    assert c.filter_db - c.power_db < 2 < c.power_db - verdict.noise_reduction_db
    assert json.loads((v.folder / "verdict" / "verdict.json").read_text("utf-8"))["enough"] is True

    v = page.run()
    assert round(np.sqrt(2 * 20 * v.ohm), 1) == round(verdict.limits.amplitude_limit, 1) == 17.9
    assert round(2 * v.smaller["noise_watt"].limits.amplitude_limit, 1) == 25.3
    least = {kind: other.least_rated_power for kind, other in v.smaller.items()}
    assert least["sine_watt"] == pytest.approx(verdict.least_rated_power, rel=1e-12)
    assert 5 * v.ohm < least["noise_watt"] < 0.95 * least["sine_watt"] < verdict.limits.rated_power
    assert output_power(v.run.control_signal) > 100 * 5 * v.ohm
    assert noise_reduction_db(v.run.error, v.run.disturbance) < v.small.noise_reduction_db
    assert len(v.run.error) == len(v.small.runs["KF-PB"].error)


@pytest.mark.slow
def test_it_runs_on_the_files_of_someone_else(inside, capsys):
    """Integers in stereo at 48 kHz, another length, another duct, and impulse responses of other rates and lengths."""
    folder = inside / "recordings"
    folder.mkdir()
    noise = band_limited_noise((150, 900), 2.6, fs=48000, rng=3, power=0.01) + 0.02
    soundfile.write(folder / "noise.wav", np.stack([noise, 0 * noise], axis=1), 48000, subtype="PCM_16")
    for name, fs in (("primary", 22050), ("secondary", 16000)):
        system = getattr(duct_paths(Duct(length_m=3.0), fs=fs), name)
        write_wav(folder / f"{name}.wav", path_taps(system)[: round(0.05 * fs)], fs)
    v = Page("your_recording", without="example-files").run()
    said = capsys.readouterr().out
    assert str(v.verdict) in said
    assert v.verdict.enough
    assert v.smaller["sine_watt"].enough  # a quiet noise: the smallest amplifier has watts to spare
    assert v.verdict.least_rated_power < 5 * v.ohm
    run = v.verdict.runs["KF-PB"]
    assert run.n_samples == round(2.6 * 16000) - round(0.26 * 16000)  # a tenth before the control is switched on
    assert abs(run.reference.mean()) < 0.005  # of the whole record it is 0; the offset was 0.02
    assert abs(np.std(v.x) / 0.1 - 1) < 0.05  # 16 bits lose little, and resampling nothing
    before, after = (
        soundfile.read(folder / "verdict" / "audio" / f"verdict-{name}.wav")[0] for name in ("before", "after")
    )
    assert np.sum(after[after.size // 2 :] ** 2) < 0.25 * np.sum(before[before.size // 2 :] ** 2)  # 6 dB
