"""Paths as files: their rate, their time zero, matrices of them."""

from __future__ import annotations

import re

import numpy as np
import pytest
from helpers.files import FS, rew_text, write_sofa, write_uff

from kfopc_filterpy.paths import frequency_response, path_taps, read_path, resample_path
from kfopc_filterpy.paths.duct import Duct, duct_paths
from kfopc_filterpy.signals import read_recording, write_wav


def test_a_path_at_another_rate_keeps_its_response_and_a_recording_its_height(tmp_path):
    taps = path_taps(duct_paths(Duct(), fs=48000).secondary)
    write_wav(tmp_path / "s.wav", taps, 48000)
    path = read_path(tmp_path / "s.wav", fs=16000, unit="Pa/V", unit_per_full_scale=0.14)
    assert (path.fs, path.file_fs, path.unit) == (16000, 48000, "Pa/V")
    np.testing.assert_array_equal(
        path.samples, resample_path(0.14 * taps.astype(np.float32).astype(float), 16000, fs=48000)
    )
    frequencies = np.linspace(50, 6000, 50)
    before, after = (
        frequency_response(h, frequencies, fs=fs) for h, fs in ((0.14 * taps, 48000), (path.samples, 16000))
    )
    assert np.max(np.abs(after - before)) < 0.01 * np.max(np.abs(before))
    # Read as a recording, it keeps its height instead, and is three times too weak.
    recording = read_recording(tmp_path / "s.wav", fs=16000)
    weaker = frequency_response(recording.samples, frequencies, fs=16000) * 0.14
    assert np.max(np.abs(3 * weaker - after)) < 0.01 * np.max(np.abs(before))


def test_two_channels_of_paths_are_resampled_each(tmp_path):
    taps = np.zeros((2, 400))
    taps[0, 100], taps[1, 200] = 0.5, -0.25
    write_wav(tmp_path / "s.wav", taps, 48000)
    both = read_path(tmp_path / "s.wav", fs=16000)
    for channel in (0, 1):
        np.testing.assert_array_equal(both.samples[channel], resample_path(taps[channel], 16000, fs=48000))
        np.testing.assert_array_equal(
            read_path(tmp_path / "s.wav", fs=16000, channel=channel).samples, both.samples[channel]
        )


# ---- time zero


def rew(tmp_path, taps, **settings):
    (tmp_path / "rew.txt").write_text(rew_text(np.asarray(taps), **settings))
    return tmp_path / "rew.txt"


def test_rew_begins_at_time_zero(tmp_path):
    taps = np.zeros(200)
    taps[[100, 130, 131]] = 1e-4, 0.5, 0.25
    whole = read_path(rew(tmp_path, taps)).samples
    np.testing.assert_array_equal(whole, taps)
    # 100 samples before time 0, as REW exports them, are cut off; a later start leaves its delay.
    np.testing.assert_array_equal(read_path(rew(tmp_path, taps, start_s=-100 / FS)).samples, taps[100:])
    np.testing.assert_array_equal(read_path(rew(tmp_path, taps, start_s=7 / FS)).samples, [*np.zeros(7), *taps])
    # With its peak at time 0 (no timing reference), the path has no delay to tell.
    centred = rew(tmp_path, np.convolve(taps, np.hanning(9), "same"), start_s=-130 / FS)
    with pytest.raises(ValueError, match=r"rew\.txt has -\d\.\d dB of its energy before time 0, .*timing reference"):
        read_path(centred)
    with pytest.raises(ValueError, match=r"rew\.txt has 0\.0 dB of its energy before time 0"):
        read_path(rew(tmp_path, taps, start_s=-10.0))
    assert read_recording(centred).samples.size == 200  # of a recording, the time of its first sample does not matter


def test_rew_normalised_is_undone_and_minimum_phase_refused(tmp_path):
    taps = np.array([0.0, 0.0, 1.0, -0.5])
    normalised = ("* IR is not normalised", "* IR is normalised")
    assert read_path(rew(tmp_path, taps, changes=normalised)).samples.tolist() == [0.0, 0.0, 0.25, -0.125]
    with pytest.raises(ValueError, match=r"rew\.txt is REW's minimum-phase version, which has lost the path's delay"):
        read_path(rew(tmp_path, taps, changes=("IR is not the min phase", "IR is the min phase")))
    with pytest.raises(ValueError, match=r"rew\.txt is an export of REW without Sample interval in its header"):
        read_path(rew(tmp_path, taps, changes=("// Sample interval", "// something")))
    with pytest.raises(ValueError, match=r"rew\.txt is damaged or cut short: its header claims 5 samples, got \(4,\)"):
        read_path(rew(tmp_path, taps, changes=("4 // Response length", "5 // Response length")))
    with pytest.raises(ValueError, match=r"rew\.txt states a sample interval of 0 s"):
        read_path(rew(tmp_path, taps, changes=(f"{1 / FS!r} // Sample", "0 // Sample")))
    with pytest.raises(ValueError, match=r"rew\.txt has .* bytes, but with its start time it has 1.6e\+13 samples"):
        read_path(rew(tmp_path, taps, start_s=1e9))


def test_times_in_text_and_uff_shift_a_path_too(tmp_path):
    times = (np.arange(50) - 10) / FS
    taps = np.where(times < 0, 0.0, np.exp(-times * 1000))
    np.savetxt(tmp_path / "s.csv", np.column_stack([times, taps]), delimiter=",")
    write_uff(tmp_path / "s.uff", taps, start_s=-10 / FS)
    for name in ("s.csv", "s.uff"):
        np.testing.assert_allclose(read_path(tmp_path / name).samples, taps[10:], atol=1e-11)


# ---- matrices


def test_sofa_has_receivers_before_sources_and_its_delays(tmp_path):
    responses = np.random.default_rng(3).standard_normal((3, 2, 40))  # (measurements, receivers, taps)
    write_sofa(tmp_path / "x.sofa", responses)
    paths = read_path(tmp_path / "x.sofa")
    np.testing.assert_array_equal(paths.samples, responses.swapaxes(0, 1))
    assert paths.fs == FS
    assert "2 x 3 x 40 samples" in repr(paths)
    delays = np.array([[0.0, 2.0], [1.0, 0.0], [5.0, 3.0]])
    write_sofa(tmp_path / "x.sofa", responses, delay=delays)
    late = read_path(tmp_path / "x.sofa").samples
    assert late.shape == (2, 3, 45)
    for m in range(3):
        for r in range(2):
            begin = int(delays[m, r])
            np.testing.assert_array_equal(late[r, m, begin : begin + 40], responses[m, r])
            assert np.count_nonzero(late[r, m]) == 40
    write_sofa(tmp_path / "x.sofa", responses, delay=0.5)
    with pytest.raises(ValueError, match=r"x\.sofa has delays that are no whole numbers of samples"):
        read_path(tmp_path / "x.sofa")
    write_sofa(tmp_path / "x.sofa", responses[:1, :1])
    assert read_path(tmp_path / "x.sofa").samples.shape == (40,)


def test_sofa_of_several_emitters_has_them_as_loudspeakers(tmp_path):
    responses = np.random.default_rng(3).standard_normal((1, 2, 40, 3))  # (measurements, receivers, taps, emitters)
    delays = np.arange(6.0).reshape(1, 2, 3)
    write_sofa(tmp_path / "x.sofa", responses, delay=delays)
    paths = read_path(tmp_path / "x.sofa").samples
    assert paths.shape == (2, 3, 45)
    for r in range(2):
        for e in range(3):
            begin = int(delays[0, r, e])
            np.testing.assert_array_equal(paths[r, e, begin : begin + 40], responses[0, r, :, e])
            assert np.count_nonzero(paths[r, e]) == 40
    write_sofa(tmp_path / "x.sofa", np.repeat(responses, 2, axis=0))
    with pytest.raises(ValueError, match=r"x\.sofa has several emitters in each of 2 measurements, expected one"):
        read_path(tmp_path / "x.sofa")


def test_a_matrix_of_taps_keeps_its_axes_and_has_no_channels(tmp_path):
    taps = np.random.default_rng(3).standard_normal((2, 3, 40))
    taps[..., :12] = 0.0
    np.save(tmp_path / "x.npy", taps)
    np.testing.assert_array_equal(read_path(tmp_path / "x.npy", fs=FS).samples, taps)
    slower = read_path(tmp_path / "x.npy", fs=FS, file_fs=FS)
    np.testing.assert_array_equal(slower.samples, taps)
    with pytest.raises(ValueError, match=re.escape("x.npy holds a matrix of paths, (2, 3, 40), and no channels")):
        read_path(tmp_path / "x.npy", fs=FS, channel=0)


def test_the_published_room_can_be_read_file_by_file(shared_data):
    if not (shared_data / "room4x4").is_dir():
        pytest.skip(f"no measured room: {shared_data} has no folder room4x4")
    path = read_path(shared_data / "room4x4" / "S12.mat", fs=16000)
    assert path.samples.shape == (256,)
    assert repr(path) == "<Recording S12.mat: 0.016 s, 256 samples at 16000 Hz (not stated in the file)>"
