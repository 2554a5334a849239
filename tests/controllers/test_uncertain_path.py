"""Controllers whose secondary path is not as they know it: against the closed form of the settled error."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from kfopc_filterpy import kf_pb, noise_reduction_db, simulate
from kfopc_filterpy.paths import PathTolerance, guard_filter, path_uncertainty
from kfopc_filterpy.signals import tone

FS = 8000.0
TRUE = np.array([0.0, 0.0, 0.0, 1.0, -0.6])
LATE = np.array([0.0, 0.0, 1.0, -0.6, 0.0])  # an estimate that is a sample too early: the true path is late
EARLY = np.array([0.0, 0.0, 0.0, 0.0, 1.0, -0.6])
PRIMARY = np.array([0.0] * 8 + [0.8, 0.4])
TOLERANCE = PathTolerance(delay_samples=1.0)
DIRECT: dict[str, Any] = {"state_noise": 1e-9, "measurement_noise": 1e-3}
ONE_CHANNEL: dict[str, Any] = {"form": "shared gain"}


def reduction(settings: dict[str, Any], estimate: np.ndarray, x: np.ndarray, **more: Any) -> Any:
    settings = {"rated_power": 1e3, "fs": FS} | settings | more
    controller = kf_pb(24, estimate, **settings)
    shaped = x if settings.get("form") is None else x[np.newaxis]
    return simulate(controller, shaped, primary_path=PRIMARY, secondary_path=TRUE, fs=FS)


@pytest.mark.parametrize("settings", [DIRECT, ONE_CHANNEL], ids=["direct", "shared gain"])
@pytest.mark.parametrize("frequency", [600.0, 1000.0])
def test_a_tone_settles_at_the_closed_form(settings: dict[str, Any], frequency: float) -> None:
    """E/D = (1 - g)/(1 + g Delta), to 1 dB, with the g that the guard filter has at the tone and Delta of one sample."""
    x = tone(frequency, 6.0, fs=FS) + 1e-3 * np.random.default_rng(0).standard_normal(int(6 * FS))
    result = reduction(settings, LATE, x, secondary_path_uncertainty=TOLERANCE)
    omega = 2 * np.pi * frequency / FS
    guard = guard_filter(path_uncertainty(TOLERANCE, LATE))
    share = 1 / (1 + np.abs(np.sum(guard * np.exp(-1j * omega * np.arange(guard.size)))) ** 2)
    delta = np.exp(-1j * omega) - 1
    expected = -20 * np.log10(np.abs((1 - share) / (1 + share * delta)))
    assert noise_reduction_db(result.error, result.disturbance) == pytest.approx(expected, abs=1.0)


@pytest.mark.parametrize("settings", [DIRECT, ONE_CHANNEL], ids=["direct", "shared gain"])
@pytest.mark.parametrize("estimate", [LATE, EARLY], ids=["late", "early"])
def test_white_noise_is_never_louder_although_the_path_is_a_sample_off(
    settings: dict[str, Any], estimate: np.ndarray
) -> None:
    """In no second after the first; without the guard it is louder."""
    x = np.random.default_rng(1).standard_normal(int(5 * FS))

    def seconds(uncertainty: Any) -> list[float]:
        result = reduction(settings, estimate, x, rated_power=0.3, secondary_path_uncertainty=uncertainty)
        parts = [slice(int(k * FS), int((k + 1) * FS)) for k in range(1, 5)]
        error, disturbance = np.atleast_2d(result.error), np.atleast_2d(result.disturbance)
        return [-10 * np.log10(np.sum(error[:, part] ** 2) / np.sum(disturbance[:, part] ** 2)) for part in parts]

    assert min(seconds(TOLERANCE)) > 0.1
    assert min(seconds(PathTolerance(delay_samples=0.5))) > 0.1  # the default: enough for a sample as well
    assert min(seconds(None)) < 0.0


@pytest.mark.parametrize("settings", [DIRECT, ONE_CHANNEL], ids=["direct", "shared gain"])
def test_an_exact_path_costs_little(settings: dict[str, Any]) -> None:
    """With the default, on noise below a sixth of the sample rate: at most 0.5 dB."""
    from kfopc_filterpy.signals import band_limited_noise

    x = band_limited_noise((200.0, 1200.0), 5.0, fs=FS, rng=2) + 1e-3 * np.random.default_rng(3).standard_normal(
        int(5 * FS)
    )
    with_guard = reduction(settings, TRUE, x, rated_power=0.3)
    without = reduction(settings, TRUE, x, rated_power=0.3, secondary_path_uncertainty=None)
    loss = noise_reduction_db(without.error, without.disturbance) - noise_reduction_db(
        with_guard.error, with_guard.disturbance
    )
    assert -0.1 < loss < 0.5
