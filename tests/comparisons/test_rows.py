"""The worst of several cases."""

from __future__ import annotations

import numpy as np
import pytest

from comparisons.studies.rows import worst


@pytest.mark.parametrize("lost", [3.0, np.inf, np.nan])
def test_the_worst_is_found_wherever_it_stands(lost: float) -> None:
    losses = {"a": 2.0, "b": -1.0}
    for cases in ({"lost": lost} | losses, losses | {"lost": lost}):
        where, loss = worst(cases)
        assert where == "lost"
        np.testing.assert_equal(loss, lost)
