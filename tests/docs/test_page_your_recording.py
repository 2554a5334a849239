"""The tutorial that asks whether an amplifier is powerful enough: its own figures, and the files of someone else."""

from __future__ import annotations

import numpy as np
import soundfile
from helpers.pages import Page

from kfopc_filterpy import noise_reduction_db, output_power
from kfopc_filterpy.metrics import overshoot
from kfopc_filterpy.paths import Duct, duct_paths, path_taps
from kfopc_filterpy.signals import band_limited_noise, write_wav


def test_the_figures_say_what_the_page_says():
    page = Page("your_recording")

    v = page.run(until="Can the noise be controlled at all?")
    assert 2.7 < v.file_fs / v.fs < 2.8
    assert 7.55 < (v.file_fs / v.fs) ** 2 < 7.65

    v = page.run(until="What does the rating promise?")
    assert v.margin.margin_s > 0
    lost = 1 - v.best[-3] / v.best[-2], 1 - v.best[-4] / v.best[-3]
    assert all(0.25 < share < 0.4 for share in lost)  # half the power, twice
    assert 25.5 < v.free_watt < 26.5
    assert v.best[-1] - v.best[-2] < 0.01
    assert all(best >= scaled - 1e-6 for best, scaled in zip(v.best, v.scaled, strict=True))

    v = page.run()
    assert v.reductions[20] > 8 > 6 > v.reductions[10]
    limits = {watt: np.sqrt(2 * watt * v.ohm) for watt in v.amplifiers}
    assert round(limits[20], 1) == 17.9
    assert round(np.sqrt(2) * limits[20], 1) == 25.3
    for watt, run in v.runs.items():
        assert overshoot(run.control_signal, watt * v.ohm, v.fs, window_s=0.1) <= 1 + 1e-9
        assert limits[watt] * 0.999 < np.abs(run.control_signal).max() <= limits[watt]  # peaks are what is cut
        assert output_power(run.control_signal) < 0.75 * watt * v.ohm
    with_headroom = {watt: v.try_amplifier(watt, "noise_watt") for watt in (10, 20)}
    better = {watt: noise_reduction_db(run.error, run.disturbance) for watt, run in with_headroom.items()}
    assert better[10] > 6
    assert better[20] > v.reductions[20] + 1
    assert output_power(v.careless.control_signal) > 200 * 5 * v.ohm
    answers = [v.verdict(wanted) for wanted in v.wanted_db]
    assert answers[1] == "6 dB: 20 W are enough"
    assert "no amplifier is enough" in answers[-1]


def test_it_runs_on_the_files_of_someone_else(tmp_path, monkeypatch, capsys):
    """Integers in stereo at 48 kHz, another length, another duct, and impulse responses of other rates and lengths."""
    folder = tmp_path / "recordings"
    folder.mkdir()
    noise = band_limited_noise((150, 900), 2.6, fs=48000, rng=3, power=0.01) + 0.02
    soundfile.write(folder / "noise.wav", np.stack([noise, 0 * noise], axis=1), 48000, subtype="PCM_16")
    for name, fs in (("primary", 22050), ("secondary", 16000)):
        system = getattr(duct_paths(Duct(length_m=3.0), fs=fs), name)
        write_wav(folder / f"{name}.wav", path_taps(system)[: round(0.05 * fs)], fs)
    monkeypatch.chdir(tmp_path)
    v = Page("your_recording", without="example-files").run()
    lines = capsys.readouterr().out.splitlines()
    assert lines[-4:] == [v.verdict(wanted) for wanted in v.wanted_db]
    assert [line.split(" dB: ")[0] for line in lines[-4:]] == ["3", "6", "9", "20"]
    assert lines[-4] == "3 dB: 5 W are enough"  # a quiet noise: the smallest amplifier has watts to spare
    assert v.x.size == round(2.6 * 16000)
    assert abs(v.x.mean()) < 1e-9
    assert abs(np.std(v.x) / 0.1 - 1) < 0.05  # 16 bits lose little, and resampling nothing
