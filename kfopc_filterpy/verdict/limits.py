"""What the ratings of one or several loudspeakers allow their control signals, as arrays over the loudspeakers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias, TypeGuard, cast

import numpy as np

from kfopc_filterpy import HardClipAmplifier, LinearAmplifier
from kfopc_filterpy.power import AmplifierRating, LoudspeakerRating, OutputLimits, output_limits

from .._types import NumberOrArray
from ..power.amplifiers import Amplifier
from ..power.ratings import Rating

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


def watt_per_power(volts_per_unit: NumberOrArray | None, ohm: NumberOrArray | None) -> NumberOrArray | None:
    """Return the watts of a mean square of 1, of several loudspeakers as (J,); None if they are not known."""
    return None if volts_per_unit is None or ohm is None else volts_per_unit**2 / ohm


def scale_of(ratings: Sequence[Sequence[Rating]], name: str, several: bool) -> NumberOrArray | None:
    """Return `volts_per_unit` or `ohm` of the first rating that has volts; of several loudspeakers as (J,).

    None if a loudspeaker has no such rating.
    """
    with_volts = ([one for one in own if hasattr(one, "volts_per_unit")] for own in ratings)
    found: list[Any] = [getattr(own[0], name) if own else None for own in with_volts]
    if not several:
        return found[0]
    return None if any(one is None for one in found) else np.array(found, dtype=float)
