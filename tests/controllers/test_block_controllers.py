"""Controllers that adapt once per block: against the block LMS, the best filters, the limits of bands, and a limiter."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from helpers.channels import random_paths, through
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import lms, signals
from scipy.signal import lfilter

from kfopc_filterpy import (
    BandLimitedFxLMS,
    FrequencyDomainFxLMS,
    FrequencyDomainKalman,
    LimitedController,
    OutputLimiter,
    SubbandFxLMS,
    kf_pb,
    noise_reduction_db,
    power_constrained_wiener,
    simulate,
)
from kfopc_filterpy.bounds import wiener_solution

FS, DELAY = 16000.0, 32
SECONDARY = np.concatenate((np.zeros(DELAY), [0.8, 0.3, -0.2, 0.1]))
PRIMARY = np.concatenate((np.zeros(36), 0.9 ** np.arange(60.0) * np.cos(np.arange(60.0))))


class BlockLMS(lms.FxLMS):
    """Add up the steps of a block and take them at its end."""

    block = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        self.steps: list[np.ndarray] = []

    def adapt(self, e: np.ndarray) -> None:
        # w(n0 + B) = w(n0) + mu sum_n e(n) x'(n)
        self.steps.append(self.mu * self.gradient(e))
        if len(self.steps) == self.block:
            self.w, self.steps = self.w + sum(self.steps), []


@settings(max_examples=25, deadline=None)
@given(
    channels=st.sampled_from([(1, 1, 1), (3, 2, 2)]),
    sizes=st.tuples(st.integers(1, 40), st.integers(1, 20), st.integers(1, 6)),
    path_taps=st.integers(3, 12),
)
def test_without_division_it_is_the_block_lms_in_any_partition(
    channels: tuple[int, int, int], sizes: tuple[int, int, int], path_taps: int
) -> None:
    """To 1e-10 of the largest value: transforms add up in another order, about 1e-15 of each sum."""
    (K, J, I), (L, B, multiple) = channels, sizes  # noqa: E741
    s, rng = random_paths(K, J, path_taps, seed=1), np.random.default_rng(2)
    x = rng.standard_normal((I, 150))
    d = through(random_paths(K, I, 9, seed=3), x) + 0.1 * rng.standard_normal((K, 150))
    mu = 0.05 / (L * B * np.sum(s**2))
    oracle = BlockLMS(s_hat=s, n_taps=L, n_references=I, mu=mu)
    oracle.block = B
    expected = signals.run(oracle, x, d, s)
    controller = FrequencyDomainFxLMS(
        L, s, step_size=mu, block_size=B, partition_size=multiple * B, forgetting=None, n_references=I
    )
    result = simulate(controller, x, disturbance=d, secondary_path=s)
    for got, wanted in (
        (result.control_signal, expected.y),
        (result.error, expected.e),
        (controller.weights, expected.w),
    ):
        np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-10 * max(np.abs(wanted).max(), 1e-3))


def coloured(seconds: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return a reference with a peak 30 dB high at 1.2 kHz, and the disturbance with some noise of its own."""
    rng = np.random.default_rng(seed)
    x = lfilter([1.0], [1.0, -1.6, 0.8], rng.standard_normal(int(seconds * FS)))
    x /= np.std(x)
    return x, lfilter(PRIMARY, [1.0], x) + 0.02 * rng.standard_normal(x.size)


def closed_loop(controller: Any, x: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return control signal and error over the second half, run in blocks as short as the secondary path's delay."""
    line, e = np.zeros(SECONDARY.size - 1 + x.size), np.zeros(x.size)  # the control signal after zeros
    y = line[SECONDARY.size - 1 :]
    for a in range(0, x.size, DELAY):
        b = a + DELAY
        e[a:b] = d[a:b] - np.convolve(line[a : b + SECONDARY.size - 1], SECONDARY, "valid")
        y[a:b] = controller.process(x[a:b], e[a:b])
    return y[x.size // 2 :], e[x.size // 2 :]


def near_wiener(**settings: Any) -> Any:
    return FrequencyDomainFxLMS(128, SECONDARY, step_size=0.1, block_size=32, **settings)


@pytest.mark.parametrize(
    ("controller", "loss_db"),
    [
        pytest.param(near_wiener(), 0.3, id="partitions"),
        pytest.param(near_wiener(partition_size=128), 0.3, id="one partition"),
        pytest.param(near_wiener(constrained=False), 1.0, id="unconstrained"),
        pytest.param(FrequencyDomainKalman(128, SECONDARY, block_size=32), 1.5, id="Kalman"),
        pytest.param(SubbandFxLMS(128, SECONDARY, step_size=0.15, n_bands=16, block_size=32), 4.0, id="subband"),
    ],
)
def test_it_settles_near_the_best_filter(controller: Any, loss_db: float) -> None:
    """In 4 s, on a colour that the LMS of one step size needs minutes for."""
    x, d = coloured(8.0)
    _, e = closed_loop(controller, x, d)
    best = wiener_solution(x, d, SECONDARY, n_taps=128).noise_reduction_db
    assert abs(best - loss_db / 2 - noise_reduction_db(e, d[-e.size :])) < loss_db / 2 + 0.1


def band_power(y: np.ndarray, low: float, high: float) -> float:
    """Return the power of a signal from `low` to `high` Hz, of all its samples at once."""
    frequencies = np.fft.rfftfreq(y.size, 1 / FS)
    inside = (frequencies >= low) & (frequencies < high)
    return float(2 * np.sum(np.abs(np.fft.rfft(y)[inside]) ** 2) / y.size**2)


def test_each_band_keeps_its_limit_and_the_others_are_left_alone() -> None:
    x, d = coloured(12.0)
    edges = [0.0, 900.0, 1800.0, 4000.0, 8000.0]

    def powers(limits: Any) -> np.ndarray:
        controller = BandLimitedFxLMS(
            128,
            SECONDARY,
            step_size=0.2,
            block_size=64,
            partition_size=128,
            band_edges=edges,
            band_powers=limits,
            fs=FS,
        )
        assert controller.rated_power == pytest.approx(np.sum(limits))
        y, _ = closed_loop(controller, x, d)
        return np.array([band_power(y, *band) for band in itertools.pairwise(edges)])

    free = powers([1e3] * 4)
    limits = free * [10.0, 0.25, 10.0, 0.25]
    used = powers(limits) / limits
    assert np.all(used[[1, 3]] < 1.02)
    assert np.all(used[[1, 3]] > 0.93)  # an edge is two bins wide, and at 4 kHz the spectrum falls by 20 % in these
    assert np.all(used[[0, 2]] > 0.06)  # 0.1 if the edges of a filter of 128 taps were sharp


def test_one_band_is_the_bound_of_the_total_power() -> None:
    """Within 0.1 dB, and not behind KF-PB by more than that."""
    x, d = coloured(12.0)
    bound = power_constrained_wiener(
        x, disturbance=d, secondary_path=SECONDARY, n_taps=128, rated_power=0.5, fs=FS, switch_on_s=6.0
    )
    limited = BandLimitedFxLMS(
        128, SECONDARY, step_size=0.1, block_size=64, band_edges=[0, FS / 2], band_powers=[0.5], fs=FS
    )
    reductions = []
    for controller in (limited, kf_pb(128, SECONDARY, rated_power=0.5, fs=FS)):
        y, e = closed_loop(controller, x, d)
        assert np.mean(y**2) < 1.02 * 0.5
        reductions.append(noise_reduction_db(e, d[-e.size :]))
    assert reductions[0] > max(bound.whole.noise_reduction_db, reductions[1]) - 0.1
    limited.rated_power = 0.25
    assert limited.band_powers == pytest.approx([0.25])


def test_the_kalman_filter_learns_from_what_a_limiter_lets_through() -> None:
    """Its estimate of the disturbance needs the limited signal; with the other one it would learn something else."""
    x, d = coloured(1.5)
    controller = FrequencyDomainKalman(64, SECONDARY, block_size=32)
    limited = LimitedController(controller, OutputLimiter(0.2, fs=FS))
    y, _ = closed_loop(limited, x, d)
    assert np.mean(y**2) < 0.21
    learned = lfilter(SECONDARY, [1.0], lfilter(controller.weights, [1.0], x))
    assert noise_reduction_db((d - learned)[-y.size :], d[-y.size :]) > 15


def test_the_kalman_filter_waits_for_a_disturbance_that_is_longer_under_way_than_its_blocks() -> None:
    """Without it, errors that are exactly zero would make it certain of its weights."""
    x, path = np.random.default_rng(0).standard_normal(16000), np.r_[np.zeros(90), 0.5, 0.3, -0.2]
    controller = FrequencyDomainKalman(128, SECONDARY, block_size=16)
    run = simulate(controller, x, primary_path=path, secondary_path=SECONDARY)
    assert noise_reduction_db(run.error, run.disturbance) > 30


BANDS: dict[str, Any] = {"band_edges": [0, 4000, 8000], "band_powers": [1.0, 1.0]}


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (FrequencyDomainFxLMS, {"partition_size": 12}, "multiple of block_size = 8"),
        (FrequencyDomainFxLMS, {"n_taps": 20, "constrained": False}, "n_taps must be a multiple of partition_size = 8"),
        (FrequencyDomainFxLMS, {"constrained": "no"}, "constrained must be one of True, False, got 'no'"),
        (FrequencyDomainFxLMS, {"secondary_path": np.zeros(4)}, "secondary_path must not be all zeros"),
        (FrequencyDomainFxLMS, {"forgetting": 1.5}, "forgetting must be 1 at most"),
        (BandLimitedFxLMS, BANDS | {"band_edges": [0, 4000, 3000]}, "band_edges must rise"),
        (BandLimitedFxLMS, BANDS | {"band_edges": [0, 4000, 8001]}, "8000 Hz at most"),
        (BandLimitedFxLMS, BANDS | {"band_edges": [0, 100, 8000]}, "1000 Hz apart at least"),
        (BandLimitedFxLMS, BANDS | {"band_powers": [1.0]}, r"each of the 2 bands, \(2,\), got shape \(1,\)"),
        (SubbandFxLMS, {"n_bands": 5}, "n_bands must be even"),
        (SubbandFxLMS, {"n_bands": 32}, "n_taps must be a multiple of 32"),
        (SubbandFxLMS, {"n_bands": 8, "block_size": 6}, "block_size must be a multiple of 4"),
        (FrequencyDomainKalman, {"transition": 1.1}, "transition must be 1 at most"),
        (FrequencyDomainKalman, {"secondary_path": np.ones((1, 1, 3))}, "takes one channel"),
    ],
)
def test_settings_that_do_not_fit_are_refused(kind: Any, options: dict[str, Any], message: str) -> None:
    step = {} if kind is FrequencyDomainKalman else {"step_size": 0.1}
    with pytest.raises(ValueError, match=message):
        kind(**{"n_taps": 16, "secondary_path": SECONDARY, "block_size": 8} | step | options)


def test_an_error_without_its_control_signal_is_refused() -> None:
    controller = near_wiener()
    with pytest.raises(ValueError, match="must follow the control_signal"):
        controller.update(1.0)


@pytest.mark.parametrize(("where", "largest"), [("reference", 1e20), ("disturbance", 1e100)])
def test_a_run_names_the_sample_that_is_refused(where: str, largest: float) -> None:
    signals = dict(zip(("reference", "disturbance"), coloured(0.01), strict=True))
    signals[where][77] = 2.0 * largest
    for compiled in (True, False):
        with pytest.raises(ValueError, match=r"must not be louder than 1e\+\d+: .*\nin sample 77 of the run"):
            simulate(near_wiener(), secondary_path=SECONDARY, fs=FS, compiled=compiled, **signals)


def test_a_run_records_what_a_subclass_tells_after_each_sample() -> None:
    class Counting(FrequencyDomainFxLMS):
        @property
        def constraint_factor(self) -> float:
            return float(self.samples_left)

    run = simulate(
        Counting(16, SECONDARY, step_size=0.1, block_size=4),
        np.ones(8),
        primary_path=PRIMARY,
        secondary_path=SECONDARY,
        fs=FS,
    )
    np.testing.assert_array_equal(run.constraint_factor, [3, 2, 1, 4, 3, 2, 1, 4])


def test_bands_are_for_one_sample_rate() -> None:
    controller = BandLimitedFxLMS(16, SECONDARY, step_size=0.1, block_size=8, **BANDS)
    with pytest.raises(ValueError, match="bands is for 16000 Hz"):
        controller.require_sample_rate(8000.0)
