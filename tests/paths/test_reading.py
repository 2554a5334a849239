"""Paths as files: their rate, their time zero, matrices of them."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.files import FS, rew_text

from kfopc_filterpy.paths import duct_plant, frequency_response, read_path, resample_path
from kfopc_filterpy.signals import read_recording, write_wav


def test_a_path_at_another_rate_is_resampled_as_a_path_and_a_recording_keeps_its_height(tmp_path):
    taps = duct_plant(fs=48000).secondary[0, 0].astype(np.float32).astype(float)
    write_wav(tmp_path / "s.wav", [taps, -0.5 * taps], 48000)
    both = read_path(tmp_path / "s.wav", fs=16000, unit="Pa/V", unit_per_full_scale=0.14)
    assert (both.fs, both.file_fs, both.unit) == (16000, 48000, "Pa/V")
    slow = resample_path(0.14 * taps, 16000, fs=48000)
    np.testing.assert_allclose(both.samples, [slow, -0.5 * slow], rtol=1e-12, atol=1e-15)
    # Read as a recording, it keeps its height instead, and is three times too weak.
    recording = read_recording(tmp_path / "s.wav", fs=16000, channel=0)
    weaker, right = (frequency_response(h, np.linspace(50, 6000, 50), fs=16000) for h in (recording.samples, slow))
    assert np.max(np.abs(3 * 0.14 * weaker - right)) < 0.01 * np.max(np.abs(right))


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


def test_rew_normalised_is_undone(tmp_path):
    normalised = rew(tmp_path, [0.0, 0.0, 1.0, -0.5], changes=("* IR is not normalised", "* IR is normalised"))
    assert read_path(normalised).samples.tolist() == [0.0, 0.0, 0.25, -0.125]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"changes": ("IR is not the min phase", "IR is the min phase")},
            "is REW's minimum-phase version, which has lost",
        ),
        ({"changes": ("// Sample interval", "// something")}, "is an export of REW without Sample interval"),
        ({"changes": ("4 // Response length", "5 // Response length")}, r"its header claims 5 samples, got \(4,\)"),
        ({"changes": (f"{1 / FS!r} // Sample", "0 // Sample")}, "states a sample interval of 0 s"),
        ({"start_s": 1e9}, r"has .* bytes, but with its start time it has 1.6e\+13 samples"),
    ],
)
def test_rew_without_what_a_path_needs_is_refused(changed, message, tmp_path):
    with pytest.raises(ValueError, match=rf"rew\.txt .*{message}"):
        read_path(rew(tmp_path, [0.0, 0.0, 1.0, -0.5], **changed))


def test_rew_that_ends_within_a_number_is_refused(tmp_path):
    path = rew(tmp_path, np.full(30, 0.123456789))
    path.write_text(path.read_text()[:-5])
    with pytest.raises(ValueError, match=r"rew\.txt ends within a line, '0\.12345'.*was it cut"):
        read_path(path)


def test_times_in_text_shift_a_path_too(tmp_path):
    times = (np.arange(50) - 10) / FS
    taps = np.where(times < 0, 0.0, np.exp(-times * 1000))
    np.savetxt(tmp_path / "s.csv", np.column_stack([times, taps]), delimiter=",")
    np.testing.assert_allclose(read_path(tmp_path / "s.csv").samples, taps[10:], atol=1e-11)


# ---- matrices


def test_a_matrix_of_taps_keeps_its_axes_and_has_no_channels(tmp_path):
    taps = np.random.default_rng(3).standard_normal((2, 3, 40))
    np.save(tmp_path / "x.npy", taps)
    for rates in ({"fs": FS}, {"fs": FS, "file_fs": FS}):
        np.testing.assert_array_equal(read_path(tmp_path / "x.npy", **rates).samples, taps)
    with pytest.raises(ValueError, match=r"x\.npy holds a matrix of paths, \(2, 3, 40\), and no channels"):
        read_path(tmp_path / "x.npy", fs=FS, channel=0)


def test_the_published_room_can_be_read_file_by_file(shared_data):
    if not (shared_data / "room4x4").is_dir():
        pytest.skip(f"no measured room: {shared_data} has no folder room4x4")
    path = read_path(shared_data / "room4x4" / "S12.mat", fs=16000)
    assert path.samples.shape == (256,)
    assert repr(path) == "<Recording S12.mat: 0.016 s, 256 samples at 16000 Hz (not stated in the file)>"
