"""KF-ANC and KF-OPC with several channels: what a silent microphone tells, and what they refuse."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from helpers.channels import random_paths

from kfopc_filterpy import OutputPowerConstraint, kf_anc, kf_opc, simulate_scenarios

K, J, I, L = 3, 2, 2, 5  # microphones, loudspeakers, references, taps  # noqa: E741
ESTIMATE = 0.9 * random_paths(K, J, 6, seed=1)[:, :, :4]
NOISE = np.array([0.01, 0.1, 0.03])
SETTINGS: dict[str, Any] = {"state_noise": 1e-5, "measurement_noise": NOISE, "n_references": I}
ONE_PATH = np.array([0.0, 0.7, -0.25, 0.1])


MAKE: dict[str, Callable[..., Any]] = {
    "KF-ANC": lambda path=ESTIMATE, **o: kf_anc(L, path, **(SETTINGS | o)),
    "KF-OPC": lambda path=ESTIMATE, **o: kf_opc(
        L, path, constraint=[OutputPowerConstraint(0.02), OutputPowerConstraint(0.05)], **(SETTINGS | o)
    ),
}


def test_a_microphone_that_is_not_reached_tells_nothing_without_measurement_noise() -> None:
    """Sound reaches microphone 2 later than the others: until then S is zero, and the weights are those without it."""
    paths = ESTIMATE.copy()
    paths[2] = np.roll(ESTIMATE[2], 2, axis=-1) * [0.0, 0.0, 0.0, 1.0]
    settings = {"initial_variance": 100.0, "state_noise": 1e-3}
    three = MAKE["KF-ANC"](paths, measurement_noise=[0.01, 0.01, 0.0], **settings)
    two = MAKE["KF-ANC"](paths[:2], measurement_noise=0.01, **settings)
    for n, x in enumerate(np.random.default_rng(3).standard_normal((40, I))):
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
        (lambda: simulate_scenarios([MAKE["KF-ANC"]()], np.ones(9), primary_path=ONE_PATH, secondary_path=ONE_PATH), (TypeError, ValueError), "channel"),
    ],
    ids=range(5),
)  # fmt: skip
def test_settings_that_do_not_fit_are_refused(make: Callable[[], Any], error: Any, message: str) -> None:
    with pytest.raises(error, match=message):
        make()
