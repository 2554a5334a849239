"""What happens in the study of tracking: jumps of the level, changes of the primary path, sweeps, and their scenes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from kfopc_filterpy import Plant
from kfopc_filterpy.paths import Duct, duct_plant

from ..bench import Scene
from .cases import FS, SEED, SWITCH_ON_S, driven_case, heard_on, jumping, noise_of

OVERDRIVE_DB = 3.0
LOUDER, SOFTER = "20 dB louder", "20 dB softer"
JUMP_DB = 20.0
JUMP_S = (1.5, 3.0)  # of a run of JUMP_RUN_S, from switch-on on
JUMP_RUN_S = 7.0
CHANGE_S, CHANGE_RUN_S = 2.0, 6.0
CHANGES = ("sign", "delay", "longer duct")
DELAY_SAMPLES = 16
OTHER_LENGTH_M = 2.6
CHIRP_HZ, SWEEP_S, SWEEPS = (20.0, 1600.0), 0.25, 16
SEEDS = (SEED, 2, 3)  # the first is tuned on
NSE_WINDOW_S = 0.05
SWEEP_NSE_S = 0.01


@dataclass(frozen=True)
class Event:
    """A run in which something changes: its scene from a plant and a seed, and the stretches in which the filter settles.

    A stretch ends with the next change. Sweeps have none: the noise never comes to rest.
    """

    name: str
    scene: Callable[[Plant, int], Scene]
    stretches: dict[str, tuple[float, float]]
    paths: tuple[str, ...] | None = None  # None: all
    seeds: tuple[int, ...] | None = None  # None: SEEDS
    nse_window_s: float = NSE_WINDOW_S
    shown_window_s: float = NSE_WINDOW_S  # of the NSE in the figure
    noise: str = "band noise"


def all_events() -> list[Event]:
    """Return all events."""
    back = {"back": (JUMP_S[1], JUMP_RUN_S)}
    changed = {"changed": (CHANGE_S, CHANGE_RUN_S)}
    return [
        Event(LOUDER, lambda plant, seed: jump_scene(plant, seed, JUMP_DB), {"louder": JUMP_S} | back),
        Event(SOFTER, lambda plant, seed: jump_scene(plant, seed, -JUMP_DB), {"softer": JUMP_S} | back),
        Event("sign", lambda plant, seed: change_scene(plant, seed, -_primary(plant)), changed),
        Event("delay", lambda plant, seed: change_scene(plant, seed, _delayed(_primary(plant))), changed),
        Event("longer duct", lambda plant, seed: change_scene(plant, seed, _longer_duct()), changed, paths=("duct",)),
        Event(
            "one sweep", lambda plant, _: sweep_scene(plant, 1), {}, None, (SEED,), SWEEP_NSE_S, SWEEP_NSE_S, "sweep"
        ),
        Event("sweeps", lambda plant, _: sweep_scene(plant, SWEEPS), {}, None, (SEED,), SWEEP_NSE_S, SWEEP_S, "sweep"),
    ]


def jobs(names: Iterable[str]) -> list[tuple[Event, str]]:
    """Return the events on the paths that have them."""
    return [(event, path) for event in all_events() for path in names if event.paths is None or path in event.paths]


def scenes_of(event: Event, plant: Plant) -> list[Scene]:
    """Return a scene for each seed, with a sensor noise of its own."""
    return [
        replace(event.scene(plant, seed), seeds=[seed], nse_window_s=event.nse_window_s)
        for seed in event.seeds or SEEDS
    ]


def jump_scene(plant: Plant, seed: int, gain_db: float) -> Scene:
    """Return band noise that is louder or softer for a while; the rated power is that of its usual level."""
    scene = driven_case(plant, noise_of("band noise", JUMP_RUN_S, seed), OVERDRIVE_DB)
    begin_s, end_s = JUMP_S
    return jumping(scene, plant, (begin_s + SWITCH_ON_S, end_s + SWITCH_ON_S), gain_db)


def change_scene(plant: Plant, seed: int, other: np.ndarray) -> Scene:
    """Return band noise whose primary path changes at `CHANGE_S`: what is on its way then arrives by the new one."""
    scene = driven_case(plant, noise_of("band noise", CHANGE_RUN_S, seed), OVERDRIVE_DB)
    return heard_on(scene, plant.changed_at(CHANGE_S + SWITCH_ON_S, primary=other), scene.references[0])


def sweep_scene(plant: Plant, sweeps: int) -> Scene:
    """Return sweeps from a standing start: silence until the control is switched on."""
    silence = np.zeros(round(SWITCH_ON_S * FS))
    return driven_case(plant, np.concatenate([silence, np.tile(sweep(CHIRP_HZ, SWEEP_S, FS), sweeps)]), OVERDRIVE_DB)


def sweep(band_hz: tuple[float, float], duration_s: float, fs: float) -> np.ndarray:
    """Return a sine whose frequency rises linearly from one frequency to another."""
    t = np.arange(round(duration_s * fs)) / fs
    rise = (band_hz[1] - band_hz[0]) / duration_s
    return np.sin(2 * np.pi * (band_hz[0] * t + 0.5 * rise * t**2))


def _longer_duct() -> np.ndarray:
    return _primary(duct_plant(Duct(length_m=OTHER_LENGTH_M), fs=FS))


def _delayed(primary: np.ndarray) -> np.ndarray:
    return np.pad(primary, (DELAY_SAMPLES, 0))


def _primary(plant: Plant) -> np.ndarray:
    assert plant.primary is not None
    return plant.primary[0, 0]
