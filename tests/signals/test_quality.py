"""Remarks on recordings: short ones, clipped ones, and those that only look clipped."""

import numpy as np
import pytest

from kfopc_filterpy.signals import band_limited_noise, tone
from kfopc_filterpy.signals.quality import clipping_remarks, recording_remarks

FS = 8000
NOISE = band_limited_noise((100, 1500), 6.0, fs=FS, rng=1, power=1.0)


def test_a_clipped_recording_is_noticed_with_its_share():
    (remark,) = recording_remarks(np.clip(NOISE, -1.5, np.inf), FS, "noise.wav")
    assert remark.startswith("noise.wav is clipped: ")
    share = np.mean(NOISE <= -1.5)
    assert f"{100 * share:.2g} %" in remark  # hardly a peak of this noise is so short that only one sample is cut off
    assert "record again with less gain" in remark


@pytest.mark.parametrize(
    "signal",
    [
        NOISE,
        np.round(NOISE * 100) / 100,  # of few bits
        tone(400.0, 6.0, fs=FS),  # each of its peaks is the same value
        np.sign(np.arange(6 * FS) % 2 - 0.5),  # a tone at fs/2
        np.round(327 * tone(50.0, 6.0, fs=FS)),
        np.round(1000 * tone(20.0, 6.0, fs=FS)),
        np.sign(tone(100.0, 6.0, fs=FS, phase_rad=0.1)),
    ],
    ids=["noise", "few bits", "tone", "fs/2", "whole numbers", "slow, whole numbers", "square"],
)
def test_a_signal_that_repeats_its_peak_is_not_clipped(signal):
    assert recording_remarks(signal, FS, "noise") == []


def test_a_channel_that_is_clipped_is_named():
    (remark,) = clipping_remarks([NOISE, np.clip(NOISE, -1, 1)], "errors.wav")
    assert remark.startswith("errors.wav, channel 1, is clipped")


def test_clipped_whole_numbers_are_noticed():
    (remark,) = clipping_remarks(np.clip(np.round(3000 * NOISE), -3000, 3000), "noise.wav")
    assert remark.startswith("noise.wav is clipped")


def test_a_short_recording_is_noticed():
    (remark,) = recording_remarks(NOISE[: 3 * FS], FS, "noise")
    assert remark.startswith("noise lasts only 3 s")
    assert "record 10 s or more" in remark
    assert recording_remarks(NOISE[: 5 * FS], FS, "noise") == []


def test_channels_that_are_the_same_signal_are_noticed():
    long = np.tile(NOISE, 2)
    (remark,) = recording_remarks([long, -long, long], FS, "noise")
    assert remark == "noise, channels 0 and 2, are the same signal: leave one of them out."
