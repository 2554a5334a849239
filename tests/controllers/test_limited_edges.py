"""Where a limiter behind a user's own controller was once led astray."""

from __future__ import annotations

import copy
import math
import pickle
from typing import Any

import numpy as np
import pytest

from kfopc_filterpy import LimitedController, OutputLimiter, simulate


class Loud:
    """Has special methods of its own, which are not the limited controller's."""

    def control_signal(self, reference: float) -> float:
        return 10.0 * reference

    def update(self, error: float) -> None:
        pass

    def __deepcopy__(self, memo: Any) -> Loud:
        return Loud()

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)


class Diverging(Loud):
    def control_signal(self, reference: float) -> float:
        return math.nan


def limited(controller: Any, **options: float) -> LimitedController:
    return LimitedController(controller, OutputLimiter(1.0, amplitude_limit=2.0, **options))


@pytest.mark.parametrize(
    "copied",
    [copy.copy, copy.deepcopy, lambda made: pickle.loads(pickle.dumps(made))],
    ids=["copy", "deepcopy", "pickle"],
)
def test_a_copy_is_limited_too(copied: Any) -> None:
    other = copied(limited(Loud()))
    assert isinstance(other, LimitedController)
    assert other.control_signal(1.0) == 2.0


def test_a_limiter_of_another_rate_is_refused() -> None:
    ones = np.ones(10)
    with pytest.raises(ValueError, match="limiter is for 16000 Hz"):
        simulate(limited(Loud(), fs=16000.0), ones, disturbance=ones, secondary_path=[1.0], fs=48000.0)


def test_nan_is_a_divergence_as_without_the_limiter() -> None:
    ones = np.ones(10)
    for controller in (Diverging(), limited(Diverging())):
        assert simulate(controller, ones, disturbance=ones, secondary_path=[1.0]).diverged_at_s == 0.0


def test_listening_needs_a_controller_that_listens() -> None:
    ones = np.ones(100)
    with pytest.raises(ValueError, match="listen"):
        simulate(limited(Loud()), ones, disturbance=ones, secondary_path=[1.0], switch_on_s=0.001)
