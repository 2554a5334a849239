"""The figures of merit: what each is, and how it is computed from the runs of an algorithm, in one list."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kfopc_filterpy import SimulationResult, metrics
from kfopc_filterpy._writing import jsonable
from kfopc_filterpy.verdict.items import Table

from .scene import Scene

Results = Sequence[SimulationResult]


@dataclass(frozen=True)
class Merit:
    """A figure of merit: its heading in tables, what it is, and a function of runs, scene and a tone's frequency in Hz."""

    heading: str
    about: str
    of: Callable[[Results, Scene, float | None], float | None]


def _of_control(measure: Callable[..., float]) -> Callable[[Results, Scene, float | None], float]:
    """Return the mean over the runs of a figure of the control signal, of the loudspeaker for which it is largest."""

    def of(results: Results, scene: Scene, tone_hz: float | None) -> float:
        scale = np.sqrt(scene.rated_power) if np.ndim(scene.rated_power) else np.ones(())
        own = (measure(r.control_signal / scale[..., np.newaxis], scene.amplitude_limit / scale) for r in results)
        return float(np.mean([np.max(one) for one in own]))

    return of


def _convergence(results: Results, scene: Scene, tone_hz: float | None) -> float:
    errors, disturbances = np.array([r.error for r in results]), np.array([r.disturbance for r in results])
    return metrics.convergence_time_s(errors, disturbances, scene.fs, window_s=scene.nse_window_s, runs=True)


def _harmonics(results: Results, scene: Scene, tone_hz: float | None) -> float | None:
    if tone_hz is None:
        return None
    return float(np.mean([metrics.harmonics_db(r.error, r.disturbance, tone_hz, scene.fs) for r in results]))


MERITS: dict[str, Merit] = {
    "noise_reduction_db": Merit(
        "noise reduction (dB)",
        "energy of the disturbance over that of the error",
        lambda results, scene, tone_hz: float(np.mean([r.noise_reduction_db for r in results])),
    ),
    "output_power": Merit(
        "output power",
        "mean square of the control signal before the amplifier; the rated power is its limit",
        _of_control(lambda y, limit: metrics.output_power(y)),
    ),
    "peak_control_signal": Merit(
        "peak", "largest magnitude of the control signal", _of_control(lambda y, limit: metrics.peak_control_signal(y))
    ),
    "clipped_fraction": Merit(
        "clipped",
        "share of the control signal beyond the amplifier's limit, or with a linear amplifier beyond the peak of a sine at "
        "rated power",
        _of_control(metrics.clipped_fraction),
    ),
    "harmonics_db": Merit(
        "harmonics (dB)",
        "power at 2 to 10 times a tone's frequency in the error, over the tone in the disturbance",
        _harmonics,
    ),
    "convergence_time_s": Merit(
        "converged (s)",
        "first time from which the normalised squared error stays within 3 dB of its steady value",
        _convergence,
    ),
    "diverged_at_s": Merit(
        "diverged (s)",
        "time at which the control signal passed a million times the root of the controller's rated power, 1 if it has "
        "none, and the run was stopped",
        lambda results, scene, tone_hz: min(
            (r.diverged_at_s for r in results if r.diverged_at_s is not None), default=None
        ),
    ),
}


def figures_of_merit(results: Results, scene: Scene, *, tone_hz: float | None = None) -> dict[str, float | None]:
    """Return the figures of merit of one algorithm: means over seeds, the NSE pooled over seeds.

    With several loudspeakers, the figures of the control signal are those of the loudspeaker for which they are largest
    over its rating: powers over the rated power, peaks over its root. With several microphones, the errors are taken
    together.

    Parameters
    ----------
    results : sequence of SimulationResult
        Runs of the algorithm, one for each seed.
    scene : Scene
        Scene of the runs.
    tone_hz : float, optional
        Frequency of a tone whose harmonics are measured.

    Returns
    -------
    dict of str to float or None
        A value for each key of `MERITS`; None if undefined.

    Examples
    --------
    >>> from comparisons.bench import figures_of_merit, make_controller, make_scene
    >>> from kfopc_filterpy import Plant
    >>> from kfopc_filterpy.signals import tone
    >>> plant = Plant([0, 1.0], [0, 0, 1.0], fs=8000)
    >>> scene = make_scene({0: tone(400.0, 1.0, fs=8000)}, plant, rated_power=1.0, power_multiple=2.0, n_taps=8)
    >>> figures = figures_of_merit([scene.run(make_controller(scene, "KF-OPC", 1e-6))], scene)
    >>> round(figures["output_power"], 2)
    1.0
    """
    return {key: merit.of(results, scene, tone_hz) for key, merit in MERITS.items()}


def merit_table(algorithms: Mapping[str, Mapping[str, float | None]], rated_power: float) -> Table:
    """Return the figures of merit of each algorithm, without columns that say nothing; the power also over the rated one."""
    columns: dict[str, list[float]] = {}
    for key, merit in MERITS.items():
        values = [np.nan if (value := jsonable(own.get(key))) is None else float(value) for own in algorithms.values()]
        columns[merit.heading] = values
        if key == "output_power":
            columns["of the rated power"] = [value / rated_power for value in values]
    kept = {heading: values for heading, values in columns.items() if not np.all(np.isnan(values))}
    rows: list[list[str | float]] = [
        [name, *(values[i] for values in kept.values())] for i, name in enumerate(algorithms)
    ]
    return Table("merit", "Figures of merit", ["algorithm", *kept], rows)
