"""Rooms of several loudspeakers and microphones for the multichannel study, their noises and scenes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
import pyroomacoustics as pra
from numpy.typing import ArrayLike

from kfopc_filterpy import Plant, signals

from ..bench import Scene
from ..bench.noises import looped
from .cases import SENSOR_NOISE_DB, SWITCH_ON_S, bound_of, measured_room, recordings, unit_scene

FS = 4000.0  # of the built-in room: ample for a band up to 500 Hz, with a quarter of the samples of 16 kHz
N_TAPS, N_PATH_TAPS = 128, 256
SIZE_M, REVERBERATION_S = (6.0, 4.0, 2.6), 0.25
SPEED_OF_SOUND = 343.0  # in m/s
HALF_WIDTH = 10  # samples on each side of an arrival: the response is then flat within 0.2 dB up to 0.4 fs
REACH_M = (N_PATH_TAPS + HALF_WIDTH) / FS * SPEED_OF_SOUND  # from which sound arrives within the taps
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


@dataclass(frozen=True)
class Place:
    """A plant of several channels, and its noises."""

    name: str
    n_taps: int
    plant: Plant
    noises: dict[str, Callable[[float], np.ndarray]]  # functions of a duration in s


def built_in_room(size: int) -> Plant:
    """Return the built-in room, with `size` loudspeakers and as many microphones.

    Between the noise source and the far wall, the loudspeakers stand in a row across the room, and the microphones in
    another row 1.2 m behind it.
    """
    to_and_fro = 0.15 * (-1.0) ** np.arange(size)
    loudspeakers = np.stack([3.2 + to_and_fro, np.linspace(0.6, 3.4, size), np.full(size, 1.1)], axis=1)
    microphones = np.stack([4.4 - to_and_fro, np.linspace(0.9, 3.1, size), np.full(size, 1.2)], axis=1)
    secondary, primary = (paths_between(emitters, microphones) for emitters in (loudspeakers, [SOURCE_M]))
    return Plant(secondary, primary, fs=FS)


def paths_between(emitters_m: Iterable[ArrayLike], microphones_m: np.ndarray) -> np.ndarray:
    """Return the impulse responses of the built-in room, (microphones, emitters, taps), from its image sources.

    An image at a distance r adds its gain over 4 pi r at the time r/c. pyroomacoustics' own responses are not used: they
    begin 40 samples before the sound arrives, which for a near loudspeaker is before time zero.
    """
    absorption, _ = pra.inverse_sabine(REVERBERATION_S, SIZE_M, c=SPEED_OF_SOUND)
    # An image of order n along a side L is at least (n - 1) L away. By Cauchy and Schwarz, the orders of one that is
    # heard sum to no more than this.
    order = int(3 + REACH_M * np.sqrt(np.sum(np.array(SIZE_M) ** -2)))
    room = pra.ShoeBox(SIZE_M, fs=FS, materials=pra.Material(absorption), max_order=order)
    room.set_sound_speed(SPEED_OF_SOUND)
    room.add_microphone(np.divide(SIZE_M, 2))  # without one there are no images; they are the same for all
    for place in emitters_m:
        room.add_source(place)
    room.image_source_model()
    images = [(source.images.T.astype(float), source.damping[0].astype(float)) for source in room.sources]
    return np.array([[_response(place, *own) for own in images] for place in microphones_m])


def _response(place: np.ndarray, images_m: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """Return the taps from images to a place, each a sinc under a Hann window, narrower if it began before time zero."""
    distances = np.linalg.norm(images_m - place, axis=1)
    heard = distances < REACH_M
    distances, gains = distances[heard, np.newaxis], gains[heard, np.newaxis]
    arrivals = distances * (FS / SPEED_OF_SOUND)
    n = np.floor(arrivals).astype(int) + np.arange(1 - HALF_WIDTH, 1 + HALF_WIDTH)
    late, width = n - arrivals, np.minimum(HALF_WIDTH, arrivals + 1)
    window = np.where(np.abs(late) < width, 0.5 + 0.5 * np.cos(np.pi * late / width), 0.0)
    pulses = gains / (4 * np.pi * distances) * np.sinc(late) * window
    kept = (n >= 0) & (n < N_PATH_TAPS)
    return np.bincount(n[kept], weights=pulses[kept], minlength=N_PATH_TAPS)


@cache
def places() -> dict[str, Place]:
    """Return the built-in rooms, and the measured one if its data are available."""
    made: dict[str, Place] = {}
    for size in SIZES:
        name = f"{size} x {size}"
        made[name] = Place(name, N_TAPS, built_in_room(size), _noises(FS, BAND_HZ))
    measured = _measured_place()
    return made | ({} if measured is None else {MEASURED: measured})


def _measured_place() -> Place | None:
    room, found = measured_room(), recordings("compressor", "motor")
    if room is None or len(found) < len(RECORDINGS):
        return None
    noises = _noises(room.fs, WIDE_BAND_HZ)
    del noises["compressor"]  # the recorded one takes its place
    for name, recording in zip(RECORDINGS, found.values(), strict=True):
        noises[name] = partial(looped, recording, fs=room.fs)
    return Place(MEASURED, MEASURED_N_TAPS, room, noises)


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
    scene = unit_scene(place.plant, x, n_taps=place.n_taps, sensor_noise_db=SENSOR_NOISE_DB, seed=SEED)
    free = replace(scene, rated_power=1e12)
    wanted = bound_of(free, segment_s=2 * duration_s).unconstrained.control_power
    return replace(scene, rated_power=RATED_SHARE * wanted, unconstrained_power=wanted)


def equally_rated(scene: Scene) -> Scene:
    """Return a scene in which every loudspeaker has the mean of their rated powers."""
    return replace(scene, rated_power=np.full_like(scene.rated_power, np.mean(scene.rated_power)))
