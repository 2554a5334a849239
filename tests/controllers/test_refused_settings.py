"""Settings that a controller does not take: the refusal names the setting and says what is expected."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from helpers.channels import random_paths

from kfopc_filterpy import (
    KFOPC,
    KalmanController,
    OutputLimiter,
    OutputPowerConstraint,
    clipping_fx_lms,
    diagonal_kf,
    fx_lms,
    fx_nlms,
    fx_rls,
    kf_anc,
    kf_opc,
    kf_pb,
    leaky_fx_lms,
    mov_fx_lms,
    optimal_leaky_fx_lms,
    rescaling_fx_lms,
    two_gradient_fx_lms,
)
from kfopc_filterpy.controllers import penalty_factor

L = 6
PATH, PATHS = np.array([0.0, 0.8, -0.3]), random_paths(3, 2, 4, seed=1)
STEP, RATED = {"step_size": 0.1}, {"rated_power": 1.0, "fs": 8000.0}
KALMAN = {"state_noise": 1e-5, "measurement_noise": 0.1, "initial_variance": 1.0}
POWERS = {"disturbance_power": 1.0, "secondary_path_gain": 1.0}

NUMBERS: dict[Callable[..., Any], dict[str, float]] = {
    kf_anc: KALMAN,
    kf_opc: KALMAN | RATED,
    kf_pb: RATED | {"averaging_s": 1.0, "secondary_path_uncertainty": 0.1},
    fx_rls: {"forgetting": 0.9, "initial_variance": 1.0},
    diagonal_kf: KALMAN,
    fx_lms: STEP,
    fx_nlms: STEP | {"regularization": 1.0},
    leaky_fx_lms: STEP | {"leak": 0.1},
    optimal_leaky_fx_lms: STEP | RATED,
    mov_fx_lms: STEP | {"penalty_factor": 0.1},
    two_gradient_fx_lms: STEP | {"amplitude_limit": 1.0, "output_step_size": 0.1},
    rescaling_fx_lms: STEP | {"amplitude_limit": 1.0},
    clipping_fx_lms: STEP | {"amplitude_limit": 1.0},
}


@pytest.mark.parametrize("make", NUMBERS)
def test_a_number_out_of_range_is_refused_by_its_name(make: Callable[..., Any]) -> None:
    for name in NUMBERS[make]:
        for bad in (-1.0, np.nan, np.inf, "1"):
            with pytest.raises((ValueError, TypeError), match=name):
                make(L, PATH, **NUMBERS[make] | {name: bad})


# What does not go together, or with the number of channels, or is of no use.
# fmt: off
REFUSED: list[tuple[Callable[[], Any], str]] = [
    (lambda: kf_anc(0, PATH, **KALMAN), "n_taps must be at least 1"),
    (lambda: kf_anc(4.0, PATH, **KALMAN), "n_taps must be a whole number"),
    (lambda: kf_anc(L, [], **KALMAN), "secondary must have shape"),
    (lambda: kf_anc(L, PATHS, **KALMAN | {"measurement_noise": [0.1, 0.1]}), r"each of the 3 microphones, \(3,\), got"),
    (lambda: kf_opc(L, PATH, **KALMAN), "give either rated_power= or constraint="),
    (lambda: kf_opc(L, PATH, constraint=OutputPowerConstraint(1.0, fs=8000), **KALMAN | RATED), "give either rated_power="),
    (lambda: kf_opc(L, PATH, constraint=1.0, **KALMAN), "constraint must be an OutputPowerConstraint"),
    (lambda: kf_opc(L, PATHS, rated_power=[1.0] * 3, fs=8000, **KALMAN), "one for each of the 2 loudspeakers, got 3"),
    (lambda: kf_pb(L, PATH, rated_power=None, fs=8000), "rated_power"),
    (lambda: kf_pb(L, PATH, rated_power=[1.0, 1.0], fs=8000), r"rated_power must be one number for 1 loudspeaker, got shape"),
    (lambda: kf_pb(L, PATH, secondary_path_uncertainty=np.ones((2, 1, 2, 3)), **RATED), r"must be \(M, n_taps\)"),
    (lambda: kf_pb(L, PATH, secondary_path_uncertainty=1e4, **RATED), "must be at most 1000"),
    (lambda: kf_pb(L, PATH, averaging_s=1e5, **RATED), "averaging_s must be at most"),
    (lambda: kf_pb(L, PATH, averaging_s=0.6, **RATED), r"at least 0.64 s, 20 blocks of 256 samples, got 0.6 s: .* window_s="),
    (lambda: kf_pb(L, PATH, rated_power=1.0), r"fs must be given, the sample rate in Hz: taps have none; or give a Plant"),
    (lambda: kf_pb(PATH, L, **RATED), r"secondary must be a path or a Plant, got 6: the order is kf_pb\(n_taps, secondary, "),
    (lambda: kf_pb(L, PATH, amplifier="loud", **RATED), "amplifier must be None"),
    (lambda: fx_rls(L, PATH, forgetting=1.1), "forgetting"),
    (lambda: fx_rls(L, PATHS), "this controller takes one channel: .* kf_pb"),
    (lambda: diagonal_kf(L, PATH, **KALMAN | {"initial_variance": 1e51}), "initial_variance"),
    (lambda: KalmanController(None, PATH), "estimator must be a filterpy KalmanFilter, got NoneType"),
    (lambda: KalmanController(KalmanFilter(4, 2), PATH), "one measurement, dim_z = 1, got dim_z = 2"),
    (lambda: KalmanController(KFOPC(L), PATHS), "this controller takes one channel"),
    (lambda: KalmanController(KFOPC(4), PATH, amplifier=abs), "one of kfopc_filterpy's amplifier models"),
    (lambda: mov_fx_lms(L, PATH, amplifier=abs, **STEP | RATED), "amplifier models"),
    (lambda: mov_fx_lms(L, PATHS, amplifier=[None], **STEP | RATED), "each of the 2 loudspeakers"),
    (lambda: mov_fx_lms(L, PATH, rated_power=[1.0, 2.0], fs=8000, **STEP), "must be one for one loudspeaker, got 2"),
    (lambda: leaky_fx_lms(L, PATHS, leak=[1.0, 11.0], **STEP), r"step_size \* leak must be 1 at most, got 1.1"),
    (lambda: clipping_fx_lms(L, PATHS, amplitude_limit=[1.0, 0.0], **STEP), "amplitude_limit must be greater than 0"),
    (lambda: clipping_fx_lms(L, PATHS, amplitude_limit=[1.0], **STEP), "one for each of the 2 loudspeakers"),
    (lambda: fx_lms(L, PATHS[0], **STEP), r"\(K microphones, J loudspeakers, taps\), got \(2, 4\)"),
    (lambda: fx_lms(L, np.ones((64, 2, 3)), **STEP), "taps come last"),
    (lambda: fx_lms(L, PATHS * np.nan, **STEP), "secondary must be finite"),
    (lambda: fx_lms(L, PATHS, n_references=0, **STEP), "n_references must be at least 1"),
    (lambda: fx_lms(L, PATHS, limiter=[OutputLimiter(1.0, fs=8000)] * 2, **STEP), "2 different OutputLimiters"),
    (lambda: penalty_factor(1.0, **POWERS | {"disturbance_power": np.nan}), "disturbance_power"),
]
# fmt: on


@pytest.mark.parametrize(("make", "message"), REFUSED, ids=[message for _, message in REFUSED])
def test_what_does_not_fit_is_refused(make: Callable[[], Any], message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        make()
