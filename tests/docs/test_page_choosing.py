"""What the tutorial on L, q, r and forgetting says of its figures."""

from __future__ import annotations

import numpy as np
from helpers.pages import Page


def test_the_figures_say_what_the_page_says():
    page = Page("choosing")

    v = page.run(until="L: the length of the control filter")
    assert list(v.suggested.settings) == ["state_noise", "measurement_noise", "initial_variance"]
    assert v.suggested.n_taps == 256
    assert "as long as max_taps allows" in v.suggested.reasons["n_taps"]
    assert "over 0.25 s" in v.suggested.reasons["state_noise"]
    best = {n: max(values) for n, values in v.grid.items()}
    assert best[256] == max(best.values()) < v.own + 0.5
    assert min(v.grid[256]) < v.own - 2  # a grid wide enough to lose on

    v = page.run(until="q: what no weights explain")
    reach = v.reach
    assert reach[0] < 3 < 6 < reach[1]
    assert reach[2] - reach[1] < 0.5  # the plateau
    assert reach[-1] > reach[5] + 10  # the climb
    assert np.all(np.diff(reach) > 0)
    assert all(best - 1.6 < own < best + 0.1 for best, own in zip(reach, v.attained, strict=True))

    v = page.run(until="r: how fast the filter forgets")
    assert v.steady_q[1e-3] < v.steady_q[1.0] - 2
    assert abs(v.steady_q[1e3] - v.steady_q[1.0]) < 0.5
    assert v.sensor**2 < 0.01 * v.q

    v = page.run(until="P(0|0): what is assumed before the first sample")
    steady, after = (np.array([v.recovery[n][k] for n in (400, 4000, 40000)]) for k in (0, 1))
    assert np.all(np.diff(after) > 3)
    assert steady[0] > steady[1] + 1.5
    assert abs(steady[1] - steady[2]) < 0.5

    start = page.run(until="Fading memory, and why r is better here").start
    assert start[1, 100][0] > 20
    assert all(start[late, factor][0] < 1 for late in (0, 1) for factor in (0.01, 1))
    assert start[0, 100][0] < 1
    assert start[0, 0.01][1] > start[0, 1][1] + 1

    largest = page.run(until="The memory of the power estimates (KF-OPC)").largest
    assert largest["alpha, filterpy's"][-1] > 100 * largest["alpha, filterpy's"][0]
    assert 2 < largest["alpha, N = 4000"][-1] / largest["alpha, N = 4000"][0] < 10
    assert largest["r, N = 4000"][-1] < 1.02 * largest["r, N = 4000"][0]

    over = page.run().over
    assert all(10 < highest < 15 for highest, _ in over.values())
    assert over[0.05][1] > 5 * over[0.5][1] > 5 * over[2.0][1]
