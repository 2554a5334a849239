"""What the ratings of one or several loudspeakers allow their control signals, as arrays over the loudspeakers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias, TypeGuard, cast

import numpy as np

from kfopc_filterpy import HardClipAmplifier, LinearAmplifier, SimulationResult
from kfopc_filterpy.power import AmplifierRating, LoudspeakerRating, OutputLimits, output_limits

from .._types import NumberOrArray
from ..power.amplifiers import Amplifier
from ..power.ratings import Rating
from .fixed_filters import FixedFilters

EXCURSION = "loudspeaker's excursion"
SWEEPS = 3  # over the loudspeakers: what one gives up, others may take over

Ratings: TypeAlias = Rating | Sequence[Rating | Sequence[Rating]]  # of one loudspeaker, or of each


@dataclass(frozen=True)
class ChannelLimits:
    """What ratings allow the control signals of several loudspeakers; the shortest window counts for all.

    Attributes
    ----------
    each : tuple of OutputLimits
        Limits of each loudspeaker.
    """

    each: tuple[OutputLimits, ...]

    @property
    def rated_power(self) -> np.ndarray:
        """Rated power of each loudspeaker, (J,)."""
        return np.array([one.rated_power for one in self.each])

    @property
    def amplitude_limit(self) -> tuple[float | None, ...]:
        """Largest magnitude of each control signal; None if there is no limit."""
        return tuple(one.amplitude_limit for one in self.each)

    @property
    def window_s(self) -> float:
        """Time in seconds over which the mean squares count."""
        return min(one.window_s for one in self.each)

    @property
    def decided_by(self) -> tuple[str, ...]:
        """Which rating each rated power comes from."""
        return tuple(one.decided_by for one in self.each)

    def limiter(self, fs: float) -> tuple[Any, ...]:
        """Return a limiter for each loudspeaker at a sample rate `fs` in Hz."""
        return tuple(one.limiter(fs) for one in self.each)


Limits = OutputLimits | ChannelLimits


def ratings_of_each(rating: Ratings, n_loudspeakers: int) -> list[list[Rating]]:
    """Return the ratings of each loudspeaker, which hold together.

    One rating counts for all loudspeakers. A sequence has an entry for each of several loudspeakers: a rating, or a
    sequence of ratings. For one loudspeaker, its ratings may also stand in the sequence themselves.

    Raises
    ------
    ValueError
        A sequence of another length, or one that mixes ratings of amplifiers and of loudspeakers: which of them holds
        for which loudspeaker is not clear.
    """
    if not _is_sequence(rating):
        return [[cast(Rating, rating)]] * n_loudspeakers
    entries = list(rating)
    if n_loudspeakers == 1 and not any(_is_sequence(one) for one in entries):
        return [entries]
    kinds = {kind for one in entries for kind in (AmplifierRating, LoudspeakerRating) if isinstance(one, kind)}
    if len(entries) != n_loudspeakers or len(kinds) > 1:
        raise ValueError(
            f"rating must be one for all of the {n_loudspeakers} loudspeakers, or a sequence with an entry for each, got "
            f"{len(entries)} ratings{' of amplifiers and of loudspeakers' if len(kinds) > 1 else ''}; an amplifier and a "
            f"loudspeaker that belong together are one entry: [[amplifier, loudspeaker]] * {n_loudspeakers}"
        )
    return [list(one) if _is_sequence(one) else [cast(Rating, one)] for one in entries]


def _is_sequence(value: object) -> TypeGuard[Sequence[Any]]:
    return isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim > 0)


def limits_of(ratings: Sequence[Sequence[Rating]], several: bool) -> Limits:
    """Return what ratings allow: `OutputLimits` with one channel, `ChannelLimits` with several."""
    each = tuple(output_limits(list(one)) for one in ratings)
    if not several:
        return each[0]
    window = min(one.window_s for one in each)
    return ChannelLimits(tuple(replace(one, window_s=window) for one in each))


def each_of(limits: Limits) -> tuple[OutputLimits, ...]:
    """Return the limits of each loudspeaker."""
    return limits.each if isinstance(limits, ChannelLimits) else (limits,)


def _like(limits: Limits, each: Sequence[OutputLimits]) -> Limits:
    return ChannelLimits(tuple(each)) if isinstance(limits, ChannelLimits) else each[0]


def scaled(limits: Limits, share: float) -> Limits:
    """Return limits with `share` times the rated powers, and peaks in proportion."""
    root, each = float(np.sqrt(share)), each_of(limits)
    peaks = [one.amplitude_limit and root * one.amplitude_limit for one in each]
    powers = [share * one.rated_power for one in each]
    pairs = zip(each, powers, peaks, strict=True)
    return _like(limits, [replace(one, rated_power=power, amplitude_limit=peak) for one, power, peak in pairs])


def amplifiers(limits: Limits) -> Amplifier | Sequence[Amplifier]:
    """Return the amplifier that clips at the limit, or a list with one for each loudspeaker."""
    peaks = (one.amplitude_limit for one in each_of(limits))
    each = [LinearAmplifier() if peak is None else HardClipAmplifier(peak) for peak in peaks]
    return each if isinstance(limits, ChannelLimits) else each[0]


def with_excursion(limits: Limits, ratings: Sequence[Sequence[Rating]], bounds: FixedFilters) -> Limits:
    """Return limits with the largest rated powers at which the best filters keep the excursion of every loudspeaker."""
    moving = _moving(ratings)
    for _ in range(1 if len(ratings) == 1 else SWEEPS):
        before = limits
        for j, one in moving:
            limits = _keeping(limits, j, one, bounds)
        if limits is before:
            break
    return limits


def _keeping(limits: Limits, j: int, rating: LoudspeakerRating, bounds: FixedFilters) -> Limits:
    """Return limits with which the best filter keeps the excursion of loudspeaker j, the others' as they are."""
    from scipy.optimize import brentq

    each = each_of(limits)

    def excess(log_power: float) -> float:
        tried = [*each[:j], replace(each[j], rated_power=float(np.exp(log_power))), *each[j + 1 :]]
        weights = bounds.limited(_like(limits, tried).rated_power)[0]
        y = np.atleast_2d(bounds.stretch.control_signal(weights))[j]
        return float(np.log(np.mean(y**2) / rating.excursion_rated_power(y, bounds.fs)))

    high = np.log(each[j].rated_power)
    if excess(high) <= 1e-3 * (each[j].decided_by == EXCURSION):
        return limits
    low = high - 1.0
    while excess(low) > 0:
        low -= 2.0
    kept = replace(each[j], rated_power=float(np.exp(brentq(excess, low, high, xtol=1e-4))), decided_by=EXCURSION)
    return _like(limits, [*each[:j], kept, *each[j + 1 :]])


def excursion_mm(ratings: Sequence[Sequence[Rating]], run: SimulationResult) -> float | None:
    """Return the largest excursion of a run, of any loudspeaker whose rating knows it."""
    played = np.atleast_2d(np.nan_to_num(run.amplifier_output))
    moved = [float(np.abs(one.displacement_mm(played[j], run.fs)).max()) for j, one in _moving(ratings)]
    return max(moved, default=None)


def _moving(ratings: Sequence[Sequence[Rating]]) -> list[tuple[int, LoudspeakerRating]]:
    """Return the numbers of the loudspeakers whose largest excursion is known, with the ratings that state it."""
    loudspeakers = [(j, one) for j, own in enumerate(ratings) for one in own if isinstance(one, LoudspeakerRating)]
    return [(j, one) for j, one in loudspeakers if one.x_max_mm is not None]


def watt_per_power(ratings: Sequence[Sequence[Rating]], several: bool) -> NumberOrArray | None:
    """Return the watts of a mean square of 1, of several loudspeakers as (J,); None if a rating does not tell them."""
    volts, ohm = (scale_of(ratings, name, several) for name in ("volts_per_unit", "ohm"))
    return None if volts is None or ohm is None else volts**2 / ohm


def scale_of(ratings: Sequence[Sequence[Rating]], name: str, several: bool) -> NumberOrArray | None:
    """Return `volts_per_unit` or `ohm` of the first rating that has volts; of several loudspeakers as (J,).

    None if a loudspeaker has no such rating, or a curve instead of a number.
    """
    with_volts = ([one for one in own if hasattr(one, "volts_per_unit")] for own in ratings)
    found: list[Any] = [getattr(own[0], name) if own else None for own in with_volts]
    if not several:
        return found[0]
    return np.array(found, dtype=float) if all(np.ndim(one) == 0 and one is not None for one in found) else None
