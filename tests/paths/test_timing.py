"""What two recordings show of their clocks, lost samples and order, where one explains the other badly."""

from __future__ import annotations

import re

import numpy as np
import pytest

from kfopc_filterpy import Plant
from kfopc_filterpy.commands import main
from kfopc_filterpy.paths.timing import plays_once, timing_fault
from kfopc_filterpy.power import AmplifierRating
from kfopc_filterpy.signals import write_wav
from kfopc_filterpy.verdict import assess

FS, DELAY, N = 8000, 20, 8 * 8000
RNG = np.random.default_rng(3)
FREQUENCIES, PHASES = RNG.uniform(50, 3500, 300), RNG.uniform(0, 2 * np.pi, 300)


def noise(times):
    """Return noise that is known between the samples, too."""
    return np.sum([np.cos(2 * np.pi * f * times + phase) for f, phase in zip(FREQUENCIES, PHASES, strict=True)], axis=0)


@pytest.fixture(scope="module")
def sent():
    return noise(np.arange(N) / FS)


def with_clock(ppm):
    return 0.5 * noise((np.arange(N) * (1 - 1e-6 * ppm) - DELAY) / FS)


@pytest.mark.parametrize("ppm", [-50, 50, 300])
@pytest.mark.parametrize("snr_db", [None, 20])
def test_clocks_that_differ_are_told_with_their_ppm(sent, ppm, snr_db):
    heard = with_clock(ppm)
    if snr_db is not None:
        heard += heard.std() * 10 ** (-snr_db / 20) * np.random.default_rng(0).standard_normal(N)
    fault = timing_fault(sent, heard, FS, ("x", "d"))
    found = re.search(r"delay of d drifts by (\S+) samples, so the clocks differ by (\S+) ppm", fault)
    assert float(found[1]) == pytest.approx(ppm * 1e-6 * N, abs=0.3)
    assert float(found[2]) == pytest.approx(ppm, abs=3)


@pytest.mark.parametrize(
    ("lost", "said"), [(256, "256 samples earlier"), (16, "16 samples earlier"), (-64, "64 samples later")]
)
def test_a_lost_block_is_told_with_its_samples_and_its_place(sent, lost, said):
    heard, at = np.pad(with_clock(0), (0, 300)), 3 * FS
    heard = np.concatenate([heard[:at], heard[at + lost :]])[:N]
    fault = timing_fault(sent, heard, FS, ("x", "d"))
    assert said in fault
    assert float(re.match(r"from about (\S+) s on, d is", fault)[1]) == pytest.approx(3, abs=1)


def sweep(times, seconds):
    """Return sweeps of some seconds from 200 to 3000 Hz, one after the other."""
    within = np.mod(times, seconds)
    return np.sin(2 * np.pi * (200 * within + 1400 / seconds * within**2))


def test_clocks_that_differ_show_in_a_sweep_that_is_played_twice():
    times = np.arange(N) / FS
    heard = 0.5 * sweep(times * (1 - 50e-6) - DELAY / FS, 4)
    assert re.search(r"the clocks differ by \+(4\d|5\d)\.\d ppm", timing_fault(sweep(times, 4), heard, FS, ("x", "d")))


def test_a_lost_block_shows_in_sweeps():
    """Between sweeps that are played twice, with its samples; in a single sweep, it may have other causes."""
    times = np.arange(N) / FS
    for seconds, lost, told in (
        (4, 4.0, "in its second half, d is 256 samples earlier than before: a block was lost"),
        (8, 4.0, "d comes 29.5 ms before x: are the files swapped, or was a block lost?"),
    ):
        heard = sweep(times - DELAY / FS + np.where(times < lost, 0, 256 / FS), seconds)
        assert timing_fault(sweep(times, seconds), heard, FS, ("x", "d")).startswith(told)


def test_only_a_single_sweep_plays_each_frequency_once(sent):
    times = np.arange(N) / FS
    assert plays_once(np.pad(sweep(times, 8), FS))
    for one in (sent, sweep(times, 4), np.eye(N, 1)[:, 0], sent * (times < 0.2)):
        assert not plays_once(one)


def test_identify_says_what_a_single_sweep_does_not_show(tmp_path, capsys):
    """With clocks 50 ppm apart, it explains all but -40 dB: a path that delays high frequencies more looks the same."""
    times = np.arange(N) / FS
    for name, signal in (("x", sweep(times, 8)), ("d", sweep(times * (1 - 50e-6) - DELAY / FS, 8))):
        write_wav(tmp_path / f"{name}.wav", signal, FS)
    names = [str(tmp_path / f"{name}.wav") for name in ("x", "d", "S")]
    assert main(["paths", "identify", *names[:2], "--taps", "64", "-o", names[2]]) == 0
    assert "x.wav plays each frequency once, so clocks that differ and lost samples" in capsys.readouterr().err


def test_swapped_files_are_told(sent):
    assert (
        timing_fault(with_clock(0), sent, FS, ("x", "d"))
        == "d comes 2.5 ms before x: are the files swapped, or was a block lost?"
    )


@pytest.mark.parametrize("silent_from", [N // 2, N])
@pytest.mark.parametrize("noise_gain", [0, 0.5, 3])
def test_recordings_of_one_clock_have_no_fault_however_noisy(sent, noise_gain, silent_from):
    sent, heard = (np.where(np.arange(N) < silent_from, signal, 0.0) for signal in (sent, with_clock(0)))
    heard = heard + noise_gain * np.random.default_rng(0).standard_normal(N) * sent.std()
    assert timing_fault(sent, heard, FS, ("x", "d")) is None


def test_identify_refuses_a_path_of_two_clocks_and_names_them(sent, tmp_path, capsys):
    """The gain of 0.5 would come out as 0.2 or so."""
    for name, signal in (("sent", sent), ("heard", with_clock(50))):
        write_wav(tmp_path / f"{name}.wav", signal, FS)
    names = [str(tmp_path / f"{name}.wav") for name in ("sent", "heard", "S")]
    assert main(["paths", "identify", *names[:2], "--taps", "64", "-o", names[2]]) == 2
    assert re.search(r"the clocks differ by \+(49|50|51)\.\d ppm: .* Nothing was written", capsys.readouterr().err)
    assert not (tmp_path / "S.wav").exists()


@pytest.mark.parametrize(
    ("heard", "want_db", "limited_by", "told"),
    [
        (with_clock(300), 20, "coherence", r"The delay of disturbance drifts .* \+(29[89]|30[01])\.\d ppm"),
        (np.delete(with_clock(0), slice(4 * FS, 4 * FS + 64)), 6, "filter", "From about 4 s .* 64 samples earlier"),
    ],
)
def test_a_verdict_names_clocks_and_lost_blocks_in_place_of_other_remedies(sent, heard, want_db, limited_by, told):
    plant, rating = Plant(np.eye(16)[8], fs=FS), AmplifierRating(8.0, sine_watt=1e5)
    settings = {"rating": rating, "want_db": want_db, "n_taps": 64, "beside": ()}
    verdict = assess(sent[: heard.size], plant, disturbance=heard, **settings)
    assert verdict.limited_by == limited_by
    assert re.match(told, verdict.advice[0])
