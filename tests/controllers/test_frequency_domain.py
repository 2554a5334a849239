"""KF-PB in the frequency-domain form: the estimate, its loss against the exact filter, and long paths."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.channels import random_paths, through

from kfopc_filterpy import kf_pb, noise_reduction_db, output_power, simulate
from kfopc_filterpy.controllers import FrequencyDomainKalman
from kfopc_filterpy.signals import band_limited_noise, compressor_noise, tone

FS = 4000.0
K, J, TAPS, PRIMARY = 3, 2, 24, 30
SECONDARY = random_paths(K, J, 12, seed=1)
PRIMARY_PATHS = random_paths(K, 2, PRIMARY, seed=2, delay=6)


def made(**changed: Any) -> FrequencyDomainKalman:
    settings: dict[str, Any] = {"n_references": 2, "n_primary": PRIMARY, "fs": FS} | changed
    return FrequencyDomainKalman(TAPS, SECONDARY, **settings)


def white(n_samples: int, count: int = 2) -> np.ndarray:
    return np.random.default_rng(0).standard_normal((count, n_samples))


@pytest.mark.parametrize("block", [8, 30, None], ids=["four partitions", "one partition", "longer than a path"])
def test_the_paths_are_found(block: int | None) -> None:
    controller = made(block=block, rated_power=0.3)
    simulate(controller, white(4000), primary_path=PRIMARY_PATHS, secondary_path=SECONDARY, fs=FS)
    error = np.linalg.norm(controller.primary_path - PRIMARY_PATHS) / np.linalg.norm(PRIMARY_PATHS)
    assert error < 1e-3  # -60 dB after a second


# ---- The loss against the exact filter

NOISES = {
    "white": lambda seconds: white(int(16000 * seconds), 1)[0],
    "100-1000 Hz": lambda seconds: band_limited_noise((100, 1000), seconds, fs=16000, rng=1),
    "tones": lambda seconds: sum(tone(f, seconds, fs=16000, amplitude=120 / f) for f in (120, 240, 371)),
    "compressor": lambda seconds: compressor_noise(seconds, fs=16000, rng=1),
}


@pytest.mark.parametrize("noise", NOISES)
def test_the_exact_filter_is_hardly_better(noise: str) -> None:
    """128 taps at 16 kHz: 0.1 dB in the steady half, at a quarter of the power wanted and without a limit."""
    primary, secondary = random_paths(2, 1, 160, seed=4, delay=40), random_paths(2, 2, 64, seed=5, delay=4)
    x = NOISES[noise](2.0)
    x = x / np.std(x)
    d = through(primary, x[np.newaxis])
    d += 0.05 * np.std(d) * np.random.default_rng(8).standard_normal(d.shape)
    half = x.size // 2
    rated: Any = 1e6
    for _ in range(2):
        reduction = {}
        for form in ("shared gain", "frequency domain"):
            controller = kf_pb(
                128, secondary, rated_power=rated, n_primary=192, form=form, secondary_path_uncertainty=None
            )
            result = simulate(controller, x, disturbance=d, secondary_path=secondary)
            reduction[form] = noise_reduction_db(result.error[:, half:], result.disturbance[:, half:])
            assert np.isfinite(result.error).all()
        assert reduction["frequency domain"] > reduction["shared gain"] - 0.1
        rated = output_power(result.control_signal[:, half:]) / 4


# ---- Long paths


def test_two_thousand_taps_reach_the_bound() -> None:
    """Loudspeakers of equal gain at all frequencies, white noise: the bound is the filter that cancels, scaled."""
    n_taps, delay = 2048, 40
    rng = np.random.default_rng(5)
    mixing = np.linalg.qr(rng.standard_normal((2, 2)))[0]
    secondary, primary = np.zeros((2, 2, delay + 1)), np.zeros((2, 1, n_taps))
    secondary[:, :, delay] = mixing
    primary[:, 0, delay:] = rng.standard_normal((2, n_taps - delay)) * np.exp(-np.arange(n_taps - delay) / 400)
    wanted = np.sum((mixing.T @ primary[:, 0, delay:]) ** 2, axis=1)
    rated = wanted * [0.25, 0.5]
    bound = -10 * np.log10(np.sum((1 - np.sqrt(rated / wanted)) ** 2 * wanted) / wanted.sum())
    controller = kf_pb(n_taps, secondary, rated_power=rated, form="frequency domain", secondary_path_uncertainty=None)
    result = simulate(controller, white(64000, 1), primary_path=primary, secondary_path=secondary)
    late = slice(24000, None)  # 2.5 s: in half a second, the reduction of white noise scatters by 0.2 dB
    assert abs(noise_reduction_db(result.error[:, late], result.disturbance[:, late], steady=1.0) - bound) < 0.1
    np.testing.assert_allclose(output_power(result.control_signal[:, late]) / rated, 1.0, atol=0.03)


# ---- Blocks


def test_what_is_heard_before_control_is_not_learned_but_remembered() -> None:
    x, d = white(1000), through(PRIMARY_PATHS, white(1000))
    controller = made(rated_power=0.3)
    controller.listen(x, d)
    np.testing.assert_array_equal(controller.primary_path, 0.0)
    np.testing.assert_array_equal(controller.weights, 0.0)
    begun = 1000 // controller.block * controller.block
    lags = controller._correlation.total.shape[0]
    keep = np.exp(-1.0 / (controller.memory_s * FS)) ** np.arange(begun - 1, -1, -1)
    past = np.pad(x[:, :begun], [(0, 0), (lags, 0)])
    sums = [past[:, lags - m : lags - m + begun] @ (keep * x[:, :begun]).T for m in range(lags)]
    np.testing.assert_allclose(controller._correlation.total, sums, atol=1e-9)


def test_defaults_grow_with_the_paths() -> None:
    short, long = FrequencyDomainKalman(256, np.ones((1, 1, 256))), FrequencyDomainKalman(4096, np.ones((1, 1, 256)))
    assert (short.block, short.path_memory_s, short.memory_s) == (512, 1.0, 0.5)
    assert (long.block, long.path_memory_s, long.memory_s) == (2187, 16 * 4352 / 16000, 16 * 4096 / 16000)


def test_what_overflows_is_refused() -> None:
    controller = made(block=16)
    with pytest.raises(ValueError, match="scale the signals"):
        simulate(controller, 1e160 * white(100), disturbance=np.ones((K, 100)), secondary_path=SECONDARY, fs=FS)
    np.testing.assert_array_equal(controller.primary_path, 0.0)


@pytest.mark.parametrize(
    ("changed", "error", "match"),
    [
        ({"block": 0}, ValueError, "block must be at least 1"),
        ({"block": 16.5}, TypeError, "block must be a whole number"),
        ({"n_primary": 0}, ValueError, "n_primary must be at least 1"),
        ({"memory_s": 0.0}, ValueError, "memory_s"),
    ],
    ids=["no block", "half a sample", "no path", "no memory"],
)
def test_settings_out_of_range_are_refused(changed: dict, error: type[Exception], match: str) -> None:
    with pytest.raises(error, match=match):
        made(**changed)


def test_it_is_a_form_of_kf_pb() -> None:
    assert isinstance(kf_pb(TAPS, SECONDARY, rated_power=1.0, form="frequency domain"), FrequencyDomainKalman)
    assert isinstance(kf_pb(TAPS, SECONDARY[0, 0], rated_power=1.0, form="frequency domain"), FrequencyDomainKalman)
    with pytest.raises(TypeError, match="the frequency domain form takes path_memory_s instead"):
        kf_pb(TAPS, SECONDARY, rated_power=1.0, form="frequency domain", measurement_noise=0.1)
