"""Bursts, swelling noise and loops against their description: statistics with their standard errors, closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.studies import smaller

from comparisons.bench import noises
from comparisons.bench.noises import bursty_noise, level_jump, looped, swelling
from kfopc_filterpy.signals import band_limited_noise, tone

FS = 1000.0
EXACT = 1e-12  # rounding of a sum of 1e6 squares is far below it
WIDE = (50.0, 450.0)  # of 500 Hz: the band's own ringing is a few samples

# ---- Bursts


def bursts(duration_s: float = 1000.0, **constants: Any) -> np.ndarray:
    """Return bursts of one level over almost no background."""
    quiet = {"BURSTS_HZ": 2.0, "BURST_BAND_HZ": WIDE, "LEVEL_SPREAD_DB": 0.0, "BACKGROUND_DB": -90.0, "DECAY_S": 0.02}
    with smaller(noises, **quiet | constants):
        return bursty_noise(duration_s, fs=FS, rng=5)


def edges(x: np.ndarray, threshold: float, hold: int = 15) -> tuple[np.ndarray, np.ndarray]:
    """Return where groups of overlapping bursts begin and end; no sample exceeds the threshold for `hold` samples."""
    loud = np.flatnonzero(np.abs(x) > threshold)
    gaps = np.flatnonzero(np.diff(loud) > hold)
    return loud[np.concatenate([[0], gaps + 1])], loud[np.concatenate([gaps, [loud.size - 1]])]


def test_bursts_come_as_a_poisson_process() -> None:
    """The pauses of a Poisson process are exponential with mean 1/rate, however long the bursts are and however they
    overlap. Mean and standard deviation are therefore equal; both are held to 5 standard errors."""
    rate = 0.5
    starts, ends = edges(bursts(BURSTS_HZ=rate), 0.01)
    pauses = (starts[1:] - ends[:-1] - 15) / FS  # a pause is seen from 15 samples on
    assert np.mean(pauses) == pytest.approx(1 / rate, rel=5 / np.sqrt(pauses.size))
    # relative standard error of the estimated standard deviation of an exponential distribution: sqrt(2/n)
    assert np.std(pauses) == pytest.approx(1 / rate, rel=5 * np.sqrt(2 / pauses.size))
    # as many in the first half as in the second
    first_half = np.sum(starts < 500 * FS)
    assert first_half == pytest.approx(starts.size / 2, abs=5 * np.sqrt(starts.size / 4))


def lone(x: np.ndarray, decay: float, threshold: float = 0.01, rings_s: float = 0.03) -> np.ndarray:
    """Return where bursts begin that overlap with no other: an envelope ends after 6 tau, and the filter rings a little."""
    starts, ends = edges(x, threshold, hold=30)
    return starts[(ends - starts < (6 * decay + rings_s) * FS) & (starts < x.size - 8 * decay * FS)]


def test_bursts_die_away_with_their_time_constant() -> None:
    """The mean power of n lone bursts falls as exp(-2 t/tau).

    Each sample of it has a relative error of sqrt(2/n). A slope fitted to its logarithm over 2 tau, that is m samples of
    which the band leaves 0.8 m independent, has an error of sqrt(2/n) sqrt(12/(0.8 m))/(2 tau). The tolerance is 5 of
    these, plus 3 % for the few bursts that overlap unnoticed in the first 30 ms and so seem longer.
    """
    decay = 0.2
    x = bursts(duration_s=2000.0, BURSTS_HZ=0.3, DECAY_S=decay)
    starts = lone(x, decay)
    first, m = 8, round(2 * decay * FS)  # samples of the band's onset, samples fitted
    power = np.mean([x[s + first : s + first + m] ** 2 for s in starts], axis=0)
    slope = np.polyfit(np.arange(m) / FS, np.log(power), 1)[0]
    assert starts.size > 200
    assert -2 / slope == pytest.approx(decay, rel=5 * np.sqrt(2 / starts.size) * np.sqrt(12 / (0.8 * m)) / 4 + 0.03)


def test_the_background_has_its_level() -> None:
    """The background is measured between the bursts, which the same seed without background shows.

    800 s with 0.8 degrees of freedom per sample give its power to 5 sqrt(2/640000) = 0.9 %, and the power of bursts and
    background together, which is 1, to the same.
    """
    starts, ends = edges(bursts(BURSTS_HZ=0.5, DECAY_S=0.01), 1e-3, hold=40)
    x = bursts(BURSTS_HZ=0.5, DECAY_S=0.01, BACKGROUND_DB=-6.0)
    ratio = 10**-0.6
    pause = np.ones(x.size, dtype=bool)
    for start, end in zip(starts, ends, strict=True):
        pause[max(start - 5, 0) : end + 60] = False
    assert np.sum(pause) > 800_000
    assert np.mean(x[pause] ** 2) == pytest.approx(ratio / (1 + ratio), rel=0.025)


# ---- Swelling


@pytest.mark.parametrize(("swing", "period", "phase"), [(6.0, 4.0, 0.0), (3.0, 1.6, 1.0)])
def test_the_level_swings_as_a_sine_of_its_period(swing: float, period: float, phase: float) -> None:
    """The level is measured as the power of noise in each 40th of a period, 0.04 s and more.

    About 80 degrees of freedom give 0.7 dB for each, and 400 of them 0.7 sqrt(2/400) = 0.05 dB for the amplitude of the
    sine. The tolerance is 5 of these.
    """
    noise = band_limited_noise((50.0, 1000.0), 10 * period, fs=2000.0, rng=3)
    y = swelling(noise, fs=2000.0, swing_db=swing, period_s=period, phase_rad=phase)
    assert np.mean(y**2) == pytest.approx(np.mean(noise**2), rel=EXACT)
    level = 10 * np.log10(np.mean(y.reshape(400, -1) ** 2, axis=1))
    spectrum = np.fft.rfft(level - np.mean(level)) / 200
    assert np.argmax(np.abs(spectrum)) == 10  # ten periods
    assert np.abs(spectrum[10]) == pytest.approx(swing, abs=0.25 + 0.005 * swing)  # a 40th's mean flattens by 0.1 %
    # a sine: phase less a quarter turn, at the middle of the first 40th
    seen = np.angle(spectrum[10] * np.exp(-1j * np.pi / 40) * 1j * np.exp(-1j * phase))
    assert seen == pytest.approx(0.0, abs=0.25 / swing + 0.01)


# ---- Looped


RECORDING = np.random.default_rng(4).standard_normal(5000)  # of 1 s at 5000 Hz: the fade takes 250
RATE, FADE = 5000.0, 250
TURN = 5000 - FADE


def test_one_turn_is_the_recording_but_for_the_fade() -> None:
    y = looped(RECORDING, TURN / RATE, fs=RATE)
    np.testing.assert_array_equal(y[FADE:], RECORDING[FADE:TURN])
    assert np.all(y[:FADE] != RECORDING[:FADE])
    np.testing.assert_array_equal(looped(RECORDING, 0.5, fs=RATE), y[:2500])


@pytest.mark.parametrize(("turns", "start"), [(0.3, 0.9), (2.7, 3.21)])
def test_it_goes_round_and_begins_anywhere(turns: float, start: float) -> None:
    """Sample n is sample n + start of a loop of one turn."""
    one = looped(RECORDING, TURN / RATE, fs=RATE)
    y = looped(RECORDING, turns * TURN / RATE, fs=RATE, start_s=start)
    assert y.size == round(turns * TURN / RATE * RATE)
    np.testing.assert_array_equal(y, one[(round(start * RATE) + np.arange(y.size)) % TURN])


@pytest.mark.parametrize(("frequency", "samples"), [(20.0, 2001), (113.0, 5987), (400.0, 4321)])
def test_a_tone_has_no_click(frequency: float, samples: int) -> None:
    """Steps between samples stay below those of both tones under the fade, at most sqrt(2), plus the slope of the fade."""
    turn = 2 * np.pi * frequency / RATE
    y = looped(np.sin(turn * np.arange(samples) + 1.0), 3.0, fs=RATE)
    assert np.max(np.abs(np.diff(y))) <= np.sqrt(2) * (turn + np.pi / (2 * FADE))


# ---- Jumps


def test_level_jump_scales_the_rest_and_leaves_its_input() -> None:
    x = tone(40.0, 1.0, fs=FS)
    kept = x.copy()
    louder = level_jump(x, 0.25, 6.0, fs=FS)
    np.testing.assert_array_equal(x, kept)
    np.testing.assert_array_equal(louder[:250], x[:250])
    np.testing.assert_allclose(louder[250:], x[250:] * 1.9952623149688795, rtol=1e-15, atol=0)
