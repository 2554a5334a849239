"""The tasks of the benchmark: files that say which paths, which noise, which rated power, and what changes.

No signal is stored. A file names models of this package, or a public data set, and holds a hash of the signals that
these gave: if they give others now, the task is refused.
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np

from kfopc_filterpy import Plant, SimulationResult, bandpass_path, power_constrained_wiener
from kfopc_filterpy._validate import as_choice
from kfopc_filterpy.bounds import PowerConstrainedWiener
from kfopc_filterpy.controllers import Controller
from kfopc_filterpy.controllers.kf_pb import DEFAULT_AVERAGING_S
from kfopc_filterpy.paths import duct_plant
from kfopc_filterpy.signals import band_limited_noise, compressor_noise, tone

from ..bench import Scene, make_scene
from ..bench.changes import CHANGES, Change
from ..bench.noises import looped
from ..bench.scene import reachable_weights
from ..studies.cases import measured_data, of_unit_gain
from ..studies.multichannel_rooms import built_in_room

FOLDER = Path(__file__).resolve().parent / "tasks"
SEEDS = (1, 2)  # of the noise to tune on, and of the one that is judged
JUDGED = 1  # index of the latter
DECIMALS = 4  # of what is hashed, over the rms: other machines round sums differently, far below that
SENSOR_NOISE_DB, NSE_WINDOW_S = -40.0, 0.05


class LeftOut(Exception):
    """This machine lacks what a task needs."""


@dataclass(frozen=True)
class Task(Scene):
    """A scene of two noises, one to tune on and one to be judged on, whose control signals are played a block later.

    A sound card takes and gives whole blocks. So the secondary path begins with the delay of a block for every entry.

    Parameters
    ----------
    name, title : str
        Name of the file, and what the task is about.
    digest : str
        Hash of the definition; scores with the same one can be compared.
    block : int
        Samples of a block.
    primary : ndarray, shape (K, I, n_taps)
        Primary path, for entries that are designed by a measurement of it.
    change : Change
        What changes during the run. Controllers know the plant before it.
    changed_at_s : float
        Time of the change; 0 if nothing changes.
    other_packages : bool
        Whether the filters of other packages enter.
    """

    name: str = ""
    title: str = ""
    digest: str = ""
    block: int = 0
    primary: Any = None
    change: Change = CHANGES["nothing"]
    changed_at_s: float = 0.0
    other_packages: bool = True

    def plant_of(self, controller: Controller) -> Plant:
        """Return the plant of a run; a controller with `plays_blocks` delays its control signal itself."""
        path = self.secondary[..., self.block if getattr(controller, "plays_blocks", False) else 0 :]
        return self.change.plant(replace(self, secondary=path).plant, self.changed_at_s)

    def run_together(self, *own: Any, **options: Any) -> list[SimulationResult]:
        """Run controllers as a scene does, on what the reference microphone delivers."""
        return Scene.run_together(replace(self, references=self.heard), *own, **options)

    @property
    def heard(self) -> list[np.ndarray]:
        """What the reference microphone delivers of each noise."""
        return [self.change.reference(x, round(self.changed_at_s * self.fs), self.fs) for x in self.references]

    def bound(self, from_s: float) -> PowerConstrainedWiener:
        """Return the best fixed filters within the rated power from a time on, for the plant after the change."""
        with reachable_weights():
            return power_constrained_wiener(
                self.references[JUDGED],
                self.change.plant(Plant(self.secondary, fs=self.fs), self.changed_at_s).at(from_s),
                n_taps=self.n_taps,
                rated_power=self.rated_power,
                disturbance=self.disturbances[JUDGED],
                switch_on_s=from_s,
            )

    def bound_db(self) -> float:
        """Return the noise reduction of the best fixed filter within the rated power, over the half that counts."""
        bound = self.bound(self.references[JUDGED].shape[-1] / self.fs / 2).whole
        left = np.mean(bound.error**2) + self.sensor_noise_std**2
        return float(-10 * np.log10(left / np.mean(bound.stretch.d**2)))


# ---- What a file names

Noise = Callable[[int], np.ndarray]  # of a seed


def _tones(duration_s: float, *, fs: float, frequencies_hz: list[float], floor_db: float, rng: int) -> np.ndarray:
    """Return tones over white noise, which any real reference has."""
    x = np.sum([tone(f, duration_s, fs=fs, phase_rad=f * rng) for f in frequencies_hz], axis=0)
    floor = np.random.default_rng(rng).standard_normal(x.size)
    return x + np.sqrt(np.mean(x**2)) * 10 ** (floor_db / 20) * floor


def _recording(duration_s: float, *, fs: float, seconds_apart: float, rng: int) -> np.ndarray:
    recording = _measured().noise
    return looped(recording - recording.mean(), duration_s, fs=fs, start_s=seconds_apart * rng)


def _measured() -> Any:
    measured = measured_data()
    if measured is None:
        raise LeftOut("needs the measured data: set KFOPC_DATA, or fetch them with python -m comparisons data")
    return measured


def _bandpass(fs: float, *, band_hz: list[float], primary_taps: int, secondary_taps: int) -> Plant:
    low, high = band_hz
    secondary, primary = (bandpass_path(n_taps, (low, high), fs=fs) for n_taps in (secondary_taps, primary_taps))
    return Plant(secondary, primary)


def _duct(fs: float) -> Plant:
    return duct_plant(fs=fs)


def _room(fs: float, *, loudspeakers: int) -> Plant:
    return built_in_room(loudspeakers)


def _band(duration_s: float, *, fs: float, band_hz: list[float], rng: int) -> np.ndarray:
    low, high = band_hz
    return band_limited_noise((low, high), duration_s, fs=fs, rng=rng)


def _compressor(duration_s: float, *, fs: float, rng: int) -> np.ndarray:
    return compressor_noise(duration_s, fs=fs, rng=rng)


NOISES: dict[str, Callable[..., np.ndarray]] = {
    "band": _band,
    "compressor": _compressor,
    "tones": _tones,
    "recorded motor": _recording,
}
PATHS: dict[str, Callable[..., Plant]] = {
    "band-pass": _bandpass,
    "duct": _duct,
    "room": _room,
    "measured duct": lambda fs: of_unit_gain(_measured()),
}


# ---- From a file to a task


def read_task(path: Path) -> Task:
    """Return the task of a file; raise `LeftOut` if this machine lacks its data."""
    return _made(_task, _definition(path), path.name, path=path)


def _definition(path: Path) -> dict[str, Any]:
    """Return what a file says, with what it leaves out as in the task that it is `like`."""
    own = tomllib.loads(path.read_text(encoding="utf-8"))
    return _definition(FOLDER / f"{own.pop('like')}.toml") | own if "like" in own else own


def _made(make: Callable[..., Any], table: Mapping[str, Any], where: str, **own: Any) -> Any:
    """Return what a function makes of a table and of `own` values; refuse unknown and missing keys."""
    keys = {name: one.default is one.empty for name, one in signature(make).parameters.items() if name not in own}
    unknown = ", ".join(sorted(table.keys() - keys))
    missing = ", ".join(name for name, needed in keys.items() if needed and name not in table)
    if unknown or missing:
        known = ", ".join(name if needed else f"{name} (optional)" for name, needed in keys.items())
        wrong = f"has the unknown key {unknown}" if unknown else f"lacks {missing}"
        raise ValueError(f"{where} {wrong}; its keys are {known or 'none'}")
    return make(**table, **own)


def _of_model(models: Mapping[str, Callable[..., Any]], table: Mapping[str, Any], where: str, **own: Any) -> Any:
    """Return what the model that a table names makes of the rest of the table."""
    settings = dict(table)
    model = as_choice(settings.pop("model", None), f"{where}: model", models)
    return _made(models[model], settings, f"{where}, model {model}", **own)


def _task(
    path: Path,
    title: str,
    fs: float,
    duration_s: float,
    n_taps: int,
    block: int,
    rated_power: float,
    needed_power: float,
    signals_sha256: str,
    paths: Mapping[str, Any],
    noise: Mapping[str, Any],
    change: str = "nothing",
    changed_at_s: float = 0.0,
    path_error: float | None = None,
    averaging_s: float = DEFAULT_AVERAGING_S,
    other_packages: bool = True,
) -> Task:
    plant = _of_model(PATHS, paths, f"{path.name}, [paths]", fs=fs)
    own = {"duration_s": duration_s, "fs": fs}
    noises = {seed: _of_model(NOISES, noise, f"{path.name}, [noise]", rng=seed, **own) for seed in SEEDS}
    changed, at = CHANGES[as_choice(change, f"{path.name}: change", CHANGES)], round(changed_at_s * fs)
    delayed = Plant(np.pad(plant.secondary, ((0, 0), (0, 0), (block, 0))), plant.primary, fs=fs)
    scene = make_scene(
        noises,
        delayed,
        rated_power=rated_power,
        power_multiple=needed_power,
        n_taps=n_taps,
        switch_on_s=0.0,
        sensor_noise_db=SENSOR_NOISE_DB,
        nse_window_s=NSE_WINDOW_S,
    )
    sound = [changed.noise(x, at, fs) for x in scene.references]
    told = {
        "references": sound,
        "disturbances": [changed.disturbance(delayed.disturbance(x), at, fs) for x in sound],
        "secondary_path_uncertainty": path_error,
        "averaging_s": averaging_s,
    }
    task = Task(
        **vars(scene) | told,
        name=path.stem,
        title=title if change == "nothing" else f"{title}; at {changed_at_s:g} s: {change}",
        digest=digest_of(path),
        block=block,
        primary=plant.primary,
        change=changed,
        changed_at_s=changed_at_s,
        other_packages=other_packages,
    )
    signals = [plant.primary, plant.secondary, *noises.values()]
    if change != "nothing":
        later = changed.plant(delayed, changed_at_s).at(duration_s).secondary
        signals += [
            np.concatenate([delayed.secondary, later], axis=-1),
            *task.references,
            *task.heard,
            *task.disturbances,
        ]
    _require_same_signals(path, signals_sha256, signals)
    return task


def digest_of(path: Path) -> str:
    """Return the hash of a definition, regardless of comments and spaces."""
    definition = json.dumps(_definition(path), sort_keys=True)
    return hashlib.sha256(definition.encode()).hexdigest()[:12]


def _require_same_signals(path: Path, expected: str, signals: list[np.ndarray]) -> None:
    digest = hashlib.sha256()
    for signal in signals:
        digest.update(np.round(signal / np.sqrt(np.mean(signal**2)), DECIMALS).astype("<f4").tobytes())
    if digest.hexdigest() != expected:
        raise ValueError(
            f"{path.name} was made for other signals: their hash is {digest.hexdigest()}, not {expected}. If a model "
            "was changed on purpose, write this hash into the file; earlier scores are then not comparable"
        )
