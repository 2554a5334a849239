"""All weights as one state, for several channels: against filterpy's own filter of K measurements."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from helpers.channels import random_paths

from kfopc_filterpy import OutputPowerConstraint, kf_anc, kf_opc, simulate, simulate_scenarios

K, J, I, L = 3, 2, 2, 5  # microphones, loudspeakers, references, taps  # noqa: E741
FS = 16000.0
PATHS = random_paths(K, J, 6, seed=1)  # true secondary paths
ESTIMATE = 0.9 * PATHS[:, :, :4]  # what the controllers know of them
PRIMARY = random_paths(K, I, 9, seed=2, delay=3)
NOISE = np.array([0.01, 0.1, 0.03])
RATED, MEMORY = np.array([0.02, 0.05]), 60
SETTINGS: dict[str, Any] = {"state_noise": 1e-5, "measurement_noise": NOISE, "n_references": I}
ONE_PATH = np.array([0.0, 0.7, -0.25, 0.1])


def noise(n_samples: int = 400, n_references: int = I) -> np.ndarray:
    return np.random.default_rng(3).standard_normal((n_references, n_samples))


def constraints() -> list[OutputPowerConstraint]:
    """The rated powers, the powers with a memory of `MEMORY` samples."""
    return [OutputPowerConstraint(power, fs=FS, memory_s=MEMORY / FS) for power in RATED]


MAKE: dict[str, Callable[..., Any]] = {
    "KF-ANC": lambda path=ESTIMATE, **o: kf_anc(L, path, **(SETTINGS | o)),
    "KF-OPC": lambda path=ESTIMATE, **o: kf_opc(L, path, constraint=constraints(), **(SETTINGS | o)),
}


def run(controller: Any, x: np.ndarray, **options: Any) -> Any:
    return simulate(controller, x, **({"primary_path": PRIMARY, "secondary_path": PATHS, "fs": FS} | options))


# ---- The estimate


# ---- One definition of the step


# ---- Odd systems


@pytest.mark.parametrize("name", MAKE)
@pytest.mark.parametrize("dead", ["loudspeaker", "microphone"])
def test_what_is_unplugged_stays_silent_and_finite(name: str, dead: str) -> None:
    paths = PATHS.copy()
    paths[(slice(None), 1) if dead == "loudspeaker" else 1] = 0.0
    controller = MAKE[name](paths)
    result = run(controller, noise(2000), secondary_path=paths)
    assert np.isfinite(result.error).all()
    assert np.isfinite(controller.weights).all()
    if dead == "loudspeaker":
        np.testing.assert_allclose(result.control_signal[1], 0.0, atol=1e-9)
        np.testing.assert_array_equal(controller.weights[1], 0.0)
    assert np.any(result.control_signal[0])


# ---- Refusals


def test_a_microphone_that_is_not_reached_tells_nothing_without_measurement_noise() -> None:
    """Sound reaches microphone 2 later than the others: until then S is zero, and the weights are those without it."""
    paths = ESTIMATE.copy()
    paths[2] = np.roll(ESTIMATE[2], 2, axis=-1) * [0.0, 0.0, 0.0, 1.0]
    settings = {"initial_variance": 100.0, "state_noise": 1e-3}
    three = MAKE["KF-ANC"](paths, measurement_noise=[0.01, 0.01, 0.0], **settings)
    two = MAKE["KF-ANC"](paths[:2], measurement_noise=0.01, **settings)
    for n, x in enumerate(noise(40).T):
        np.testing.assert_array_equal(three.control_signal(x), two.control_signal(x)) if n < 4 else None
        three.update([1.0, 2.0, 3.0])
        two.update([1.0, 2.0])
        assert np.array_equal(three.weights, two.weights) == (n < 3), n
    assert np.any(three.weights)
    assert np.all(np.isfinite(three.weights))


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: MAKE["KF-ANC"](measurement_noise=[0.1, 0.1]), ValueError, r"each of the 3 microphones, \(3,\), got shape \(2,\)"),
        (lambda: MAKE["KF-ANC"](measurement_noise=-0.1), ValueError, "measurement_noise must not be negative"),
        (lambda: MAKE["KF-ANC"](initial_variance=np.nan), ValueError, "initial_variance must be finite"),
        (lambda: MAKE["KF-OPC"](ESTIMATE[:, :1]), ValueError, "one for each of the 1 loudspeakers, got 2"),
        (lambda: simulate_scenarios([MAKE["KF-ANC"]()], noise(9)[0], primary_path=ONE_PATH, secondary_path=ONE_PATH), (TypeError, ValueError), "channel"),
    ],
    ids=range(5),
)  # fmt: skip
def test_settings_that_do_not_fit_are_refused(make: Callable[[], Any], error: Any, message: str) -> None:
    with pytest.raises(error, match=message):
        make()
