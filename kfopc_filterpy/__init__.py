"""Kalman filter with output power constraint (KF-OPC) for active noise control, an extension of filterpy.

`KFOPC` is a `filterpy.kalman.KalmanFilter`. Everything else is loaded when it is first used, so that importing
the package costs little more than importing filterpy.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .estimator import KFOPC

if TYPE_CHECKING:
    from .amplifiers import HardClipAmplifier, LinearAmplifier, SoftSaturationAmplifier
    from .causality import CausalityMargin, causality_margin
    from .constraint import OutputPowerConstraint
    from .controllers import (
        ClippingFxLMS,
        Controller,
        DiagonalKalman,
        FastArrayKalman,
        FxLMS,
        FxNLMS,
        KalmanController,
        LeakyFxLMS,
        LimitedController,
        MOVFxLMS,
        OptimalLeakyFxLMS,
        RepairedKFOPC,
        RescalingFxLMS,
        TwoGradientFxLMS,
        fx_rls,
        kf_anc,
        kf_opc,
        kf_opc_repaired,
        kf_pb,
        leak_factor,
        penalty_factor,
    )
    from .datasets import DataUnavailableError, MeasuredDuct, load_measured_duct
    from .duct import DuctPaths, duct_paths
    from .identification import (
        IdentificationResult,
        PathEstimate,
        estimate_path,
        identify_secondary_path,
        misalignment_db,
        modelling_error_db,
    )
    from .limiter import OutputLimiter
    from .measurement_noise import measurement_noise_from_residual, measurement_noise_from_run
    from .metrics import (
        clipped_fraction,
        convergence_time_s,
        noise_reduction_db,
        nse_db,
        output_power,
        overshoot,
        peak_control_signal,
    )
    from .path_analysis import (
        achieved_band,
        frequency_response,
        group_delay,
        phase_error,
        secondary_path_gain,
    )
    from .paths import bandpass_path, fir_path, path_taps, perturbed_path
    from .power_bound import (
        ControlFilter,
        ControlFilters,
        PowerConstrainedWiener,
        power_constrained_solution,
        power_constrained_wiener,
    )
    from .power_budget import PowerBudget
    from .power_budget_filter import PowerBudgetKalmanFilter
    from .random_walk import RandomWalkKFOPC
    from .rated_power import RatedPower, required_rated_power
    from .recordings import read_mat_vector, read_wav, write_wav
    from .scenarios import simulate_scenarios
    from .signals import band_limited_noise, compressor_noise, level_jump, scaled_to_power, tone
    from .simulation import SimulationResult, simulate
    from .spectra import coherence_and_gain, harmonics_db, power_spectrum_db
    from .varying_noise import bursty_noise, looped, swelling
    from .wiener import WienerSolution, coherence_bound, wiener_solution

__version__ = "0.1.0"

# Public names and the module each lives in.
_LAZY = {
    "CausalityMargin": "causality",
    "ClippingFxLMS": "controllers",
    "ControlFilter": "power_bound",
    "ControlFilters": "power_bound",
    "Controller": "controllers",
    "DataUnavailableError": "datasets",
    "DiagonalKalman": "controllers",
    "DuctPaths": "duct",
    "FastArrayKalman": "controllers",
    "FxLMS": "controllers",
    "FxNLMS": "controllers",
    "HardClipAmplifier": "amplifiers",
    "IdentificationResult": "identification",
    "KalmanController": "controllers",
    "LeakyFxLMS": "controllers",
    "LimitedController": "controllers",
    "LinearAmplifier": "amplifiers",
    "MOVFxLMS": "controllers",
    "MeasuredDuct": "datasets",
    "OptimalLeakyFxLMS": "controllers",
    "OutputLimiter": "limiter",
    "OutputPowerConstraint": "constraint",
    "PathEstimate": "identification",
    "PowerBudget": "power_budget",
    "PowerBudgetKalmanFilter": "power_budget_filter",
    "PowerConstrainedWiener": "power_bound",
    "RandomWalkKFOPC": "random_walk",
    "RatedPower": "rated_power",
    "RepairedKFOPC": "controllers",
    "RescalingFxLMS": "controllers",
    "SimulationResult": "simulation",
    "SoftSaturationAmplifier": "amplifiers",
    "TwoGradientFxLMS": "controllers",
    "WienerSolution": "wiener",
    "achieved_band": "path_analysis",
    "band_limited_noise": "signals",
    "bandpass_path": "paths",
    "bursty_noise": "varying_noise",
    "causality_margin": "causality",
    "clipped_fraction": "metrics",
    "coherence_and_gain": "spectra",
    "coherence_bound": "wiener",
    "compressor_noise": "signals",
    "convergence_time_s": "metrics",
    "duct_paths": "duct",
    "estimate_path": "identification",
    "fir_path": "paths",
    "frequency_response": "path_analysis",
    "fx_rls": "controllers",
    "group_delay": "path_analysis",
    "harmonics_db": "spectra",
    "identify_secondary_path": "identification",
    "kf_anc": "controllers",
    "kf_opc": "controllers",
    "kf_opc_repaired": "controllers",
    "kf_pb": "controllers",
    "leak_factor": "controllers",
    "level_jump": "signals",
    "load_measured_duct": "datasets",
    "looped": "varying_noise",
    "measurement_noise_from_residual": "measurement_noise",
    "measurement_noise_from_run": "measurement_noise",
    "misalignment_db": "identification",
    "modelling_error_db": "identification",
    "noise_reduction_db": "metrics",
    "nse_db": "metrics",
    "output_power": "metrics",
    "overshoot": "metrics",
    "path_taps": "paths",
    "peak_control_signal": "metrics",
    "penalty_factor": "controllers",
    "perturbed_path": "paths",
    "phase_error": "path_analysis",
    "power_constrained_solution": "power_bound",
    "power_constrained_wiener": "power_bound",
    "power_spectrum_db": "spectra",
    "read_mat_vector": "recordings",
    "read_wav": "recordings",
    "required_rated_power": "rated_power",
    "scaled_to_power": "signals",
    "secondary_path_gain": "path_analysis",
    "simulate": "simulation",
    "simulate_scenarios": "scenarios",
    "swelling": "varying_noise",
    "tone": "signals",
    "wiener_solution": "wiener",
    "write_wav": "recordings",
}

__all__ = ["KFOPC", *sorted(_LAZY)]


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_LAZY[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))
