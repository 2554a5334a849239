"""The parts of the core that also work alone, called in C: what Python refuses before them is refused by them, too."""

from __future__ import annotations

import numpy as np
import pytest

from kfopc_filterpy import OutputLimiter
from kfopc_filterpy.core.calls import limit


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_limiter_in_c_answers_nan_to_what_is_not_finite_and_keeps_its_state(bad: float) -> None:
    limiter = OutputLimiter(0.1, fs=100.0, window_s=0.1)
    limiter.process(np.linspace(-2.0, 2.0, 25))
    before = [array.copy() for array in limiter.state]
    assert np.isnan(limit(limiter.state.numbers.ctypes.data, limiter.state.laps.ctypes.data, bad))
    for array, own in zip(limiter.state, before, strict=True):
        np.testing.assert_array_equal(array, own)
