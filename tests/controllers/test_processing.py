"""`process`: blocks of samples, for any controller, as a real-time process hands them over."""

from __future__ import annotations

import gc
import tracemalloc
from typing import Any

import numpy as np
import pytest
from helpers.channels import random_paths
from helpers.controllers import ALL, I, J, K
from helpers.loop import S_HAT
from helpers.simulation import X

from kfopc_filterpy import frequency_domain_fx_lms, fx_lms
from kfopc_filterpy.controllers import CoreController


def test_a_subclass_with_its_own_step_is_called_for_each_sample() -> None:
    class Halved(CoreController):
        def control_signal(self, reference: Any) -> Any:
            return 0.5 * super().control_signal(reference)

    steps = Halved("halved", "fxlms", 12, S_HAT, settings={"step_size": 1e-3})
    plain = fx_lms(12, S_HAT, step_size=1e-3)
    X_, E = X[:200], 0.5 * X[:200]
    got, whole = steps.process(X_, E), plain.process(X_, E)
    np.testing.assert_array_equal(got[:1], 0.5 * whole[:1])
    assert not np.array_equal(got, whole)
    assert np.any(got != 0.0)


@pytest.mark.parametrize("kind", [fx_lms, frequency_domain_fx_lms])
def test_the_only_reference_of_several_channels_needs_no_channel_axis(kind: Any) -> None:
    settings = {"step_size": 1e-2} | ({} if kind is fx_lms else {"block_size": 4})
    with_axis, without = (kind(8, random_paths(2, 2, 6, seed=1), **settings) for _ in range(2))
    x, e = X[:100], np.stack((X[100:200], X[200:300]))
    without.listen(x, e)
    with_axis.listen(x[np.newaxis], e)
    expected = with_axis.process(x[np.newaxis], e)
    assert np.any(expected)
    np.testing.assert_array_equal(without.process(x, e), expected)


@pytest.mark.parametrize("name", ["KF-OPC plain", "KF-PB limiter", "FxLMS many"])
def test_memory_is_not_allocated_after_the_first_block(name: str) -> None:
    """Beside small objects, such as the estimator's new x, nothing is allocated, and nothing stays."""
    controller, n = ALL[name](), 1000
    shapes = ((I, n), (K, n), (J, n)) if controller.multichannel else ((n,),) * 3
    x, e, y = map(np.random.default_rng(0).standard_normal, shapes)
    for _ in range(3):
        controller.process(x, e, out=y)
    gc.collect()
    tracemalloc.start()
    try:
        for _ in range(200):  # Python keeps some small objects for the next calls
            controller.process(x, e, out=y)
        before, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        for _ in range(20):
            controller.process(x, e, out=y)
        after, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert after - before < 5000  # in all 20 blocks, each of which has 8000 bytes in each signal
    assert peak - before < 8000  # less than one of the signals of the block
