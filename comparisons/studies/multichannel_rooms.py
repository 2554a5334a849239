"""Rooms of several loudspeakers and microphones for the multichannel study, their noises, scenes and level maps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib.util import find_spec
from typing import Any

import numpy as np
from scipy.signal import fftconvolve

from kfopc_filterpy import SimulationResult, signals
from kfopc_filterpy.paths import RoomPaths, horizontal_plane, room_paths

from ..bench import FigureItem, Scene
from .cases import SENSOR_NOISE_DB, SWITCH_ON_S, bound_of, measured_room, recordings, unit_scene
from .report_parts import new_figure

FS = 4000.0  # of the built-in room: ample for a band up to 500 Hz, with a quarter of the samples of 16 kHz
N_TAPS, N_PATH_TAPS = 128, 256
SIZE_M, HEIGHT_M, REVERBERATION_S = (6.0, 4.0, 2.6), 1.2, 0.25
SOURCE_M = (0.6, 2.3, 1.4)
SIZES = (2, 4, 8)
MEASURED_N_TAPS = 256
TONES_HZ = (120.0, 180.0, 240.0)
BAND_HZ, WIDE_BAND_HZ = (80.0, 500.0), (100.0, 1000.0)  # of the built-in room and of the measured one
MEASURED = "measured 4 x 4"
RECORDINGS = ("recorded compressor", "recorded motor")
FLOOR_DB = -60.0  # white noise below tones and band noise
SEED = 1
RATED_SHARE = 0.25  # rated power of each loudspeaker over the power that it would use without a limit
MAP_SPACING_M = 0.125


@dataclass(frozen=True)
class Place:
    """Paths and noises of one room."""

    name: str
    fs: float
    n_taps: int
    primary: np.ndarray
    secondary: np.ndarray
    noises: dict[str, Callable[[float], np.ndarray]]  # functions of a duration in s


def built_in_room(size: int) -> RoomPaths:
    """Return the built-in room, with `size` loudspeakers and as many microphones.

    Between the noise source and the far wall, the loudspeakers stand in a row across the room, and the microphones in
    another row 1.2 m behind it.
    """
    across = np.linspace(0.6, 3.4, size)
    to_and_fro = 0.15 * (-1.0) ** np.arange(size)
    return room_paths(
        SIZE_M,
        sources_m=[SOURCE_M],
        loudspeakers_m=np.stack([3.2 + to_and_fro, across, np.full(size, 1.1)], axis=1),
        microphones_m=np.stack([4.4 - to_and_fro, np.linspace(0.9, 3.1, size), np.full(size, HEIGHT_M)], axis=1),
        reverberation_time_s=REVERBERATION_S,
        fs=FS,
        n_taps=N_PATH_TAPS,
    )


@cache
def places() -> dict[str, Place]:
    """Return the built-in rooms if pyroomacoustics is installed, and the measured one if its data are available."""
    made: dict[str, Place] = {}
    for size in SIZES if find_spec("pyroomacoustics") else ():
        room, name = built_in_room(size), f"{size} x {size}"
        made[name] = Place(name, FS, N_TAPS, room.primary, room.secondary, _noises(FS, BAND_HZ))
    measured = _measured_place()
    return made | ({} if measured is None else {MEASURED: measured})


def _measured_place() -> Place | None:
    room, found = measured_room(), recordings("compressor", "motor")
    if room is None or len(found) < len(RECORDINGS):
        return None
    noises = _noises(room.fs, WIDE_BAND_HZ)
    del noises["compressor"]  # the recorded one takes its place
    for name, recording in zip(RECORDINGS, found.values(), strict=True):
        noises[name] = partial(signals.looped, recording, fs=room.fs)
    return Place(MEASURED, room.fs, MEASURED_N_TAPS, room.primary, room.secondary, noises)


def _noises(fs: float, band_hz: tuple[float, float]) -> dict[str, Callable[[float], np.ndarray]]:
    """Return the synthetic noises; tones and band noise are above a noise floor, as any real reference has one.

    Without a floor, a fixed filter can predict them with very large weights in directions without energy.
    """

    def tones(duration: float) -> np.ndarray:
        return np.sum([signals.tone(f, duration, fs=fs, phase_rad=f) for f in TONES_HZ], axis=0)

    def band_noise(duration: float) -> np.ndarray:
        return signals.band_limited_noise(band_hz, duration, fs=fs, rng=SEED)

    def over_floor(noise: Callable[[float], np.ndarray], duration: float) -> np.ndarray:
        x = noise(duration)
        floor = np.random.default_rng(SEED).standard_normal(x.size)
        return x + np.sqrt(np.mean(x**2)) * 10 ** (FLOOR_DB / 20) * floor

    return {
        "tones": partial(over_floor, tones),
        "band noise": partial(over_floor, band_noise),
        "compressor": lambda duration: signals.compressor_noise(duration, fs=fs, rng=SEED),
    }


def make_rated_scene(place: Place, noise: str, duration_s: float) -> Scene:
    """Return the scene of a noise; each loudspeaker is rated at a quarter of the power that it would use unlimited."""
    x = place.noises[noise](duration_s + SWITCH_ON_S)
    own: dict[str, Any] = {"n_taps": place.n_taps, "sensor_noise_db": SENSOR_NOISE_DB, "seed": SEED, "fs": place.fs}
    scene = unit_scene((place.primary, place.secondary), x[np.newaxis], **own)
    free = replace(scene, rated_power=1e12)
    wanted = bound_of(free, segment_s=2 * duration_s).unconstrained.control_power
    return replace(scene, rated_power=RATED_SHARE * wanted, unconstrained_power=wanted)


def equally_rated(scene: Scene) -> Scene:
    """Return a scene in which every loudspeaker has the mean of their rated powers."""
    return replace(scene, rated_power=np.full_like(scene.rated_power, np.mean(scene.rated_power)))


def level_map_db(size: int, reference: np.ndarray, result: SimulationResult | None) -> tuple[np.ndarray, Any]:
    """Return the sound level in a plane of a built-in room over the last second, and the axes of the plane in m.

    The level is in dB relative to the mean over the plane without control.

    Parameters
    ----------
    size : int
        Number of loudspeakers of the room.
    reference : ndarray, shape (1, n_samples)
        Signal of the noise source, as long as the control signal.
    result : SimulationResult or None
        The run whose control signal the loudspeakers play; None for silence.
    """
    plane, paths = _plane(), _paths_to_plane(size)
    needed = slice(-int(FS) - N_PATH_TAPS + 1, None)
    sound = fftconvolve(reference[np.newaxis, :, needed], paths.primary, mode="valid", axes=-1).sum(axis=1)
    without = np.mean(sound**2)
    if result is not None:
        y = result.control_signal[np.newaxis, :, needed]
        sound = sound - fftconvolve(y, paths.secondary, mode="valid", axes=-1).sum(axis=1)
    level = 10 * np.log10(np.mean(sound**2, axis=1) / without)
    return level.reshape(plane.shape[:2]), (plane[0, :, 0], plane[:, 0, 1])


def map_figure(size: int, noise: str, scene: Scene, results: Mapping[str, SimulationResult]) -> FigureItem:
    """Return a figure of the sound level in a plane of a built-in room without control, and in some runs."""
    panels: dict[str, SimulationResult | None] = {"Without control": None, **results}
    room = built_in_room(size)
    figure, axes = new_figure((4.1 * len(panels), 3.4), 1, len(panels), grid="", sharey=True)
    for (name, result), ax in zip(panels.items(), axes[0], strict=True):
        level, (x, y) = level_map_db(size, scene.settled[0], result)
        mesh = ax.pcolormesh(x, y, level, cmap="viridis", vmin=-15.0, vmax=10.0, shading="nearest", rasterized=True)
        for points, mark in ((room.sources_m, "*"), (room.loudspeakers_m, "s"), (room.microphones_m, "o")):
            ax.plot(*points[:, :2].T, mark, color="white", markeredgecolor="black", markersize=7)
        ax.set_title(name, fontsize="medium")
        ax.set(xlabel="x (m)", aspect="equal")
    axes[0, 0].set_ylabel("y (m)")
    figure.colorbar(mesh, ax=axes[0].tolist(), label="Level (dB)", shrink=0.8)
    caption = (
        f"Built-in room, {size} x {size}, {noise}: sound level over the last second in a plane {HEIGHT_M:g} m above the "
        "floor, in dB relative to the mean without control. Star: noise source; squares: loudspeakers; circles: error "
        "microphones."
    )
    return FigureItem("map", caption, figure)


def _plane() -> np.ndarray:
    return horizontal_plane(SIZE_M, HEIGHT_M, spacing_m=MAP_SPACING_M)


@cache
def _paths_to_plane(size: int) -> RoomPaths:
    return built_in_room(size).at(_plane())
