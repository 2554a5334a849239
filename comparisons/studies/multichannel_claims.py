"""Rows of the multichannel study, and its claims about KF-PB."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from ..bench import Claim, Tuned, algorithms
from .multichannel_rooms import RECORDINGS
from .rows import Row, select, worst_claim

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
    found = []
    for kind, recorded, most, loss_db in (("steady noise", False, 1.02, 0.5), ("recordings", True, 1.05, 1.0)):
        own = [pair for pair in pairs if (pair[0].noise in RECORDINGS) is recorded]
        powers = {f"{', '.join(row.key)}, {j}": power for row, _ in own for j, power in enumerate(row.powers)}
        losses = {", ".join(row.key): best.noise_reduction_db - row.noise_reduction_db for row, best in own}
        binding = [f"{', '.join(row.key)}, {j}" for row, best in own for j, limits in enumerate(best.limited) if limits]
        text = f"Power of {{}} loudspeaker over its rated one, {kind}"
        if own:
            found.append(worst_claim(text.format("a"), powers, at_most=most))
            found.append(worst_claim(f"Noise reduction of KF-PB below the bound, {kind} (dB)", losses, at_most=loss_db))
        if own and not recorded:
            limited = {where: powers[where] for where in binding}
            found.append(worst_claim(text.format("a limited"), limited, at_least=0.97))
    behind = {}
    for row in select(rows, algorithm=KF_PB, rating=QUARTER):
        if others := rivals([other for other in rows if other.key == row.key]):
            behind[f"{row.case}: {others[0].algorithm}"] = others[0].noise_reduction_db - row.noise_reduction_db
    text = "Noise reduction of the best other method that keeps every rating less that of KF-PB (dB)"
    return [*found, worst_claim(text, behind, at_most=0.3)]


def rivals(rows: Sequence[ChannelRow]) -> list[ChannelRow]:
    """Return the rows of algorithms with a constraint, without KF-PB's, that kept every rating; the best first."""
    registry = algorithms(several_channels=True)
    kept = [row for row in rows if row.algorithm in registry and row.algorithm != KF_PB and row.within_ratings]
    constrained = [row for row in kept if registry[row.algorithm].keeps_budget]
    return sorted(constrained, key=lambda row: -row.noise_reduction_db)
