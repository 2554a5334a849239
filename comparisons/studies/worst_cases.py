"""Which of several cases is the worst: studies judge their algorithms by it, and name it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np


def worst(losses: Mapping[Any, float]) -> tuple[Any, float]:
    """Return the largest of the losses, and whose it is; NaN, of a run that diverged, counts as the largest."""
    where = list(losses)[int(np.argmax(list(losses.values())))]
    return where, losses[where]
