"""What the ratings of one or several loudspeakers allow their control signals, as arrays over the loudspeakers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias, TypeGuard, cast

import numpy as np

from kfopc_filterpy import HardClipAmplifier, LinearAmplifier
from kfopc_filterpy.power import AmplifierRating, LoudspeakerRating, OutputLimits, output_limits

from .._types import NumberOrArray
from ..power.ratings import Rating

Ratings: TypeAlias = Rating | Sequence[Rating | Sequence[Rating]]  # of one loudspeaker, or of each


@dataclass(frozen=True)
class Limits:
    """What ratings allow the control signals; with one channel its attributes are numbers, else one for each loudspeaker.

    Attributes
    ----------
    each : tuple of OutputLimits
        Limits of each loudspeaker.
    several : bool
        Whether there are several channels, be it only of references or of microphones.
    """

    each: tuple[OutputLimits, ...]
    several: bool

    def own(self, values: Iterable[Any]) -> Any:
        """Return the only value, or with several channels a tuple of those of each loudspeaker."""
        return tuple(values) if self.several else next(iter(values))

    @property
    def rated_power(self) -> NumberOrArray:
        """Rated power, or that of each loudspeaker, (J,)."""
        return np.array(self.own(one.rated_power for one in self.each))[()]

    @property
    def amplitude_limit(self) -> Any:
        """Largest magnitude of the control signal; None if there is no limit."""
        return self.own(one.amplitude_limit for one in self.each)

    @property
    def has_peaks(self) -> bool:
        """Whether a peak of any loudspeaker is limited."""
        return any(one.amplitude_limit is not None for one in self.each)

    @property
    def window_s(self) -> float:
        """Time in seconds over which the mean squares count."""
        return min(one.window_s for one in self.each)

    @property
    def decided_by(self) -> Any:
        """Which rating the rated power comes from."""
        return self.own(one.decided_by for one in self.each)

    def limiter(self, fs: float) -> Any:
        """Return a limiter at a sample rate `fs` in Hz."""
        return self.own(one.limiter(fs) for one in self.each)

    def amplifier(self) -> Any:
        """Return an amplifier that clips at the limit."""
        peaks = (one.amplitude_limit for one in self.each)
        return self.own(LinearAmplifier() if peak is None else HardClipAmplifier(peak) for peak in peaks)

    def without_peaks(self) -> Limits:
        """Return limits with the same rated powers, and none of the peaks."""
        return replace(self, each=tuple(replace(one, amplitude_limit=None) for one in self.each))

    def scaled(self, share: float) -> Limits:
        """Return limits with `share` times the rated powers, and peaks in proportion."""
        root = float(np.sqrt(share))
        peaks = [one.amplitude_limit and root * one.amplitude_limit for one in self.each]
        powers = [share * one.rated_power for one in self.each]
        each = zip(self.each, powers, peaks, strict=True)
        return replace(
            self, each=tuple(replace(one, rated_power=power, amplitude_limit=peak) for one, power, peak in each)
        )


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
    """Return what ratings allow; the shortest window counts for all loudspeakers."""
    each = [output_limits(list(one)) for one in ratings]
    window = min(one.window_s for one in each)
    return Limits(tuple(replace(one, window_s=window) for one in each), several)


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
