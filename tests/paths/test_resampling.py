"""Resampled paths against impulse responses whose samples are known in closed form at every rate."""

from __future__ import annotations

import control
import numpy as np
import pytest

from kfopc_filterpy.paths import fir_path, frequency_response, path_taps, resample_path

RATES = [(44100, 16000), (48000, 16000), (16000, 8000), (16000, 44100), (16000, 48000), (12000, 16000), (44101, 48000)]


def sampled(fs: float, start_s: float = 0.004) -> np.ndarray:
    """Impulse response of three arrivals, tones of 700 to 2000 Hz in Gaussian envelopes, sampled at `fs`.

    The envelope's spectrum has fallen by 100 dB at 3.2 kHz, so any rate of 8 kHz or more has all of it. A tap is the
    response times 1/fs, because the sum over taps stands for an integral over time.
    """
    t = np.arange(round(0.016 * fs)) / fs
    arrivals = ((start_s, 1.0, 700.0), (start_s + 0.0023, -0.6, 2000.0), (start_s + 0.0041, 0.3, 1200.0))
    return sum(
        gain * 3000 * np.exp(-(((t - at) * 2200) ** 2)) * np.cos(2 * np.pi * hz * (t - at)) / fs
        for at, gain, hz in arrivals
    )


@pytest.mark.parametrize(("fs", "new_fs"), RATES)
def test_the_taps_are_those_that_the_new_rate_samples(fs, new_fs):
    got, wanted = resample_path(sampled(fs), new_fs, fs=fs), sampled(new_fs)
    assert wanted.size <= got.size <= wanted.size + 10 * max(new_fs / fs, 1) + 2
    # scipy's filter has a ripple of -54 dB, 0.2 %.
    np.testing.assert_allclose(got[: wanted.size], wanted, atol=0.004 * np.abs(wanted).max())
    assert np.abs(got[wanted.size :]).max(initial=0) < 0.004 * np.abs(wanted).max()


@pytest.mark.parametrize(("fs", "new_fs"), RATES)
def test_the_response_in_the_band_is_kept_to_the_tolerance_stated(fs, new_fs, rng):
    taps = np.concatenate([np.zeros(60), rng.standard_normal(80) * 0.95 ** np.arange(80)])  # all of 0 to fs/2
    frequencies = np.linspace(0, 0.8 * min(fs, new_fs) / 2, 500)
    before = frequency_response(taps, frequencies, fs=fs)
    after = frequency_response(resample_path(taps, new_fs, fs=fs), frequencies, fs=new_fs)
    assert np.abs(after - before).max() < 0.004 * np.abs(before).max()


def test_it_returns_the_kind_it_was_given():
    taps = sampled(16000)
    system = resample_path(fir_path(taps, 16000), 8000)
    assert isinstance(system, control.TransferFunction)
    assert system.dt == 1 / 8000
    np.testing.assert_allclose(path_taps(system), resample_path(taps, 8000, fs=16000), atol=1e-15)
    same = resample_path(taps, 16000, fs=16000)
    np.testing.assert_array_equal(same, taps)


def test_energy_before_the_first_sample_is_refused_and_a_delay_mends_it():
    at_once = [1.0, -0.8, 0.4]  # much of it above 4 kHz, and no delay
    with pytest.raises(ValueError, match=r"begin with more delay: -\d+\.\d dB .*zeros, 10 samples of the lower rate"):
        resample_path(at_once, 8000, fs=16000)
    taps = resample_path(np.pad(at_once, (20, 0)), 8000, fs=16000)
    frequencies = np.linspace(0, 3200, 100)
    np.testing.assert_allclose(
        np.abs(frequency_response(taps, frequencies, fs=8000)),
        np.abs(frequency_response(at_once, frequencies, fs=16000)),
        atol=0.004 * 2.2,
    )
    early = sampled(16000, start_s=0.001)  # begins at once too, but softly
    assert np.abs(early[0]) > 0.002 * np.abs(early).max()
    assert resample_path(early, 8000, fs=16000).size


@pytest.mark.parametrize(
    ("path", "rates", "message"),
    [
        ([1.0], {}, "fs must be given"),
        ([1.0], {"fs": 44100 * np.pi}, "ratio of whole numbers"),
        (fir_path([0.0, 1.0], 16000), {"fs": 44100}, "is sampled at 16000 Hz but fs is 44100"),
        (control.TransferFunction([1.0, 0.0], [1.0, -0.5], 1 / 16000), {}, "infinite impulse response"),
    ],
    ids=["no rate", "irrational", "other rate", "iir"],
)
def test_refusals(path, rates, message):
    with pytest.raises(ValueError, match=message):
        resample_path(path, 8000, **rates)


def test_a_silent_path_stays_silent() -> None:
    np.testing.assert_array_equal(resample_path(np.zeros(64), 8000, fs=16000), 0.0)
