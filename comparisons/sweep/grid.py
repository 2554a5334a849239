"""The grid of a sweep: its axes, the values of each, and the runs that they make with the seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from kfopc_filterpy import HardClipAmplifier, SoftSaturationAmplifier
from kfopc_filterpy._validate import as_count, as_number, as_positive

from ..bench import algorithms
from ..studies.cases import made_noises, measured_data, modelled_paths

AMPLIFIERS: dict[str, Callable[[float], Any]] = {  # of the amplitude limit
    "linear": lambda limit: None,
    "hard clip": HardClipAmplifier,
    "soft": SoftSaturationAmplifier,
}
DEFAULT_SETTING, TUNED_SETTING = "default", "tuned"
MEASURED_PATH, MEASURED_NOISE = "measured duct", "motor"

Values = dict[str, Any]  # the value of each axis, and of a run the seed


@dataclass(frozen=True)
class Axis:
    """An axis of the built-in scenario: its name in figures, its default, and what its values may be."""

    label: str
    default: Any
    choices: tuple[str, ...] = ()
    number: Callable[[Any, str], Any] | None = None

    def checked(self, value: Any, name: str) -> Any:
        """Return a number, or the choice that a string means; hyphens for spaces and lower case are fine."""
        if not isinstance(value, str) and self.number is not None:
            return self.number(value, name)
        for choice in self.choices:
            if isinstance(value, str) and _folded(value) == _folded(choice):
                return choice
        expected = ("a number",) if self.number else ()
        raise ValueError(f"{name} must be one of {', '.join(self.choices + expected)}, got {value!r}")


def _folded(name: str) -> str:
    return name.strip().casefold().replace("-", " ").replace("_", " ")


AXES = {
    "path": Axis("Paths", "duct", (*modelled_paths(), MEASURED_PATH)),
    "noise": Axis("Noise", "band noise", (*made_noises(), MEASURED_NOISE)),
    "duration_s": Axis("Time under control (s)", 4.0, number=as_positive),
    "n_taps": Axis("Taps", 128, number=as_count),
    "sensor_noise_db": Axis("Sensor noise / disturbance (dB)", -40.0, number=as_number),
    "path_gain_db": Axis("Gain error of the estimated path (dB)", 0.0, number=as_number),
    "path_delay": Axis("Delay error of the estimated path (samples)", 0.0, number=as_number),
    "path_phase_deg": Axis("Phase error of the estimated path (°)", 0.0, number=as_number),
    "algorithm": Axis("Algorithm", "KF-OPC", tuple(algorithms())),
    "setting": Axis(
        "Setting: r E[x'²]/q, μ L E[x'²] or 1 - λ", DEFAULT_SETTING, (DEFAULT_SETTING, TUNED_SETTING), as_positive
    ),
    "rated_power_db": Axis("Rated power / unconstrained control power (dB)", -10.0, number=as_number),
    "amplifier": Axis("Amplifier", "linear", tuple(AMPLIFIERS)),
    "amplifier_limit_db": Axis("Amplifier limit / peak of a sine at rated power (dB)", 0.0, number=as_number),
}


@dataclass(frozen=True)
class Grid:
    """Values of each axis, and seeds: every combination is a cell, with a run for each seed."""

    axes: dict[str, tuple[Any, ...]]
    seeds: tuple[int, ...]

    def cells(self) -> list[Values]:
        """Return the combinations; the last axis changes fastest."""
        return [dict(zip(self.axes, values, strict=True)) for values in product(*self.axes.values())]

    def runs(self) -> list[Values]:
        """Return the combinations with each seed; the seed changes fastest."""
        return [cell | {"seed": seed} for cell in self.cells() for seed in self.seeds]

    @property
    def swept(self) -> list[str]:
        """Axes of more than one value."""
        return [name for name, values in self.axes.items() if len(values) > 1]


def built_in_grid(axes: Mapping[str, Any], seeds: Any) -> Grid:
    """Return a grid of the built-in scenario; axes that are not named have their default."""
    unknown = [str(name) for name in axes if name not in AXES]
    if unknown:
        raise ValueError(f"no axis called {', '.join(unknown)}; there are {', '.join(AXES)}")
    checked = {name: _distinct(axes.get(name, axis.default), name, axis.checked) for name, axis in AXES.items()}
    if (MEASURED_PATH in checked["path"] or MEASURED_NOISE in checked["noise"]) and measured_data() is None:
        raise ValueError(f"{MEASURED_PATH} and {MEASURED_NOISE} need the measured data: set KFOPC_DATA to their folder")
    two = [name for name in checked["algorithm"] if algorithms()[name].second]
    if two and checked["setting"] != (TUNED_SETTING,):
        raise ValueError(f'{", ".join(two)} has two settings, so they must be tuned: give setting "{TUNED_SETTING}"')
    return Grid(checked, _seeds(seeds))


def own_grid(axes: Mapping[str, Any], seeds: Any) -> Grid:
    """Return a grid of the user's scenario function, of any axes."""
    if not axes or not all(isinstance(name, str) and name != "seed" for name in axes):
        raise ValueError(f'grid must have at least one axis, and none called "seed", got {list(axes)}')
    return Grid({name: _distinct(given, name, _plain) for name, given in axes.items()}, _seeds(seeds))


def _seeds(seeds: Any) -> tuple[int, ...]:
    """Return the seeds 1 to n of a number n, or those of a sequence."""
    if np.ndim(seeds) == 0:
        return tuple(range(1, as_count(seeds, "seeds") + 1))
    return _distinct(seeds, "seeds", partial(as_count, minimum=0))


def _distinct(given: Any, name: str, check: Callable[[Any, str], Any]) -> tuple[Any, ...]:
    """Return the checked values of an axis, one or several."""
    values = tuple(check(value, name) for value in ([given] if np.ndim(given) == 0 else given))
    if not values or len(set(values)) < len(values):
        raise ValueError(f"{name} must have at least one value, and none twice, got {given!r}")
    return values


def _plain(value: Any, name: str) -> Any:
    """Return a value that JSON can hold and give back."""
    value = value.item() if isinstance(value, np.generic) else value
    if not (value is None or isinstance(value, str | int | float)):
        raise TypeError(f"{name} must hold numbers, strings, booleans or None, got {type(value).__name__}")
    return as_number(value, name) if isinstance(value, float) else value
