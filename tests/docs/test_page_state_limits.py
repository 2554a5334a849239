"""What the tutorial on limits of the state says of its figures."""

from __future__ import annotations

import numpy as np
from helpers.pages import Page


def test_the_figures_say_what_the_page_says():
    page = Page("state_limits")

    v = page.run(until="Which limits")
    rms = {name: np.sqrt(np.mean((estimate - v.truth) ** 2)) for name, estimate in v.estimates.items()}
    assert rms["total and not below 0"] < rms["total"] < rms["no limits"]
    assert v.estimates["no limits"].min() < -0.5
    for name in ("total and not below 0", "the same, projected"):
        np.testing.assert_allclose(v.estimates[name].sum(axis=1), 10.0, rtol=1e-9)
        assert v.estimates[name].min() > -1e-9
    empty = v.truth[:, 0] == 0.0
    assert 20 < empty.sum() < 150
    off = {name: np.mean(estimate[empty, 0]) for name, estimate in v.estimates.items()}
    assert off["the same, projected"] > off["total and not below 0"] + 0.01 > abs(off["total"]) + 0.05

    v = page.run()
    np.testing.assert_allclose(v.limited @ v.M @ v.limited, 0.5 * v.free, rtol=1e-9)
    assert v.cost["nearest"] < 0.7 * v.cost["all weights scaled"]
