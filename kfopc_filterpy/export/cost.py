"""What a sample of an exported controller costs, for the README of the export."""

from __future__ import annotations

import numpy as np

from ..core.block import Block
from ..core.run_loop import SOFT_SATURATION
from ..core.triangle import GROUP

OF_POWERS, OF_LIMITER, OF_SOFT_AMPLIFIER = 12, 43, 150  # multiplications for each loudspeaker
OF_CLICKS, OF_ACCOUNT = 3, 3  # of KF-PB, for each reference and for each loudspeaker
# Multiplications per weight, beyond those of y: of the diagonal filter for each row of x' that a sample learns from, or
# in all.
OF_DIAGONAL = 8
IN_ALL = {"leaky": 2, "optimal_leaky": 2, "mov": 2, "mov_fixed": 2}


def operations(block: Block) -> str:
    """Return how many multiplications a sample takes."""
    s, algorithm = block.shape, block.algorithm.name
    K, J, M, guarded = s.microphones, s.loudspeakers, s.path_taps, s.guard_taps > 0
    n = J * s.references * s.taps
    filtering = n + OF_LIMITER * len(s.limiter_windows)
    filtering += OF_SOFT_AMPLIFIER * int(np.count_nonzero(block.fields["amplifier"][..., 0] == SOFT_SATURATION))
    if algorithm == "power_budget":
        filtering += OF_CLICKS * s.references + OF_ACCOUNT * J
        return f"{filtering:,} multiplications and as many additions, and once in a block the work of the block"
    filtering += K * J * (M * (s.references + 1) + s.guard_taps * s.references) + J * OF_POWERS
    rows = K * (1 + guarded)
    if algorithm == "kalman":
        learning = rows * (3 * n * n // 2 + 12 * n)
        if block.fields["fading"].item() > 1:
            learning += n * (n + GROUP)  # `fade` in covariance.c
    elif algorithm == "diagonal":
        learning = rows * n * OF_DIAGONAL
    else:
        learning = n * (K * (3 if guarded else 1) + IN_ALL.get(algorithm, 0))
        if algorithm == "fxnlms":
            learning += rows * n + s.references * s.taps  # the energies of x' and of x
        if algorithm in ("mov", "mov_fixed") and block.fields["modified"].item():
            learning += K * n
    return f"{filtering + learning:,} multiplications and as many additions"


def worst(block: Block) -> str:
    """Return which samples take longest."""
    windows, algorithm = block.shape.limiter_windows, block.algorithm.name
    parts = ["one that moves the samples of the delay lines"]
    if windows:
        parts.append(f"every {max(windows):,}th, in which the limiter adds up its window")
    if algorithm == "power_budget":
        parts.append("by far the last one of a block, which does the work of the whole block")
    return "; ".join(parts) + "."
