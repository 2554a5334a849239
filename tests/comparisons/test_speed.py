"""The speed study: its arithmetic and its files; the times themselves are the machine's."""

from __future__ import annotations

import json
import tracemalloc

import numpy as np
import pytest
from helpers.studies import smaller

from comparisons import __main__ as command
from comparisons.__main__ import main
from comparisons.speed import study as speed
from comparisons.speed import variants as speed_variants
from kfopc_filterpy import MOVFxLMS, kf_opc, simulate
from kfopc_filterpy.power.constraint import OutputPowerConstraint

BLOCK_TIMES = speed.block_times


@pytest.fixture
def small():
    """The study with few taps and samples, no compilation timed, and the same filters wherever it runs."""
    counts = {"TAPS": (128, 256), "ROUNDS": 1, "WORST_TAPS": (16,), "WORST_SAMPLES": 200, "CHANNEL_BLOCKS": 2}
    own = {"block_times": lambda: BLOCK_TIMES(6400), "find_spec": lambda name: None}
    variants = {
        "CHANNELS": [(1, 2, 3, 16)],
        "LONG_TAPS": (512, 1024),
        "BLOCK_CONTROLLERS": {"FxLMS, 256 taps": speed_variants.BLOCK_CONTROLLERS["FxLMS, 256 taps"]},
        "samples_for": lambda taps, most=0, least=0: 96,
    }
    with smaller(speed, **counts, **own), smaller(speed_variants, **variants):
        yield


@pytest.mark.slow
def test_the_command_writes_what_it_measured(small, tmp_path, capsys):
    assert main(["speed", "--quiet", "--output", str(tmp_path)]) == 0
    result = json.loads((tmp_path / "speed.json").read_text())
    assert (tmp_path / "speed.png").stat().st_size > 10000
    rows = {(row["variant"], row["taps"]): row for row in result["rows"]}
    for name in speed_variants.OURS:
        for taps in (128, 256):
            row = rows[name, taps]
            for other, figure in (("filterpy", "times_filterpy"), ("numpy rank-1", "times_numpy")):
                assert row[figure] == pytest.approx(rows[other, taps]["us_per_sample"] / row["us_per_sample"])
    # An O(L^3) filter is slower than an O(L^2) one at 256 taps on any machine.
    assert rows["filterpy API of KFOPC", 256]["times_filterpy"] > 5
    (channels,) = result["channels"]
    assert channels["us_per_sample"] > 0
    for block, length in zip(result["blocks"], (16, 64, 256), strict=True):
        assert 0.0 < block["median_us"] <= block["percentile_99_99_us"] <= block["worst_us"]
        assert block["shares"][0] == pytest.approx(
            [block[key] * 16e3 / 1e6 / length for key in ("median_us", "percentile_99_99_us", "worst_us")]
        )
    assert {(row["controller"], row["taps"]) for row in result["long"]} == {
        (name, taps) for name in speed_variants.LONG for taps in (512, 1024)
    }
    printed = capsys.readouterr().out
    for said in ("FxLMS, compiled ", "FxLMS, 256 taps ", "     1 x  2 x  3,   16", "16 taps, 200 samples"):
        assert said in printed
    assert all(row["what"] in printed for row in result["beside_filterpy"])
    many = result["beside_filterpy"][-1]
    assert many["filterpy_us"] > 5 * many["ours_us"], many  # O(L^3) against O(L^2) at 256 taps


def test_rows_follow_from_the_measured_times():
    mine, *_ = speed.rows_of(100, 30.0, {"mine": 2.0, "filterpy": 100.0, "numpy rank-1": 8.0})
    # 3 * 100^2 flops at 30 GFLOP/s take 1 us.
    expected = {"variant": "mine", "taps": 100, "us_per_sample": 2.0, "limit_fraction": 0.5}
    assert mine == expected | {"times_filterpy": 50.0, "times_numpy": 4.0}


def test_real_time_taps_are_the_most_that_are_done_before_the_next_sample():
    rows = [{"variant": "a", "taps": n, "us_per_sample": us} for n, us in ((32, 1.0), (64, 20.0), (128, 21.0))]
    assert speed.real_time_taps(rows, "a", 48000.0) == 64  # 20.8 us
    assert speed.real_time_taps(rows, "a", 2e6) is None


def test_a_filter_that_is_not_installed_is_left_out():
    with smaller(speed, find_spec=lambda name: None):
        assert set(speed.chosen_variants(64)) == {*speed_variants.OURS, "numpy rank-1", "filterpy"}


def test_speed_without_its_extra_says_what_to_install(tmp_path, capsys):
    with smaller(command, find_spec=lambda name: None), pytest.raises(SystemExit):
        main(["speed", "--output", str(tmp_path)])
    assert '".[bench]"' in capsys.readouterr().err


# ---- What a run needs beside what it returns


def peak_beyond_the_result(make, n_samples, **options):
    """Bytes allocated at the worst moment of a run, less those of the result."""
    x = np.random.default_rng(0).standard_normal(n_samples)
    paths = {"primary_path": np.ones(128) / 128, "secondary_path": np.ones(32) / 32, "fs": 48000.0}
    simulate(make(), x[:10], **paths)  # compiled, imported
    controller = make()
    tracemalloc.start()
    result = simulate(controller, x, sensor_noise_std=0.1, rng=1, **paths, **options)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak - sum(value.nbytes for value in vars(result).values() if isinstance(value, np.ndarray))


def test_memory_of_a_minute_at_48_khz():
    """60 s at 48 kHz with 1024 taps: within 50 MB of the returned signals. The LMS run has all of the loop's memory..."""
    settings = {"constraint": OutputPowerConstraint(1.0, fs=48000.0)}
    lms = peak_beyond_the_result(lambda: MOVFxLMS(1024, np.ones(32) / 32, step_size=1e-6, **settings), 60 * 48000)
    assert 0 < lms < 30e6


def test_memory_of_1024_taps():
    """... and what the Kalman filter adds does not grow with the signal: P, 8.4 MB, which the controller brings along."""
    kalman = {"state_noise": 1e-8, "measurement_noise": 1.0, "initial_variance": 1e-3}
    settings = {"constraint": OutputPowerConstraint(1.0, fs=48000.0)}
    run_alone = peak_beyond_the_result(lambda: kf_opc(1024, np.ones(32) / 32, **kalman, **settings), 500)
    assert run_alone < 50e6 - 30e6 - 8.4e6
