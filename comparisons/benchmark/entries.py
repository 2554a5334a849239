"""The entries: the algorithms of this package, the rivals, and adaptive filters of other packages, used as installed.

Filters of other packages are made for system identification or for filtered-x LMS. Each is put into the structure that
its interface requires, has its own grid of settings, and is tuned by the rule for all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from importlib.metadata import version
from typing import Any

import numpy as np

from kfopc_filterpy import Plant
from kfopc_filterpy.bounds import wiener_solution

from ..bench import Algorithm, algorithms
from ..bench.registry import block_of
from ..rivals import FastArrayKalman, FrequencyDomainKalman, SubbandFxLMS, SubfilterKalman
from ..rivals.one_channel import OneChannel
from ..rivals.subfilters import band_subfilters
from .blocks import PlaysBlocks
from .tasks import Task

STEPS = (1.0, 0.25, 1 / 16, 1 / 64)  # fewer than for our own: a sample takes more than a hundred times as long
FORGOTTEN = (1e-5, 1e-4, 1e-3)
STATE_NOISES = (1e-7, 1e-6, 1e-5)
TRANSITIONS = (1e-5, 1e-4, 1e-3, 1e-2)
BANDS, BAND_STEPS = 32, (1e-3, 3e-3, 1e-2, 3e-2)  # of the subband FxLMS: fewer bands alias, larger steps diverge
DESIGN_S, DESIGN_RIDGE = 4.0, 1e-4  # of the white noise by which sub-filters are designed


class FilteredX(OneChannel):
    """A filter for system identification in the modified filtered-x structure: it identifies d^ = e + s^ * y from x'.

    Parameters
    ----------
    n_taps, secondary
        As for the controllers of the package.
    adapt : callable
        Adapts the filter to the newest n_taps samples of x', the newest first, and to d^.
    weights : callable
        Returns the filter's weights, (n_taps,), that of the newest sample first.
    """

    def __init__(
        self,
        n_taps: int,
        secondary: np.ndarray,
        adapt: Callable[[np.ndarray, float], Any],
        weights: Callable[[], np.ndarray],
    ) -> None:
        super().__init__(n_taps, secondary)
        self._adapt, self._weights = adapt, weights

    def control_signal(self, reference: float) -> float:
        """Return the control signal for the newest reference sample."""
        self.hear(reference)
        self.w = np.asarray(self._weights())
        return self.play()

    def update(self, error: float) -> None:
        """Let the filter adapt to the disturbance that the error reveals."""
        self._adapt(self.filtered[: self.w.size], self.disturbance(error))


# ---- Filters of other packages


def _padasip_nlms(n_taps: int, path: np.ndarray, *, step_size: float, regularization: float) -> FilteredX:
    from padasip.filters import FilterNLMS

    nlms = FilterNLMS(n_taps, mu=step_size, eps=regularization, w="zeros")
    return FilteredX(n_taps, path, lambda row, d: nlms.adapt(d, row), lambda: nlms.w)


def _padasip_rls(n_taps: int, path: np.ndarray, *, forgetting: float, initial_variance: float) -> FilteredX:
    from padasip.filters import FilterRLS

    rls = FilterRLS(n_taps, mu=forgetting, eps=1.0 / initial_variance, w="zeros")
    return FilteredX(n_taps, path, lambda row, d: rls.adapt(d, row), lambda: rls.w)


def _pyroomacoustics_nlms(n_taps: int, path: np.ndarray, *, step_size: float, regularization: float) -> FilteredX:
    from pyroomacoustics.adaptive import NLMS

    nlms = NLMS(n_taps, mu=step_size)

    def adapt(row: np.ndarray, d: float) -> None:
        if row.any():  # it has no regularization, and divides by the energy of the row
            nlms.update(row[0], d)

    return FilteredX(n_taps, path, adapt, lambda: nlms.w)


def _pyroomacoustics_rls(n_taps: int, path: np.ndarray, *, forgetting: float, initial_variance: float) -> FilteredX:
    from pyroomacoustics.adaptive import RLS

    rls = RLS(n_taps, lmbd=forgetting, delta=1.0 / initial_variance, dtype=np.float64)
    return FilteredX(n_taps, path, lambda row, d: rls.update(row[0], d), lambda: rls.w)


def _adafilt_nlms(n_taps: int, path: np.ndarray, *, step_size: float, regularization: float) -> FilteredX:
    from adafilt import LMSFilter

    lms = LMSFilter(n_taps, stepsize=step_size, epsilon_power=regularization)
    return FilteredX(n_taps, path, lambda row, d: lms.adapt(row[0], d - lms.w @ row), lambda: lms.w)


def _adafilt_rls(
    n_taps: int, path: np.ndarray, *, state_noise: float, measurement_noise: float, initial_variance: float
) -> FilteredX:
    from adafilt import RLSFilter

    rls = RLSFilter(
        n_taps,
        initial_covariance=initial_variance,
        meas_noise_var=measurement_noise,
        proc_noise_var=state_noise,
    )
    return FilteredX(n_taps, path, lambda row, d: rls.adapt(row[0], d - rls.w @ row), lambda: rls.w)


class AdafiltBlocks(PlaysBlocks):
    """adafilt's `MultiChannelBlockLMS`, which is filtered-x LMS in blocks for any number of channels."""

    def __init__(
        self, task: Task, n_taps: int, path: np.ndarray, *, step_size: float, regularization: float, **_: Any
    ) -> None:
        from adafilt import MultiChannelBlockLMS

        super().__init__(task)
        self._s = path if path.ndim == 3 else path.reshape(1, 1, -1)
        K, J, M = self._s.shape
        self._lms = MultiChannelBlockLMS(
            Nout=J,
            Nin=self.n_references,
            Nsens=K,
            length=n_taps,
            blocklength=task.block,
            stepsize=step_size,
            epsilon_power=2 * n_taps * regularization,  # of spectra of two filter lengths
        )
        self._past = np.zeros((self.n_references, M - 1))

    def exchange(self, references: np.ndarray, errors: np.ndarray) -> np.ndarray:
        """Return the control signals of a block, and adapt to its errors."""
        y = self._lms.filt(references.T).T
        x = np.concatenate((self._past, references), axis=1)
        filtered = [[[np.convolve(one, s, "valid") for one in x] for s in row] for row in self._s]
        self._past = x[:, references.shape[1] :]
        self._lms.adapt(np.moveaxis(np.array(filtered), -1, 0), errors.T)
        return y


# ---- How they are tuned


def _subfilters(task: Any, ratio: float, _: float) -> dict[str, Any]:
    """Design the sub-filters by white noise through the plant, as when a system is set up."""
    x = np.random.default_rng(0).standard_normal(round(DESIGN_S * task.fs))
    plant = Plant(task.secondary, task.primary, fs=task.fs)
    design = wiener_solution(x, plant, n_taps=task.n_taps, regularization=DESIGN_RIDGE)
    q = task.measurement_noise
    return {
        "subfilters": band_subfilters(design.weights),
        "state_noise": ratio * q / float(np.mean(task.disturbances[0] ** 2)),
        "measurement_noise": q,
        "rated_power": task.rated_power,
        "fs": task.fs,
    }


def _fast_array(task: Any, forgotten: float, _: float) -> dict[str, Any]:
    return {"forgetting": 1.0 - forgotten, "initial_variance": task.initial_variance / task.measurement_noise}


def _frequency_kalman(task: Any, lost: float, _: float) -> dict[str, Any]:
    return {
        "block_size": block_of(task),
        "transition": 1.0 - lost,
        "initial_variance": task.n_taps * task.initial_variance,  # of a bin
    }


def _subbands(task: Any, mu: float, _: float) -> dict[str, Any]:
    return {"step_size": mu, "n_bands": BANDS}


def _with_task(settings: Any) -> Any:
    return lambda task, first, second: settings(task, first, second) | {"task": task}


def rivals() -> dict[str, Algorithm]:
    """Return the entries of `comparisons.rivals` that are not in the registry."""
    return {
        "fast-array KF": Algorithm(
            FastArrayKalman, _fast_array, "1 - lambda", "1 - lambda", (0.0, *FORGOTTEN), keeps_budget=False
        ),
        "subband FxLMS": Algorithm(SubbandFxLMS, _subbands, "mu of a band", "mu", BAND_STEPS, keeps_budget=False),
        "frequency-domain KF": Algorithm(
            FrequencyDomainKalman, _frequency_kalman, "1 - A", "1 - A", TRANSITIONS, keeps_budget=False
        ),
        "sub-filter KF": Algorithm(SubfilterKalman, _subfilters, "ratio", "r E[d^2]/q", STATE_NOISES),
    }


def peers() -> dict[str, Algorithm]:
    """Return the entries of the other packages, named by package, version and filter."""
    own = algorithms()
    nlms, rls, kalman = (
        replace(own[name], first=grid, knows_amplifier=False, shares_gains=False, several_channels=False)
        for name, grid in (("FxNLMS", STEPS), ("FxRLS", FORGOTTEN), ("KF-ANC", STATE_NOISES))
    )
    blocks = replace(
        nlms,
        make=lambda n_taps, path, task, **settings: AdafiltBlocks(task, n_taps, path, **settings),
        settings=_with_task(nlms.settings),
        several_channels=True,
    )
    made = {
        ("padasip", "NLMS"): replace(nlms, make=_padasip_nlms),
        ("padasip", "RLS"): replace(rls, make=_padasip_rls),
        ("pyroomacoustics", "NLMS"): replace(nlms, make=_pyroomacoustics_nlms),
        ("pyroomacoustics", "RLS"): replace(rls, make=_pyroomacoustics_rls),
        ("adafilt", "NLMS"): replace(nlms, make=_adafilt_nlms),
        ("adafilt", "RLS"): replace(kalman, make=_adafilt_rls),
        ("adafilt", "block FxLMS"): blocks,
    }
    return {f"{package} {version(package)} {name}": own for (package, name), own in made.items()}


def entries_for(task: Task, further: Mapping[str, Algorithm | str]) -> dict[str, Algorithm | str]:
    """Return the registry's entries and the `further` ones that take the channels of a task; commands take any."""
    several = task.secondary.ndim == 3
    fit = {name: own for name, own in further.items() if not several or getattr(own, "several_channels", True)}
    return {**algorithms(several_channels=several), **fit}
