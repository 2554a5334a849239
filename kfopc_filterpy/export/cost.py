"""What a sample of an exported controller costs, in words and numbers."""

from __future__ import annotations

from ..core.block import Block

KALMAN = ("kalman", "repaired")


def operations(block: Block) -> str:
    """Return how many multiplications a sample takes, for the README of an export."""
    s, algorithm = block.shape, block.algorithm.name
    K, J, M, G = s.microphones, s.loudspeakers, s.path_taps, s.guard_taps
    n, observed = (
        J * s.references * s.taps,
        K * (2 if G else 1),
    )  # weights; rows of x', or of x' and x'', that a sample learns from
    signals = n + K * J * M * (s.references + 1) + K * J * s.references * G
    if algorithm == "power_budget":
        return f"{signals:,} multiplications and as many additions, and the work of each block"
    if algorithm in KALMAN:
        learning = observed * (3 * n * n // 2 + 8 * n)
    else:
        of_each = {"diagonal": 8, "fast_array": 14, "finite_memory": 28}
        learning = observed * n * of_each.get(algorithm, 2 if G else 1)
    return f"{signals + learning:,} multiplications and as many additions"


def worst(block: Block) -> str:
    """Return which samples take longest, for the README of an export."""
    windows, algorithm = block.shape.limiter_windows, block.algorithm.name
    parts = ["one that moves the samples of the delay lines"]
    if windows:
        parts.append(f"every {max(windows):,}th, in which the limiter adds up its window")
    if algorithm in KALMAN:
        parts.append(
            "one whose innovation variance exceeds 1000 times the measurement noise, mostly soon after the start, which "
            "updates P in twice the precision"
        )
    if algorithm == "power_budget":
        parts.append("by far the last one of a block, which does the work of the whole block")
    return "; ".join(parts) + "."
