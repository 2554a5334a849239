"""One run with settings that a reader plays with: noise, rating, path and algorithm in, spectra and powers out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from kfopc_filterpy import SimulationResult, bandpass_path, clipped_fraction, noise_reduction_db, output_power
from kfopc_filterpy._validate import as_band, as_choice, as_nonnegative, as_number, as_positive, as_signal
from kfopc_filterpy.bounds import power_constrained_solution
from kfopc_filterpy.paths import PathTolerance, path_taps, perturbed_path
from kfopc_filterpy.paths.models import sampling_rate
from kfopc_filterpy.signals import band_limited_noise, has_dataset, load_measured_duct

from .registry import REGISTRY, make_controller
from .scene import Scene, louder, make_scene, reachable_weights, with_clipping

ALGORITHMS = ("KF-PB", "KF-OPC", "KF-ANC", "MOV-FxLMS", "FxLMS")
N_TAPS = 128
DURATION_S = 3.5
SWITCH_ON_S = 0.5
SHORTEST_S = 1.0  # of a recording
MOST_FS = 16000.0  # files with a higher rate are resampled, so that a run takes a fraction of a second
ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class AcousticSetup:
    """Paths, and a recorded noise or none.

    Parameters
    ----------
    name : str
        Name in the page's list.
    primary, secondary : array_like, shape (n_taps,)
        Taps of the primary path and of the secondary path, see `paths.read_path`.
    fs : float
        Sampling frequency in Hz, also that of recordings.
    noise : array_like, shape (n_samples,), optional
        Recording of the reference microphone, of which the first 3.5 s are used; at least 1 s. By default Gaussian noise.

    Raises
    ------
    ValueError, TypeError
        A signal that is empty, not finite, not one-dimensional or sampled at another rate, a recording that is silent or
        shorter than 1 s, or fs not above 0.

    Examples
    --------
    >>> from kfopc_filterpy.bench import AcousticSetup
    >>> AcousticSetup("a wire", primary=[0, 0, 1.0], secondary=[0, 1.0], fs=8000).level_db
    0.0
    """

    name: str
    primary: Any
    secondary: Any
    fs: float
    noise: Any = None

    def __post_init__(self) -> None:
        fs = as_positive(self.fs, "fs", unit="Hz")
        object.__setattr__(self, "fs", fs)
        for name in ("primary", "secondary") if self.noise is None else ("primary", "secondary", "noise"):
            sampling_rate(getattr(self, name), fs, name=name)
            object.__setattr__(self, name, as_signal(getattr(self, name), name))
        if self.noise is None:
            return
        noise = self.noise
        if noise.size < SHORTEST_S * fs:
            raise ValueError(f"noise must last {SHORTEST_S:g} s at least, got {noise.size / fs:.3g} s: record longer")
        if not np.any(noise[: int(DURATION_S * fs)]):
            raise ValueError(f"noise is silent in its first {DURATION_S:g} s: cut the silence off, or record it again")
        object.__setattr__(self, "noise", noise[: int(DURATION_S * fs)])

    @property
    def level_db(self) -> float:
        """Power of the disturbance in dB re 1: of the recording as it is; 0 without one."""
        if self.noise is None:
            return 0.0
        return float(10 * np.log10(np.mean(np.convolve(self.noise, self.primary)[: self.noise.size] ** 2)))


@dataclass(frozen=True)
class ExploreSettings:
    """Settings of `explore`.

    Parameters
    ----------
    algorithm : {"KF-PB", "KF-OPC", "KF-ANC", "MOV-FxLMS", "FxLMS"}, default "KF-PB"
        Algorithm, by its name in the registry.
    rating_db : float, default -6.0
        Rated power in dB.
    rating_is_relative : bool, default True
        Whether `rating_db` is relative to the control power that the noise takes without a limit, or to 1.
    level_db : float, default 0.0
        Power of the disturbance at the error microphone in dB re 1.
    band : (float, float), default (200.0, 2000.0)
        Band of the noise in Hz.
    path_error_samples : float, default 0.0
        Delay in samples by which the true secondary path is longer than the one that the controller knows.
    path_tolerance_samples : float, default 1.0
        Error of that delay which KF-PB takes account of. The other algorithms do not use it.
    state_noise : float, default 1e-7
        State noise r of KF-OPC and KF-ANC, as r E[x'^2]/q.
    step_size : float, default 0.03125
        Step size mu of the LMS algorithms, as mu L E[x'^2].
    clips : bool, default True
        Whether the amplifier clips at the peak of a sine of rated power, or is linear.

    Raises
    ------
    ValueError, TypeError
        A setting out of its range.

    Examples
    --------
    >>> from kfopc_filterpy.bench import ExploreSettings
    >>> ExploreSettings(algorithm="FxLMS", rating_db=-10.0).algorithm
    'FxLMS'
    """

    algorithm: str = "KF-PB"
    rating_db: float = -6.0
    rating_is_relative: bool = True
    level_db: float = 0.0
    band: tuple[float, float] = (200.0, 2000.0)
    path_error_samples: float = 0.0
    path_tolerance_samples: float = 1.0
    state_noise: float = 1e-7
    step_size: float = 2.0**-5
    clips: bool = True

    def __post_init__(self) -> None:
        as_choice(self.algorithm, "algorithm", ALGORITHMS)
        for name in ("rating_db", "level_db"):
            as_number(getattr(self, name), name, unit="dB")
        for name in ("path_error_samples", "path_tolerance_samples"):
            as_nonnegative(getattr(self, name), name)
        for name in ("state_noise", "step_size"):
            as_positive(getattr(self, name), name)


@dataclass(frozen=True, eq=False)
class ExploreResult:
    """What a run of `explore` left.

    Attributes
    ----------
    settings : ExploreSettings
        Settings of the run.
    run : SimulationResult
        The run from switch-on; its signals that depend on the controller are NaN after a divergence.
    rated_power, full_power : float
        Rated power, and the control power that this noise takes without a limit; mean squares.
    noise_reduction_db : float
        Noise reduction over the steady half in dB.
    output_power : float
        Power of the control signal over the steady half.
    clipped_fraction : float
        Share of that time in which the control signal is beyond the clipping limit.
    bound_db, free_db : float
        Noise reductions of the best fixed filter of this length: within the rated power, and with unlimited power.
    """

    settings: ExploreSettings
    run: SimulationResult
    rated_power: float
    full_power: float
    noise_reduction_db: float
    output_power: float
    clipped_fraction: float
    bound_db: float
    free_db: float

    @property
    def amplitude_limit(self) -> float:
        """Peak of a sine at rated power, at which the amplifier clips."""
        return float(np.sqrt(2 * self.rated_power))

    @property
    def summary(self) -> str:
        """What the run shows, in words."""
        name = self.settings.algorithm
        if self.run.diverged_at_s is not None:
            return f"{name} diverged {self.run.diverged_at_s:.3f} s after it was switched on."
        change = f"reduces the noise by {self.noise_reduction_db:.1f} dB"
        if self.noise_reduction_db < 0.0:
            change = f"makes the noise {-self.noise_reduction_db:.1f} dB louder"
        share = self.output_power / self.rated_power
        within = "within" if share <= 1.05 else "far beyond" if share > 2.0 else "beyond"
        return (
            f"{name} {change}, {within} the rated power: it asks for {share:.3g} times that power, and "
            f"{100 * self.clipped_fraction:.0f} % of its samples are beyond the peak. The best fixed filter of {N_TAPS} taps "
            f"would reach {self.bound_db:.1f} dB within the rated power without clipping, and {self.free_db:.1f} dB without "
            "any limit."
        )


def explore_setups() -> list[AcousticSetup]:
    """Return the setups that need no files: the paper's band-pass paths, and the measured duct if its files are here.

    The duct's files are those of `signals.load_measured_duct`; they are never fetched.

    Returns
    -------
    list of AcousticSetup
        The setups, at 16 kHz.

    Raises
    ------
    DataUnavailableError
        A file of the duct that is not the published one.

    Examples
    --------
    >>> from kfopc_filterpy.bench import explore_setups
    >>> explore_setups()[0].name
    'Band-pass paths'
    """
    fs = MOST_FS
    primary, secondary = (path_taps(bandpass_path(n, fs=fs)) for n in (128, 32))
    setups = [AcousticSetup("Band-pass paths", primary, secondary, fs)]
    for noise in ("motor", "compressor"):
        if has_dataset("duct") and has_dataset(noise):
            duct = load_measured_duct(noise=noise)
            if len(setups) == 1:
                setups.append(AcousticSetup("Measured duct", duct.primary, duct.secondary, duct.fs))
            setups.append(AcousticSetup(f"Measured duct, {noise}", duct.primary, duct.secondary, duct.fs, duct.noise))
    return setups


def explore(setup: AcousticSetup, settings: ExploreSettings | None = None) -> ExploreResult:
    """Run one algorithm on the noise of a setup, and return what there is to see and hear.

    The control filter has 128 taps. The noise runs for 0.5 s before the control is switched on. As in the studies, the
    sensor noise is 60 dB below the disturbance, and q is the estimate of eq. 7, with what an amplifier clips off.

    Parameters
    ----------
    setup : AcousticSetup
        Paths and noise.
    settings : ExploreSettings, optional
        Settings; by default those of the class.

    Returns
    -------
    ExploreResult
        The run and its figures of merit.

    Raises
    ------
    ValueError
        A band beyond fs/2, or in which the recording is silent.

    Examples
    --------
    >>> from kfopc_filterpy.bench import ExploreSettings, explore, explore_setups
    >>> result = explore(explore_setups()[0], ExploreSettings(rating_db=-6.0))
    >>> print(f"{result.rated_power / result.full_power:.2f} of the power of full control")
    0.25 of the power of full control
    >>> bool(3.0 < result.noise_reduction_db < result.bound_db), bool(result.output_power < 1.02 * result.rated_power)
    (True, True)
    """
    settings = settings or ExploreSettings()
    scene = _normalised_scene(setup, as_band(settings.band, setup.fs))
    scene = louder(scene, float(np.sqrt(10 ** (settings.level_db / 10) / np.mean(scene.settled[1] ** 2))))
    full = float(scene.unconstrained_power)
    rated = 10 ** (settings.rating_db / 10) * (full if settings.rating_is_relative else 1.0)
    scene = replace(scene, rated_power=rated)
    if settings.clips:
        scene = with_clipping(scene)
    scene = replace(
        scene,
        secondary=_true_path(setup, settings.path_error_samples),
        secondary_estimate=scene.secondary,
        secondary_path_uncertainty=PathTolerance(delay_samples=settings.path_tolerance_samples),
    )
    own = REGISTRY[settings.algorithm]
    setting = {"r": settings.state_noise, "mu": settings.step_size}.get(own.symbol, own.first[0])
    run = scene.run(make_controller(scene, settings.algorithm, setting))
    with reachable_weights():
        bound = power_constrained_solution(*scene.settled, scene.secondary, N_TAPS, rated)
    return ExploreResult(
        settings=settings,
        run=run,
        rated_power=rated,
        full_power=full,
        noise_reduction_db=noise_reduction_db(run.error, run.disturbance),
        output_power=output_power(run.control_signal),
        clipped_fraction=clipped_fraction(run.control_signal, scene.amplitude_limit),
        bound_db=bound.noise_reduction_db,
        free_db=scene.wiener_noise_reduction_db,
    )


@lru_cache(maxsize=16)
def _normalised_scene(setup: AcousticSetup, band: tuple[float, float]) -> Scene:
    """Return the scene of a noise and a band whose full control takes a power of 1.

    It is what takes long of a run, and level and rating only scale it.
    """
    return make_scene(
        {0: _noise(setup, band)},
        setup.primary,
        setup.secondary,
        fs=setup.fs,
        rated_power=1.0,
        power_multiple=1.0,
        n_taps=N_TAPS,
        switch_on_s=SWITCH_ON_S,
    )


def _noise(setup: AcousticSetup, band: tuple[float, float]) -> np.ndarray:
    """Return the reference of a setup, nothing outside the band."""
    if setup.noise is None:
        return band_limited_noise(band, DURATION_S, fs=setup.fs, rng=0)
    spectrum = np.fft.rfft(setup.noise)
    frequencies = np.fft.rfftfreq(setup.noise.size, 1 / setup.fs)
    inside = (frequencies >= band[0]) & (frequencies <= band[1])
    if np.linalg.norm(spectrum[inside]) <= ROUNDING * np.linalg.norm(spectrum):
        raise ValueError(f"the recording is silent from {band[0]:g} to {band[1]:g} Hz: choose a wider band")
    return np.fft.irfft(np.where(inside, spectrum, 0.0), setup.noise.size)


@lru_cache(maxsize=64)
def _true_path(setup: AcousticSetup, delay_samples: float) -> np.ndarray:
    """Return the secondary path with a longer delay; a fraction of a sample is a fit, which takes long for long paths."""
    if delay_samples == 0.0:
        return setup.secondary
    return path_taps(perturbed_path(setup.secondary, delay_samples=delay_samples, fs=setup.fs))
