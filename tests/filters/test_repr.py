"""What a filter says of itself: filterpy's matrices for a few states, a summary for many."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from kfopc_filterpy import KFOPC, OutputPowerConstraint

NOISES: dict[str, Any] = {"state_noise": 1e-6, "measurement_noise": 0.1}


@pytest.mark.parametrize("column", [True, False])
def test_the_random_walk_filter(column: bool) -> None:
    kf = KFOPC.random_walk(
        128, constraint=OutputPowerConstraint(1.5, secondary_path_gain=1.0, fs=8000, memory_s=0.2), **NOISES
    )
    kf.x = np.zeros((128, 1)[: 1 + column])
    kf.x[0], kf.x[1] = 3.0, 4.0
    kf.constraint_factor = 0.70711
    assert repr(kf) == (
        "<RandomWalkKFOPC: dim_x 128, dim_z 1, state noise 1e-06, measurement noise 0.1, rated power 1.5, "
        "fs 8000 Hz, memory 0.2 s, constraint factor 0.707, norm of x 5>"
    )
    kf.Q = np.diag(np.arange(128.0))
    kf.rated_power = None
    assert repr(kf) == (
        "<RandomWalkKFOPC: dim_x 128, dim_z 1, full Q, measurement noise 0.1, constraint factor 1, norm of x 5>"
    )


@pytest.mark.parametrize("make", [KFOPC, lambda n: KFOPC.random_walk(n, **NOISES)])
def test_up_to_eight_states_all_is_shown(make: Any) -> None:
    text = repr(make(8))
    assert text.startswith(f"{type(make(8)).__name__} object\ndim_x = 8\n")
    assert "\nP = [[" in text
    assert repr(make(9)).startswith(f"<{type(make(9)).__name__}: dim_x 9, ")
