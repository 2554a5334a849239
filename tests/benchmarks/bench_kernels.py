"""Regression benchmarks, apart from the tests: `python -m pytest tests/benchmarks/bench_*.py` (extra bench).

Compare with an earlier run of the same machine: `--benchmark-save=before`, then `--benchmark-compare`.
"""

from __future__ import annotations

import pytest

from comparisons.speed.variants import OURS


@pytest.mark.parametrize("taps", [64, 256, 512])
@pytest.mark.parametrize("variant", OURS)
def test_sample(benchmark, variant, taps):
    work, samples = OURS[variant](taps)
    benchmark.extra_info["samples"] = samples
    benchmark(work)
