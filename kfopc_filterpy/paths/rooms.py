"""Paths in a rectangular room: image sources from pyroomacoustics, sampled without delay or ringing before time zero."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._validate import as_count, as_number, as_positive, as_real_array, optional_module, require_finite

WALLS = ("west", "east", "south", "north", "floor", "ceiling")
"""Names of the walls: at x = 0 and its maximum, at y = 0 and its maximum, at z = 0 and its maximum."""

# Samples on each side of an arrival. The response is then flat up to 0.4 fs, the band limit of `duct_paths`.
_HALF_WIDTH = 10
_IMAGES_AT_ONCE = 2**16  # bounds the memory of a response of many thousand taps


@dataclass(frozen=True, eq=False, repr=False)
class RoomPaths:
    """Paths from noise sources and loudspeakers to error microphones in a room; made by `room_paths`.

    Attributes
    ----------
    primary : numpy.ndarray, shape (K, I, n_taps)
        From each noise source, whose signal is the reference, to each error microphone.
    secondary : numpy.ndarray, shape (K, J, n_taps)
        From each loudspeaker to each error microphone.
    fs : float
        Sampling rate in Hz.
    size_m : numpy.ndarray, shape (3,)
        Length, width and height of the room in m.
    loudspeakers_m : numpy.ndarray, shape (J, 3)
        Positions x, y, z of the loudspeakers in m.
    sources_m : numpy.ndarray, shape (I, 3)
        Positions of the noise sources in m.
    microphones_m : numpy.ndarray, shape (K, 3)
        Positions of the error microphones in m.
    absorption : dict of str to float
        Energy absorption coefficient of each wall.
    reverberation_time_s : float
        Time in which the sound decays by 60 dB, by Sabine's formula; 0 in a free field.
    speed_of_sound : float
        Speed of sound in m/s.
    """

    primary: np.ndarray
    secondary: np.ndarray
    fs: float
    size_m: np.ndarray
    loudspeakers_m: np.ndarray
    sources_m: np.ndarray
    microphones_m: np.ndarray
    absorption: dict[str, float]
    reverberation_time_s: float
    speed_of_sound: float

    def __repr__(self) -> str:
        size = " x ".join(f"{side:g}" for side in self.size_m)
        decay = f"T60 = {self.reverberation_time_s:.3g} s, cut off at {self.decay_db:.0f} dB"
        return (
            f"<RoomPaths: {len(self.sources_m)} noise source(s), {len(self.loudspeakers_m)} loudspeaker(s), "
            f"{len(self.microphones_m)} microphone(s) in {size} m, {self.primary.shape[2]} taps at {self.fs:g} Hz, "
            f"{decay if self.reverberation_time_s else 'free field'}>"
        )

    @property
    def decay_db(self) -> float:
        """Level in dB to which the reverberation has decayed at the last tap, by `reverberation_time_s`."""
        if self.reverberation_time_s == 0:
            return -np.inf
        return -60.0 * self.primary.shape[2] / (self.fs * self.reverberation_time_s)

    def at(self, microphones_m: ArrayLike) -> RoomPaths:
        """Return the paths from the same sources and loudspeakers to other microphones in the same room.

        Parameters
        ----------
        microphones_m : array_like, shape (..., 3)
            Positions in m, those of `horizontal_plane` for example, or of virtual microphones.

        Returns
        -------
        RoomPaths
            Paths to these microphones, in the order of their positions.

        Raises
        ------
        TypeError, ValueError, ImportError
            As for `room_paths`.
        """
        positions = as_real_array(microphones_m, "microphones_m")
        return room_paths(
            self.size_m,
            loudspeakers_m=self.loudspeakers_m,
            sources_m=self.sources_m,
            microphones_m=positions.reshape(-1, 3) if positions.shape[-1:] == (3,) else positions,
            absorption=self.absorption,
            fs=self.fs,
            n_taps=self.primary.shape[2],
            speed_of_sound=self.speed_of_sound,
        )


def room_paths(
    size_m: ArrayLike,
    *,
    loudspeakers_m: ArrayLike,
    sources_m: ArrayLike,
    microphones_m: ArrayLike,
    reverberation_time_s: float | None = None,
    absorption: float | Mapping[str, float] | None = None,
    fs: float = 16000.0,
    n_taps: int = 512,
    speed_of_sound: float = 343.0,
) -> RoomPaths:
    r"""Compute the paths between points in a rectangular room, from the image sources of pyroomacoustics.

    An image of a source at a distance r from the microphone adds :math:`g / (4 \pi r)` at the time r/c, where g is the
    product of the pressure reflection factors :math:`\sqrt{1 - \alpha}` of the walls it was reflected at. Each arrival
    is a band-limited pulse centred on that time, so the direct sound arrives at distance / speed of sound, with no delay
    added. The pulse is a sinc under a Hann window, 10 samples on each side: flat within 0.2 dB up to 0.4 fs. It is
    narrower if the sound arrives sooner than that, so that nothing comes before time zero; at 5 samples, 0.1 m at
    16 kHz, the response is 1 dB down at 0.4 fs.

    Only image sources whose sound arrives within `n_taps` are summed. Later reverberation is cut off; `decay_db` tells
    by how much it has decayed until then. The image sources of a room with even walls decay more slowly than Sabine's
    formula says, by up to half in usual rooms, because sound that grazes a wall is absorbed less often.

    Not modelled: loudspeakers and microphones (all are points that radiate and receive all frequencies and directions
    alike), objects in the room, walls that absorb by frequency, absorption by the air, and feedback to the reference,
    which is the signal of the noise source itself. Image sources are accurate above the room's lowest resonances. All
    reflections have the same sign, so the response at 0 Hz is much larger than a real room's.

    Parameters
    ----------
    size_m : array_like, shape (3,)
        Length, width and height of the room in m. A corner is the origin.
    loudspeakers_m : array_like, shape (J, 3)
        Positions x, y, z of the loudspeakers in m; (3,) for a single one.
    sources_m : array_like, shape (I, 3)
        Positions of the noise sources in m.
    microphones_m : array_like, shape (K, 3)
        Positions of the error microphones in m.
    reverberation_time_s : float, optional
        Time in which the sound decays by 60 dB. Sabine's formula gives the absorption, the same for all walls.
    absorption : float or mapping of str to float, optional
        Share of the energy that a wall absorbs, above 0 and up to 1, in place of `reverberation_time_s`: one for all, or
        one for each of "west" (x = 0), "east", "south" (y = 0), "north", "floor" (z = 0) and "ceiling". 1 is a free
        field.
    fs : float, default 16000
        Sampling rate in Hz.
    n_taps : int, default 512
        Length of the impulse responses.
    speed_of_sound : float, default 343.0
        Speed of sound c in m/s.

    Returns
    -------
    RoomPaths
        Paths, and the room they were computed for. `primary` and `secondary` are what `simulate` takes.

    Raises
    ------
    ImportError
        If pyroomacoustics is not installed.
    TypeError, ValueError
        If a position lies outside the room or twice in a list, a microphone is nearer to a source or loudspeaker than
        sound travels in a sample, a direct sound arrives after `n_taps`, or an argument is out of range.

    References
    ----------
    .. [1] J. B. Allen and D. A. Berkley, J. Acoust. Soc. Am. 65(4), 1979.
    .. [2] R. Scheibler, E. Bezzam and I. Dokmanić, "Pyroomacoustics", ICASSP 2018.

    Examples
    --------
    >>> paths = room_paths(
    ...     [5.0, 4.0, 2.5],
    ...     sources_m=[[0.5, 2.0, 1.2]],
    ...     loudspeakers_m=[[3.0, 1.0, 1.2], [3.0, 3.0, 1.2]],
    ...     microphones_m=[[4.0, 1.5, 1.2], [4.0, 2.5, 1.2]],
    ...     reverberation_time_s=0.25,
    ... )
    >>> paths.primary.shape, paths.secondary.shape
    ((2, 1, 512), (2, 2, 512))
    >>> paths  # doctest: +NORMALIZE_WHITESPACE
    <RoomPaths: 1 noise source(s), 2 loudspeaker(s), 2 microphone(s) in 5 x 4 x 2.5 m,
    512 taps at 16000 Hz, T60 = 0.25 s, cut off at -8 dB>
    """
    fs, c = as_positive(fs, "fs", unit="Hz"), as_positive(speed_of_sound, "speed_of_sound", unit="m/s")
    n_taps = as_count(n_taps, "n_taps")
    size = _size(size_m)
    walls = _absorption(size, reverberation_time_s, absorption, c)
    loudspeakers = _positions(loudspeakers_m, "loudspeakers_m", size)
    sources = _positions(sources_m, "sources_m", size)
    microphones = _positions(microphones_m, "microphones_m", size)
    for name, emitters in (("sources_m", sources), ("loudspeakers_m", loudspeakers)):
        _require_distances(microphones, emitters, name, c / fs, n_taps)
    images = _image_sources(size, walls, np.vstack([sources, loudspeakers]), c, (n_taps + _HALF_WIDTH) * c / fs)
    taps = np.array([[_response(place, *image, fs / c, n_taps) for image in images] for place in microphones])
    return RoomPaths(
        primary=taps[:, : len(sources)].copy(),
        secondary=taps[:, len(sources) :].copy(),
        fs=fs,
        size_m=size,
        loudspeakers_m=loudspeakers,
        sources_m=sources,
        microphones_m=microphones,
        absorption=walls,
        reverberation_time_s=0.0 if _is_free_field(walls) else _sabine(size, walls, c),
        speed_of_sound=c,
    )


def horizontal_plane(size_m: ArrayLike, height_m: float, *, spacing_m: float = 0.1) -> np.ndarray:
    """Return the positions of microphones on a horizontal grid in a room, for a map of the sound level.

    Parameters
    ----------
    size_m : array_like, shape (3,)
        Length, width and height of the room in m.
    height_m : float
        Height of the plane in m.
    spacing_m : float, default 0.1
        Largest distance between neighbours in m, and twice that to the walls.

    Returns
    -------
    numpy.ndarray, shape (n_y, n_x, 3)
        Positions x, y, z in m, in rows of equal y, as images are drawn. `RoomPaths.at` takes them; a result of shape
        (n_y * n_x, ...) gets the plane's shape by ``.reshape(plane.shape[:2])``.

    Raises
    ------
    TypeError, ValueError
        If the plane lies outside the room, or an argument is out of range.

    Examples
    --------
    >>> plane = horizontal_plane([2.0, 1.0, 2.5], 1.2, spacing_m=0.5)
    >>> plane.shape, plane[0, :, 0], plane[:, 0, 1]
    ((2, 4, 3), array([0.25, 0.75, 1.25, 1.75]), array([0.25, 0.75]))
    """
    size, spacing = _size(size_m), as_positive(spacing_m, "spacing_m", unit="m")
    height = as_positive(height_m, "height_m", unit="m")
    if height >= size[2]:
        raise ValueError(f"height_m must be below the ceiling at {size[2]:g} m, got {height:g} m")
    counts = np.ceil(np.round(size[:2] / spacing, 9)).astype(int)  # 0.3 / 0.1 is 3, not 2.9999999999999996
    x, y = ((np.arange(count) + 0.5) * side / count for side, count in zip(size, counts, strict=False))
    return np.stack([*np.meshgrid(x, y), np.full((y.size, x.size), height)], axis=-1)


def _size(size_m: Any) -> np.ndarray:
    size = as_real_array(size_m, "size_m")
    if size.shape != (3,):
        raise ValueError(f"size_m must be (length, width, height) in m, got shape {size.shape}")
    require_finite(size, "size_m")
    if np.any(size <= 0):
        raise ValueError(f"size_m must be greater than 0 m in every direction, got {size.tolist()}")
    return size.copy()


def _positions(value: Any, name: str, size: np.ndarray) -> np.ndarray:
    """Return positions (n, 3), all inside the room and apart from each other."""
    positions = np.atleast_2d(as_real_array(value, name)).copy()
    if positions.ndim != 2 or positions.shape[1] != 3 or len(positions) == 0:
        raise ValueError(f"{name} must be x, y, z in m for each, shape (n, 3), got {np.shape(value)}")
    require_finite(positions, name)
    outside = np.flatnonzero(np.any((positions <= 0) | (positions >= size), axis=1))
    if outside.size:
        raise ValueError(
            f"{name}[{outside[0]}] = {positions[outside[0]].tolist()} m must lie inside the room, which reaches from "
            f"[0, 0, 0] to {size.tolist()} m"
        )
    _, first, group = np.unique(positions, axis=0, return_index=True, return_inverse=True)
    twice = np.flatnonzero(first[group.ravel()] != np.arange(len(positions)))
    if twice.size:
        before = first[group.ravel()][twice[0]]
        raise ValueError(f"{name}[{twice[0]}] must not be at the same position as {name}[{before}]: move one of them")
    return positions


def _require_distances(microphones: np.ndarray, emitters: np.ndarray, name: str, sample_m: float, n_taps: int) -> None:
    """Raise ValueError if a microphone is too near to a source for the model, or too far for the taps."""
    distances = np.linalg.norm(microphones[:, np.newaxis] - emitters, axis=2)
    near = np.unravel_index(np.argmin(distances), distances.shape)
    if distances[near] < sample_m:
        raise ValueError(
            f"microphones_m[{near[0]}] must not be nearer to {name}[{near[1]}] than {sample_m:.3g} m, which sound "
            f"travels in a sample, got {distances[near]:.3g} m: move it, or raise fs"
        )
    far = np.unravel_index(np.argmax(distances), distances.shape)
    needed = int(np.ceil(distances[far] / sample_m + _HALF_WIDTH))
    if needed > n_taps:
        raise ValueError(
            f"n_taps must be at least {needed}, which the direct sound from {name}[{far[1]}] to microphones_m[{far[0]}] "
            f"takes, got {n_taps}"
        )


def _absorption(size: np.ndarray, reverberation_time_s: Any, absorption: Any, c: float) -> dict[str, float]:
    """Return the absorption coefficient of each wall, as given or by Sabine's formula."""
    if (reverberation_time_s is None) == (absorption is None):
        raise ValueError("give either reverberation_time_s or absorption, not both and not neither")
    if absorption is None:
        wanted = as_positive(reverberation_time_s, "reverberation_time_s", unit="s")
        shortest = _sabine(size, dict.fromkeys(WALLS, 1.0), c)
        if wanted < shortest:
            raise ValueError(
                f"reverberation_time_s must be at least {shortest:.3g} s in this room, where walls that absorb everything "
                f"reach it by Sabine's formula, got {wanted:g} s; absorption=1.0 is a free field"
            )
        absorption = optional_module("pyroomacoustics", "rooms", "room_paths").inverse_sabine(wanted, size, c=c)[0]
    if not isinstance(absorption, Mapping):
        absorption = dict.fromkeys(WALLS, absorption)
    if set(absorption) != set(WALLS):
        raise ValueError(f"absorption must name the walls {', '.join(WALLS)}, got {', '.join(map(str, absorption))}")
    walls = {name: as_number(absorption[name], f"absorption of {name}") for name in WALLS}
    for name, value in walls.items():
        if not 0 < value <= 1:
            raise ValueError(f"absorption must be above 0 and at most 1, got {value:g} for the wall {name}")
    return walls


def _is_free_field(walls: Mapping[str, float]) -> bool:
    return all(value == 1 for value in walls.values())


def _sabine(size: np.ndarray, walls: Mapping[str, float], c: float) -> float:
    """Return the reverberation time by Sabine's formula in s."""
    areas = np.repeat(np.prod(size) / size, 2)  # in the order of WALLS
    return float(24 * np.log(10) * np.prod(size) / (c * (areas @ [walls[name] for name in WALLS])))


def _image_sources(
    size: np.ndarray, walls: dict[str, float], emitters: np.ndarray, c: float, reach_m: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return positions (n, 3) and reflection gains (n,) of each source's images, all that sound reaches from.

    An image of order n along a side L lies at least (n - 1) L away. By Cauchy and Schwarz, no image within the reach has
    orders along the three sides that sum to more than ``3 + reach * sqrt(sum 1/L^2)``.
    """
    pra = optional_module("pyroomacoustics", "rooms", "room_paths")
    order = 0 if _is_free_field(walls) else int(3 + reach_m * np.sqrt(np.sum(size**-2.0)))
    # The images depend neither on the sampling rate nor on the microphone, but pyroomacoustics asks for them.
    room = pra.ShoeBox(
        size, fs=16000, max_order=order, materials={name: pra.Material(value) for name, value in walls.items()}
    )
    room.set_sound_speed(c)
    room.add_microphone(size / 2)
    for emitter in emitters:
        room.add_source(emitter)
    room.image_source_model()
    return [(source.images.T.astype(np.float64), source.damping[0].astype(np.float64)) for source in room.sources]


def _response(
    microphone: np.ndarray, images: np.ndarray, gains: np.ndarray, samples_per_m: float, n_taps: int
) -> np.ndarray:
    """Return the impulse response from a source's images to a microphone.

    pyroomacoustics' own `compute_rir` is not used: its fractional delays begin 40 samples before an arrival, which
    precedes time zero for a loudspeaker within 0.86 m at 16 kHz, and its high-pass runs backwards in time too.
    """
    distances = np.linalg.norm(images - microphone, axis=1)
    arrivals, amplitudes = distances * samples_per_m, gains / (4 * np.pi * distances)
    heard = np.flatnonzero((gains > 0) & (arrivals < n_taps + _HALF_WIDTH))
    taps = np.zeros(n_taps)
    for part in np.array_split(heard, 1 + heard.size // _IMAGES_AT_ONCE):
        taps += _pulses(arrivals[part, np.newaxis], amplitudes[part, np.newaxis], n_taps)
    return taps


def _pulses(arrivals: np.ndarray, amplitudes: np.ndarray, n_taps: int) -> np.ndarray:
    """Return the sum of band-limited pulses, (n_taps,), for arrivals in samples and amplitudes, (n, 1)."""
    n = np.floor(arrivals).astype(int) + np.arange(1 - _HALF_WIDTH, 1 + _HALF_WIDTH)
    t = n - arrivals
    width = np.minimum(_HALF_WIDTH, arrivals + 1)  # the pulse is 0 at n = -1
    pulses = np.where(np.abs(t) < width, amplitudes * np.sinc(t) * (0.5 + 0.5 * np.cos(np.pi * t / width)), 0.0)
    within = (n >= 0) & (n < n_taps)
    return np.bincount(n[within], weights=pulses[within], minlength=n_taps)
