"""The grid of a sweep: its axes, the values of each, and the runs that they make with the seeds."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from kfopc_filterpy.bench import algorithms

from ..studies.cases import made_noises, measured_data, modelled_paths, noises, paths

Values = dict[str, Any]  # one value an axis

AMPLIFIERS = ("linear", "hard clip", "soft")
DEFAULT_SETTING, TUNED_SETTING = "default", "tuned"


@dataclass(frozen=True)
class Axis:
    """An axis that can be swept: how a value is checked, and its name in figures."""

    name: str
    label: str
    default: Any
    check: Callable[[Any, str], Any]
    help: str

    @property
    def option(self) -> str:
        """Option on the command line."""
        return "--" + self.name.replace("_", "-")


@dataclass(frozen=True)
class Run:
    """One run of a sweep: its number, its cell, its seed, and the values of the axes."""

    index: int
    cell: int
    seed: int
    values: Values

    @property
    def scenario(self) -> Values:
        """Values of the axes and the seed."""
        return self.values | {"seed": self.seed}


@dataclass(frozen=True)
class Grid:
    """Values of each axis, and seeds: every combination is a cell, with a run for each seed."""

    axes: dict[str, tuple[Any, ...]]
    seeds: tuple[int, ...]

    def cells(self) -> list[Values]:
        """Return the combinations; the last axis changes fastest."""
        return [dict(zip(self.axes, values, strict=True)) for values in product(*self.axes.values())]

    def runs(self) -> Iterator[Run]:
        """Yield all runs, numbered; the seed changes fastest."""
        count = len(self.seeds)
        for i, values in enumerate(self.cells()):
            for k, seed in enumerate(self.seeds):
                yield Run(i * count + k, i, seed, values)

    @property
    def swept(self) -> list[str]:
        """Axes of more than one value."""
        return [name for name, values in self.axes.items() if len(values) > 1]

    def __len__(self) -> int:
        return math.prod(len(values) for values in self.axes.values()) * len(self.seeds)


def built_in_grid(axes: Mapping[str, Any], seeds: Any) -> Grid:
    """Return a grid of the built-in scenario; axes that are not named have their default.

    Raises
    ------
    ValueError, TypeError
        An axis, a name or a number that is not as described.
    """
    unknown = [str(name) for name in axes if name not in AXES]
    if unknown:
        raise ValueError(f"no axis called {', '.join(unknown)}; there are {', '.join(AXES)}")
    checked = {}
    for name, axis in AXES.items():
        given = _listed(axes.get(name, axis.default), name)
        checked[name] = _different(tuple(axis.check(value, name) for value in given), name)
    two = [name for name in checked["algorithm"] if algorithms()[name].second]
    if two and checked["setting"] != (TUNED_SETTING,):
        raise ValueError(
            f'{", ".join(two)} has two settings, of which the second decides the output power: give setting "{TUNED_SETTING}"'
        )
    return Grid(checked, as_seeds(seeds))


def own_grid(axes: Mapping[str, Any], seeds: Any) -> Grid:
    """Return a grid of the user's scenario function: any axes, of numbers, strings, booleans or None."""
    if not axes:
        raise ValueError("grid must have at least one axis, got none")
    checked = {}
    for name, given in axes.items():
        if not isinstance(name, str) or not name or name == "seed":
            raise ValueError(f'an axis must have a name, and not be called "seed": got {name!r}')
        checked[name] = _different(tuple(_plain(value, name) for value in _listed(given, name)), name)
    return Grid(checked, as_seeds(seeds))


def as_seeds(seeds: Any) -> tuple[int, ...]:
    """Return the seeds 1 to n of a number n, or those of a sequence."""
    if np.ndim(seeds) == 0:
        return tuple(range(1, as_whole(seeds, "seeds") + 1))
    return _different(tuple(as_whole(seed, "seeds", least=0) for seed in _listed(seeds, "seeds")), "seeds")


def _listed(given: Any, name: str) -> list[Any]:
    """Return the values of an axis as a list, even if there is one."""
    values = [given] if given is None or isinstance(given, str) or np.ndim(given) == 0 else list(given)
    if not values:
        raise ValueError(f"{name} must have at least one value, got an empty list")
    return values


def _different(values: tuple[Any, ...], name: str) -> tuple[Any, ...]:
    twice = [value for i, value in enumerate(values) if value in values[:i]]
    if twice:
        raise ValueError(f"{name} holds {twice[0]!r} twice")
    return values


def _plain(value: Any, name: str) -> Any:
    """Return a value that JSON can hold and give back."""
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{name} must hold finite numbers, got {value}")
    if not (value is None or isinstance(value, str | int | float | bool)):
        raise TypeError(f"{name} must hold numbers, strings, booleans or None, got {type(value).__name__}")
    return value


def as_whole(value: Any, name: str, least: int = 1) -> int:
    """Return a whole number that is not too small."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"{name} must be a whole number, got {value!r}")
    if value < least:
        raise ValueError(f"{name} must be at least {least}, got {value}")
    return int(value)


def _number(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise TypeError(f"{name} must be a number, got {value!r}")
    if not math.isfinite(value):
        raise ValueError(f"{name} must be a finite number, got {value}")
    return float(value)


def _positive(value: Any, name: str) -> float:
    number = _number(value, name)
    if number <= 0.0:
        raise ValueError(f"{name} must be above 0, got {number:g}")
    return number


def _setting(value: Any, name: str) -> Any:
    if not isinstance(value, str):
        return _positive(value, name)
    return _named(value, name, (DEFAULT_SETTING, TUNED_SETTING), 'a number above 0, "default" or "tuned"')


def _named(value: Any, name: str, choices: Sequence[str], expected: str = "") -> str:
    """Return the choice that a name means; hyphens for spaces and lower case are fine."""
    if isinstance(value, str):
        for choice in choices:
            if _folded(value) == _folded(choice):
                return choice
    raise ValueError(f"{name} must be {expected or 'one of ' + ', '.join(choices)}, got {value!r}")


def _folded(name: str) -> str:
    return name.strip().casefold().replace("-", " ").replace("_", " ")


def _path(value: Any, name: str) -> str:
    return _at_hand(value, name, tuple(modelled_paths()), "measured duct", lambda: paths().keys())


def _noise(value: Any, name: str) -> str:
    return _at_hand(value, name, tuple(made_noises()), "motor", lambda: noises().keys())


def _at_hand(value: Any, name: str, made: tuple[str, ...], measured: str, present: Callable[[], Any]) -> str:
    """Return one of the modelled choices, or the measured one if the data are at hand."""
    choice = _named(value, name, (*made, measured))
    if choice == measured and (measured_data() is None or choice not in present()):
        raise ValueError(f"{name} {choice!r} needs the measured data: set KFOPC_DATA to their folder")
    return choice


def _amplifier(value: Any, name: str) -> str:
    return _named(value, name, AMPLIFIERS)


def _algorithm(value: Any, name: str) -> str:
    return _named(value, name, tuple(algorithms()))


AXES: dict[str, Axis] = {
    axis.name: axis
    for axis in (
        Axis("path", "Paths", "duct", _path, "band-pass, duct, or measured duct if its data are at hand"),
        Axis("noise", "Noise", "band noise", _noise, f"{', '.join(made_noises())}, or motor if it is at hand"),
        Axis("duration_s", "Duration (s)", 4.0, _positive, "time under control in seconds"),
        Axis("n_taps", "Taps", 128, as_whole, "taps of the control filter"),
        Axis(
            "sensor_noise_db",
            "Sensor noise / disturbance (dB)",
            -40.0,
            _number,
            "sensor noise against the disturbance: minus the SNR",
        ),
        Axis("path_gain_db", "Gain error of the path (dB)", 0.0, _number, "gain error of the estimated secondary path"),
        Axis("path_delay", "Delay error of the path (samples)", 0.0, _number, "its delay error in samples"),
        Axis("path_phase_deg", "Phase error of the path (°)", 0.0, _number, "its phase error in degrees"),
        Axis(
            "algorithm",
            "Algorithm",
            "KF-OPC",
            _algorithm,
            ", ".join(algorithms()),
        ),
        Axis(
            "setting",
            "Setting: r E[x'²]/q, μ L E[x'²] or 1 - λ",
            DEFAULT_SETTING,
            _setting,
            "r E[x'^2]/q of a Kalman filter, mu L E[x'^2] of the LMS family, 1 - lambda of FxRLS; default: the middle of "
            "the grid that the studies tune on; tuned: the best of that grid by the studies' rule, on the first seed, "
            "and needed for algorithms of two settings",
        ),
        Axis(
            "rated_power_db",
            "Rated power / unconstrained control power (dB)",
            -10.0,
            _number,
            "rated power against the unconstrained control power",
        ),
        Axis("amplifier", "Amplifier", "linear", _amplifier, ", ".join(AMPLIFIERS)),
        Axis(
            "amplifier_limit_db",
            "Amplifier limit / peak of a sine at rated power (dB)",
            0.0,
            _number,
            "its amplitude limit against the peak of a sine at rated power",
        ),
    )
}
