"""The plant: everything between a controller's output and the error microphones, and between the noise and both."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass
from typing import Any, Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from ._taps import feedback_paths, lengthened, primary_paths, sampling_rate, secondary_paths
from ._types import PathModels
from ._validate import as_channels, as_count, as_nonnegative, as_positive, same_rate
from .power.amplifiers import Amplifiers, amplifier_of_each
from .signals.recordings import Recording

NEVER = 2**63 - 1
READERS: dict[str, Callable[..., tuple[np.ndarray, float | None]]] = {
    "secondary": secondary_paths,
    "primary": primary_paths,
    "feedback": feedback_paths,
}
PATHS = tuple(READERS)


class Plant:
    """The paths, the amplifiers and the sample rate of an active noise control system, checked once.

    .. code-block:: text

        reference x ──────────────── primary path p ─────────────── d
             │                                                      │ +
             └─ controller ─ y ─ amplifier ─ secondary path s ──── (-)── error e
                                     └─ feedback path, back to x

    With several channels there are I references, J loudspeakers and K error microphones.

    Parameters
    ----------
    secondary : array_like, shape (n_taps,) or (K, J, n_taps), control system, Recording, or nested lists of them
        Secondary path s, from the amplifier of loudspeaker j to microphone k: taps, or a system of python-control.
    primary : likewise, shape (n_taps,), (K, n_taps) or (K, I, n_taps), optional
        Primary path p, from reference i to microphone k. Without it, functions that need the disturbance are given it.
    feedback : likewise, shape (n_taps,) or (I, J, n_taps), optional
        Acoustic feedback from the amplifiers to the reference microphones; its first tap must be 0. By default none.
    amplifier : callable or sequence of J of them, optional
        Amplifier model, or any function of a sample that returns a finite number; one for all loudspeakers, or one for
        each. By default linear.
    fs : float, optional
        Sample rate in Hz. Systems and recordings bring theirs; taps have none, so it must be given if all paths are
        taps.
    n_path : int, optional
        Taps to which the response of a system is computed if it is infinite; required then.
    sensor_noise_std : float, default 0
        Standard deviation of white noise at each error microphone.

    Attributes
    ----------
    secondary : ndarray, shape (K, J, n_taps)
        Secondary paths, read-only; always with the axes of the channels.
    primary : ndarray, shape (K, I, n_taps), or None
        Primary paths, read-only.
    feedback : ndarray, shape (I, J, n_taps), or None
        Feedback paths, read-only.
    amplifiers : tuple of callable or None
        Amplifier of each loudspeaker; None is a linear one.
    fs : float
        Sample rate in Hz.
    sensor_noise_std : float
        As given.

    Raises
    ------
    ValueError
        Paths that are empty, not finite, without a finite response, or of shapes that do not fit one another; sample
        rates that differ, or no sample rate; a feedback path without delay.
    TypeError
        An amplifier that is not a function, or not one for each loudspeaker.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import HardClipAmplifier, Plant
    >>> plant = Plant([0.0, 1.0], np.eye(40)[30], amplifier=HardClipAmplifier(1.5), fs=16000)
    >>> plant
    <Plant at 16000 Hz: secondary path of 2 taps, primary path of 40 taps, HardClipAmplifier(limit=1.5)>
    >>> plant.disturbance(np.eye(50)[0]).nonzero()
    (array([30]),)

    A door opens after 3.5 s:

    >>> door = plant.changed_at(3.5, primary=0.5 * np.eye(30)[20], crossfade_s=0.1)
    """

    def __init__(
        self,
        secondary: PathModels,
        primary: PathModels | None = None,
        *,
        feedback: PathModels | None = None,
        amplifier: Amplifiers = None,
        fs: float | None = None,
        n_path: int | None = None,
        sensor_noise_std: float = 0.0,
    ) -> None:
        given = dict(zip(PATHS, (secondary, primary, feedback), strict=True))
        rate = None if fs is None else as_positive(fs, "fs", unit="Hz")
        self._n_path = None if n_path is None else as_count(n_path, "n_path")
        read: dict[str, Any] = dict.fromkeys(PATHS)
        told: dict[str, float] = {}
        for name, paths in given.items():
            if paths is not None or name == "secondary":
                taps, own = READERS[name](paths, fs=rate, n_taps=self._n_path, name=name)
                read[name] = taps.copy()  # it may be the user's own array
                read[name].flags.writeable = False
                if own is not None:
                    told[name] = own
        self.fs = _common_rate(told) if rate is None else rate
        self.sensor_noise_std = as_nonnegative(sensor_noise_std, "sensor_noise_std")
        self.secondary: np.ndarray = read["secondary"]
        self.primary: np.ndarray | None = read["primary"]
        self.feedback: np.ndarray | None = read["feedback"]
        self.amplifiers = tuple(amplifier_of_each(amplifier, self.n_loudspeakers))
        self._changes: tuple[_Change, ...] = ()
        self._require_fit()

    def _require_fit(self) -> None:
        """Raise ValueError unless the paths have the same microphones, loudspeakers and references."""
        counts = {name: np.shape(getattr(self, name)) for name in PATHS}
        K, J, _ = counts["secondary"]
        if self.primary is not None and counts["primary"][0] != K:
            raise ValueError(
                f"primary must be (K microphones, I references, taps) with the {K} microphones of secondary, got "
                f"{counts['primary']}"
            )
        if self.feedback is not None and counts["feedback"][:2] != (self.n_references or len(self.feedback), J):
            raise ValueError(
                f"feedback must be (I references, J loudspeakers, taps) with the {J} loudspeakers of secondary"
                + (f" and the {self.n_references} references of primary" if self.primary is not None else "")
                + f", got {counts['feedback']}"
            )

    @property
    def n_microphones(self) -> int:
        """Number of error microphones K."""
        return self.secondary.shape[0]

    @property
    def n_loudspeakers(self) -> int:
        """Number of loudspeakers J."""
        return self.secondary.shape[1]

    @property
    def n_references(self) -> int | None:
        """Number of references I; None if there is neither a primary nor a feedback path that tells it."""
        if self.primary is not None:
            return self.primary.shape[1]
        return None if self.feedback is None else len(self.feedback)

    @property
    def changes(self) -> bool:
        """Whether the plant changes, see `changed_at`."""
        return bool(self._changes)

    def changed_at(
        self,
        time_s: float,
        *,
        secondary: PathModels | None = None,
        primary: PathModels | None = None,
        feedback: PathModels | None = None,
        amplifier: Amplifiers = None,
        crossfade_s: float = 0.0,
    ) -> Self:
        """Return a plant that is like this one, and changes at a time of the run; chain it for several changes.

        The delay lines go on: sound that is on its way when a path changes arrives through the new one.

        Parameters
        ----------
        time_s : float
            Time of the change in seconds from the start of the reference: not before the last change, and after the
            last change of the same paths or amplifiers has ended.
        secondary, primary, feedback : as for `Plant`, optional
            New paths, with the same channels; by default they stay.
        amplifier : callable or sequence of J of them, optional
            New amplifier; by default it stays. `LinearAmplifier()` is a linear one.
        crossfade_s : float, default 0
            Time in seconds in which the taps go linearly from the old to the new paths. 0 switches at once; an
            amplifier is always switched.

        Returns
        -------
        Plant
            A new plant. `simulate` and `realtime.SimulatedInterface` follow its changes; bounds and verdicts take the
            plant of one time, see `at`.

        Raises
        ------
        ValueError
            Nothing that changes, a time that is too early, paths with other channels, or what `Plant` refuses.

        Examples
        --------
        >>> plant = Plant([0.0, 1.0], [0.0, 0.0, 1.0], fs=16000)
        >>> plant.changed_at(1.0, secondary=[0.0, -1.0]).changed_at(2.0, primary=[0.0, 1.0])
        <Plant at 16000 Hz: secondary path of 2 taps, primary path of 3 taps, changes at 1, 2 s>
        """
        at, fade = as_positive(time_s, "time_s", unit="s"), as_nonnegative(crossfade_s, "crossfade_s", unit="s")
        given = {"secondary": secondary, "primary": primary, "feedback": feedback, "amplifier": amplifier}
        changed = frozenset(name for name, value in given.items() if value is not None)
        if not changed:
            raise ValueError("give what changes: secondary=, primary=, feedback= or amplifier=")
        begin = round(at * self.fs)
        fading = [one.begin + one.fade for one in self._changes if one.changed & changed & set(PATHS)]
        same = [one.begin + 1 for one in self._changes if one.changed & changed]
        last = max((one.begin for one in self._changes), default=0)
        free = max([1, *fading, *same])
        if begin < last:
            raise ValueError(
                f"time_s must not be before the last change, at {last / self.fs:g} s, got {at:g} s: chain the changes in "
                "the order of their times"
            )
        if begin < free:
            reason = f": by then the last change of {' or '.join(sorted(changed))} has ended" if same else ""
            raise ValueError(f"time_s must be {free / self.fs:g} s at least, got {at:g} s{reason}")
        now = self._changes[-1].plant if self._changes else self
        if now.primary is None and primary is not None:
            raise ValueError("primary cannot appear during a run: make the plant with a primary path")
        paths = {name: getattr(now, name) for name in PATHS}
        for name, old in paths.items():
            if given[name] is None:
                continue
            paths[name], _ = READERS[name](given[name], fs=self.fs, n_taps=self._n_path, name=name)
            if old is not None and old.shape[:2] != paths[name].shape[:2]:
                raise ValueError(
                    f"{name} must keep its channels when it changes, {old.shape[:2]}, got taps {paths[name].shape}"
                )
        amplifiers = now.amplifiers if amplifier is None else amplifier
        then = Plant(
            **paths, amplifier=amplifiers, fs=self.fs, n_path=self._n_path, sensor_noise_std=self.sensor_noise_std
        )
        other = copy(self)
        other._changes = (*self._changes, _Change(at, begin, round(fade * self.fs), changed, then))
        return other

    def at(self, time_s: float) -> Plant:
        """Return the plant of one time, which does not change; during a cross-fade, the one that it leads to.

        Parameters
        ----------
        time_s : float
            Time in seconds from the start of the reference.

        Returns
        -------
        Plant
            The plant after the last change that began by then.

        Examples
        --------
        >>> Plant([1.0], fs=16000).changed_at(1.0, secondary=[-1.0]).at(5.0).secondary
        array([[[-1.]]])
        """
        at = as_nonnegative(time_s, "time_s", unit="s")
        begun = [change.plant for change in self._changes if change.at_s <= at]
        if begun:
            return begun[-1]
        plant = copy(self)
        plant._changes = ()
        return plant

    def disturbance(self, reference: ArrayLike) -> np.ndarray:
        """Return the disturbance d = p*x that a reference causes at the error microphones.

        Parameters
        ----------
        reference : array_like, shape (n_samples,) or (I, n_samples)
            Reference x; a `Recording` must have the plant's sample rate.

        Returns
        -------
        ndarray, shape (n_samples,) or (K, n_samples)
            Disturbance; it follows the changes of the primary path.

        Raises
        ------
        ValueError
            A plant without a primary path, or a reference with other channels or another sample rate.
        """
        x = checked_references(self, reference)
        d = _disturbances(self, x)
        return d[0] if has_one_channel(self, x) else d

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        for name in PATHS:  # in a copy, numpy makes arrays that can be written to
            if (taps := getattr(self, name)) is not None:
                taps.flags.writeable = False

    def __repr__(self) -> str:
        parts = []
        for name in PATHS:
            if (paths := getattr(self, name)) is not None:
                rows, columns, n_taps = paths.shape
                several = "" if rows * columns == 1 else f"s {rows} x {columns}"
                parts.append(f"{name} path{several} of {n_taps} tap{'s' if n_taps > 1 else ''}")
        parts += dict.fromkeys(str(one) for one in self.amplifiers if one is not None)
        if self.sensor_noise_std:
            parts.append(f"sensor noise {self.sensor_noise_std:g}")
        if self._changes:
            parts.append(f"changes at {', '.join(f'{change.at_s:g}' for change in self._changes)} s")
        return f"<Plant at {self.fs:g} Hz: {', '.join(parts)}>"


@dataclass(frozen=True)
class _Change:
    """A change of a plant: when, over how many samples, what, and the plant after it."""

    at_s: float
    begin: int
    fade: int
    changed: frozenset[str]
    plant: Plant


@dataclass(frozen=True)
class Schedule:
    """Values, the samples at which they begin to replace the one before, and how many samples later they have done so.

    Values with a fade are arrays of one shape.
    """

    begins: list[int]
    fades: list[int]
    values: list[Any]

    def at(self, n: int) -> tuple[Any, int]:
        """Return the value at sample n, and the first sample after it that may have another one."""
        i = bisect_right(self.begins, n) - 1
        done = n - self.begins[i]
        if done < self.fades[i]:
            share = done / self.fades[i]
            return (1.0 - share) * self.values[i - 1] + share * self.values[i], n + 1
        return self.values[i], self.begins[i + 1] if i + 1 < len(self.begins) else NEVER

    def values_in(self, begin: int, n_samples: int) -> Iterator[tuple[Any, slice]]:
        """Yield each value of the samples from `begin` on, and its samples, counted from `begin`."""
        n = 0
        while n < n_samples:
            value, until = self.at(begin + n)
            yield value, slice(n, min(until - begin, n_samples))
            n = until - begin

    def parts(self, n_samples: int) -> Iterator[tuple[Any, slice, np.ndarray]]:
        """Yield each value, the samples in which it has a share of the whole, and its share in each of them."""
        for i, (value, begin) in enumerate(zip(self.values, self.begins, strict=True)):
            following = self.begins[i + 1] + self.fades[i + 1] if i + 1 < len(self.begins) else n_samples
            n = np.arange(begin, min(following, n_samples))
            if n.size:
                yield value, slice(begin, begin + n.size), self._risen(i, n) - self._risen(i + 1, n)

    def _risen(self, i: int, n: np.ndarray) -> np.ndarray:
        """Return the share, 0 to 1, by which value i and those after it have replaced those before it."""
        if i in (0, len(self.begins)):
            return np.full(n.size, float(i == 0))
        return np.clip((n - self.begins[i] + (self.fades[i] == 0)) / max(self.fades[i], 1), 0.0, 1.0)


def as_plant(plant: Any) -> Plant:
    """Return a plant, or raise TypeError if it is none."""
    if not isinstance(plant, Plant):
        raise TypeError(
            f"plant must be a Plant, got {type(plant).__name__}: Plant(secondary, primary, fs=...) makes one"
        )
    return plant


def as_constant_plant(plant: Any, what: str) -> Plant:
    """Return a plant that does not change, or raise TypeError or ValueError; `what` is the name of what needs it."""
    if as_plant(plant).changes:
        raise ValueError(f"{what} needs a plant that does not change: give the one of a time, plant.at(time_s)")
    return plant


def has_one_channel(plant: Plant, references: np.ndarray) -> bool:
    """Return whether a run with these references, (I, n_samples), has one channel, so its signals no channel axis."""
    return plant.secondary.shape[:2] == (1, 1) and len(references) <= 1


def checked_references(plant: Plant, reference: ArrayLike) -> np.ndarray:
    """Return `reference` as (I, n_samples), checked against the plant's channels and sample rate."""
    require_rate(reference, plant.fs, "reference")
    x = np.atleast_2d(as_channels(reference, "reference"))
    if plant.n_references not in (None, len(x)):
        raise ValueError(
            f"reference must have the {plant.n_references} channel(s) of the plant's paths, (I references, n_samples), "
            f"got {len(x)}"
        )
    return x


def checked_signals(
    plant: Plant, reference: ArrayLike | None, disturbance: ArrayLike | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return references (I, n_samples) and disturbances (K, n_samples).

    These are `reference` and `disturbance`; if only the former is given, the disturbance is p*x.
    """
    if reference is None and disturbance is None:
        raise ValueError("without a reference give disturbance=: a primary path would begin at the reference")
    if disturbance is None and plant.primary is None:
        raise ValueError("the disturbance is unknown: make the plant with a primary path, or give disturbance=")
    if disturbance is None:
        x = checked_references(plant, reference)  # type: ignore[arg-type]
        return x, _disturbances(plant, x)
    require_rate(disturbance, plant.fs, "disturbance")
    d = np.atleast_2d(as_channels(disturbance, "disturbance"))
    x = np.empty((0, d.shape[1])) if reference is None else checked_references(plant, reference)
    if d.shape != (plant.n_microphones, x.shape[1]):
        raise ValueError(
            f"disturbance must be (K microphones, n_samples) = {(plant.n_microphones, x.shape[1])}, got {d.shape}"
        )
    return x, d


def _disturbances(plant: Plant, x: np.ndarray) -> np.ndarray:
    """Return p*x, (K, n_samples); sound on its way at a change arrives through the new path."""
    if plant.primary is None:
        raise ValueError("the plant has no primary path: make it with one, Plant(secondary, primary)")
    n_samples = x.shape[1]
    d = np.zeros((plant.n_microphones, n_samples))
    for paths, part, share in schedule_of(plant, "primary").parts(n_samples):
        first = max(part.start - paths.shape[2] + 1, 0)
        heard = _convolved(x[:, first : part.stop], paths)
        d[:, part] += share * heard[:, part.start - first : part.stop - first]
    return d


def schedule_of(plant: Plant, name: str) -> Schedule:
    """Return the values of what is called `name` (secondary, primary, feedback or amplifier), and when each begins.

    All have as many taps as the longest, filled with zeros; before a feedback path appears, its taps are zeros.
    """
    attribute = "amplifiers" if name == "amplifier" else name
    own = [change for change in plant._changes if name in change.changed]
    values = [getattr(one, attribute) for one in (plant, *(change.plant for change in own))]
    if name in PATHS:
        shape = next((value.shape[:-1] for value in values if value is not None), None)
        values = [np.zeros((*shape, 1)) if value is None and shape else value for value in values]
        longest = max((value.shape[-1] for value in values if value is not None), default=0)
        values = [value if value is None else lengthened(value, longest) for value in values]
    fades = [0, *(0 if name == "amplifier" else change.fade for change in own)]
    return Schedule([0, *(change.begin for change in own)], fades, values)


# What a controller takes as the estimate of the secondary path: also that of a plant.
Secondary: TypeAlias = "PathModels | Plant"


def estimated_secondary(secondary: Any) -> tuple[np.ndarray, float | None]:
    """Return secondary paths, also a plant's, as taps (K, J, n_taps), and their sample rate in Hz if they tell it."""
    if isinstance(secondary, Plant):
        plant = as_constant_plant(secondary, "an estimate of the secondary path")
        return plant.secondary.copy(), plant.fs
    return secondary_paths(secondary)


def _common_rate(rates: dict[str, float]) -> float:
    """Return the sample rate in Hz of the paths that tell one, by their names.

    ValueError if none does, or they differ.
    """
    if not rates:
        raise ValueError("fs must be given, the sample rate in Hz: taps have none, unlike systems and recordings")
    first, fs = next(iter(rates.items()))
    for name, rate in rates.items():
        if not same_rate(rate, fs):
            raise ValueError(
                f"the {name} path is sampled at {rate:g} Hz but the {first} path at {fs:g} Hz; resample one "
                "(resample_path)"
            )
    return fs


def require_rate(signal: object, fs: float, name: str) -> None:
    """Raise ValueError if a signal is a recording of another sample rate."""
    if isinstance(signal, Recording):
        sampling_rate(signal, fs, name=name)


def _convolved(x: np.ndarray, paths: np.ndarray) -> np.ndarray:
    """Return references (I, n) through paths (K, I, taps), (K, n + taps - 1).

    One path is convolved directly, so that a pure delay returns the samples themselves.
    """
    if paths.shape[:2] == (1, 1):
        return np.convolve(x[0], paths[0, 0])[None]
    from scipy.signal import fftconvolve

    return np.array([fftconvolve(x, p, axes=-1).sum(axis=0) for p in paths])
