"""Rows of the multichannel study, and its claims about KF-PB."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ..bench import Claim, Tuned, algorithms
from .multichannel_rooms import RECORDINGS
from .rows import Row, loss_claim, select, worst

BOUND, SCALED, FREE = "bound", "scaled Wiener", "no limit"
KF_PB = "KF-PB"
QUARTER, EQUAL = "a quarter each", "one equal rating"


@dataclass(frozen=True, kw_only=True)
class ChannelRow(Row):
    """One algorithm in one place; each power is that of a loudspeaker over its rated power, `power` the largest."""

    rating: str = QUARTER
    powers: list[float]
    limited: list[bool] = field(default_factory=list)  # of the bound: whether the rating limits the loudspeaker

    @property
    def key(self) -> tuple[str, str, str]:
        """Place, noise and rating."""
        return self.path, self.noise, self.rating

    @property
    def within_ratings(self) -> bool:
        """Whether every loudspeaker kept its rating."""
        return self.power <= Tuned.BUDGET


def claims(rows: Sequence[ChannelRow]) -> list[Claim]:
    """Return the aims of KF-PB, and whether they are met."""
    bound = {row.key: row for row in select(rows, algorithm=BOUND)}
    pairs = [(row, bound[row.key]) for row in select(rows, algorithm=KF_PB)]
    steady, recorded = ([pair for pair in pairs if (pair[0].noise in RECORDINGS) is own] for own in (False, True))

    def losses(pairs: Sequence[tuple[ChannelRow, ChannelRow]]) -> dict[str, float]:
        return {", ".join(own.key): bound.noise_reduction_db - own.noise_reduction_db for own, bound in pairs}

    below = " below it"
    found = [
        _power_claim("Steady noise", "0.97 to 1.02", (0.97, 1.02), steady),
        loss_claim("On steady noise KF-PB reaches the bound to within 0.5 dB", 0.5, losses(steady), below),
    ]
    if recorded:
        text = "On recordings KF-PB reaches the bound of each second to within 1 dB"
        found += [
            _power_claim("Recordings", "at most 1.05", (0.0, 1.05), recorded),
            loss_claim(text, 1.0, losses(recorded), below),
        ]
    return [*found, _rivals_claim(rows)]


def _power_claim(
    what: str, aim: str, span: tuple[float, float], pairs: Sequence[tuple[ChannelRow, ChannelRow]]
) -> Claim:
    """Judge the powers, above all of loudspeakers that their rating limits."""
    powers = np.concatenate([own.powers for own, _ in pairs])
    binding = powers[np.concatenate([bound.limited for _, bound in pairs])]
    least, most = (np.min(binding), np.max(binding)) if binding.size else (np.nan, np.nan)
    return Claim(
        f"{what}: every loudspeaker's power is {aim} of its rating if that limits it, and never more",
        bool(least >= span[0] and np.max(powers) <= span[1]),
        f"{least:.3f} to {most:.3f} if the rating limits, {np.max(powers):.3f} at most of all",
    )


def _rivals_claim(rows: Sequence[ChannelRow]) -> Claim:
    """Judge KF-PB against the best other method that keeps the ratings, for each place and noise with one."""
    text = "No method of another kind that keeps every rating is more than 0.3 dB better"
    own = select(rows, algorithm=KF_PB, rating=QUARTER)
    behind = {}
    for row in own:
        found = rivals([other for other in rows if other.key == row.key])
        if found:
            behind[f"{row.case}: {found[0].algorithm}"] = found[0].noise_reduction_db - row.noise_reduction_db
    if not behind:
        return Claim(text, False, "no other method keeps the ratings anywhere: nothing to compare with")
    where, most = worst(behind)
    alone = f"; in {len(own) - len(behind)} of {len(own)} cases no other keeps them" if len(behind) < len(own) else ""
    return Claim(
        text,
        most <= 0.3,
        f"KF-PB is {-np.mean(list(behind.values())):+z.2f} dB ahead of the best other on average, "
        f"{-most:+z.2f} dB at worst ({where}), {-np.min(list(behind.values())):+z.2f} dB at best{alone}",
    )


def rivals(rows: Sequence[ChannelRow]) -> list[ChannelRow]:
    """Return the rows of algorithms with a constraint, without KF-PB's, that kept every rating; the best first."""
    registry = algorithms(several_channels=True)
    kept = [row for row in rows if row.algorithm in registry and row.algorithm != KF_PB and row.within_ratings]
    constrained = [row for row in kept if registry[row.algorithm].keeps_budget]
    return sorted(constrained, key=lambda row: -row.noise_reduction_db)
