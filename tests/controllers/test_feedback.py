"""Acoustic feedback, neutralised by an estimate of its path."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
from helpers.controllers import MAKERS
from helpers.loop import AMPLIFIERS, FEEDBACK, FS, S, noises
from helpers.simulation import Integrator

from kfopc_filterpy import LimitedController, OutputLimiter, Plant, fx_lms, simulate
from kfopc_filterpy.controllers import FeedbackNeutralizer
from kfopc_filterpy.paths import fir_path

CASES: dict[str, Any] = {name: MAKERS[name] for name in ("FxLMS", "KF-ANC", "KF-OPC", "KF-PB")} | {
    "limited": lambda: LimitedController(Integrator(), OutputLimiter(0.05, fs=FS, window_s=0.01)),
    "own": Integrator,
}


@pytest.mark.parametrize("name", CASES)
def test_with_the_true_path_nothing_is_left_of_the_feedback(name: str) -> None:
    x, d, _ = noises()
    free_plant, plant = Plant(S, fs=FS), Plant(S, feedback=FEEDBACK, fs=FS)
    options: dict[str, Any] = {"disturbance": d}
    if name not in ("own", "limited"):
        options["switch_on_s"] = 20 / FS
    free = simulate(CASES[name](), x, free_plant, **options)
    neutral = simulate(FeedbackNeutralizer(CASES[name](), FEEDBACK), x, plant, **options)
    # The references differ by rounding. KF-PB ends its steps when enough is known, and a rounding error may add a step.
    np.testing.assert_allclose(neutral.error, free.error, rtol=0, atol=1e-5 if name == "KF-PB" else 1e-10)
    fed_back = simulate(CASES[name](), x, plant, **options)
    assert np.abs(fed_back.error - free.error).max() > 1e-3


def test_several_channels() -> None:
    rng = np.random.default_rng(0)
    x, d = rng.standard_normal((3, 400)), rng.standard_normal((4, 400))
    s = 0.5 * rng.standard_normal((4, 2, 6))  # four microphones, two loudspeakers
    feedback = 0.2 * rng.standard_normal((3, 2, 5))  # to three reference microphones
    feedback[:, :, 0] = 0.0

    def made() -> Any:
        return fx_lms(7, s, step_size=2e-3, n_references=3)

    free = simulate(made(), x, Plant(s, fs=FS), disturbance=d)
    neutral = FeedbackNeutralizer(made(), feedback)
    result = simulate(neutral, x, Plant(s, feedback=feedback, fs=FS), disturbance=d)
    np.testing.assert_allclose(result.error, free.error, rtol=0, atol=1e-10)
    assert np.abs(free.control_signal).max() > 0.1


def test_a_loop_that_would_diverge_is_stable() -> None:
    rng = np.random.default_rng(2)
    x = rng.standard_normal(6000)
    feedback = np.concatenate((np.zeros(3), 1.5 * 0.7 ** np.arange(12)))
    estimate = feedback + 0.02 * rng.standard_normal(feedback.size) * (np.arange(feedback.size) > 0)
    plant = Plant([0.0, 1.0], np.eye(12)[8], feedback=feedback, fs=FS)
    alone = simulate(fx_lms(16, plant, step_size=0.003), x, plant)
    assert alone.diverged_at_s is not None or np.mean(alone.error[-1000:] ** 2) > 0.3
    neutral = FeedbackNeutralizer(fx_lms(16, plant, step_size=0.003), estimate)
    result = simulate(neutral, x, plant)
    assert np.mean(result.error[-1000:] ** 2) < 0.02


def test_it_subtracts_what_a_known_amplifier_delivers() -> None:
    x, d, _ = noises()
    clip = AMPLIFIERS["hard"][0]
    plant = Plant(S, feedback=FEEDBACK, amplifier=clip, fs=FS)
    free = simulate(MAKERS["FxLMS"](), x, Plant(S, amplifier=clip, fs=FS), disturbance=5 * d)
    known = FeedbackNeutralizer(MAKERS["FxLMS"](), FEEDBACK, amplifier=clip)
    result = simulate(known, x, plant, disturbance=5 * d)
    np.testing.assert_allclose(result.error, free.error, rtol=0, atol=1e-10)
    unknown = simulate(FeedbackNeutralizer(MAKERS["FxLMS"](), FEEDBACK), x, plant, disturbance=5 * d)
    assert not np.allclose(unknown.error, free.error, atol=1e-3)


def test_what_was_played_before_a_pause_is_still_subtracted() -> None:
    one = FeedbackNeutralizer(Recorder(), [0.0, 0.5, 0.25])
    one.control_signal(1.0)  # plays 1
    one.update(0.0)
    one.listen([0.5, 0.25, 0.0], [0.0, 0.0, 0.0])  # just the feedback
    np.testing.assert_array_equal(one.controller.heard, np.zeros(3))
    assert copy.deepcopy(one).control_signal(2.0) == 2.0
    with pytest.raises(ValueError, match="listen"):
        FeedbackNeutralizer(Integrator(), [0.0, 1.0]).listen([0.0], [0.0])


ONE, SEVERAL = MAKERS["FxLMS"](), fx_lms(4, np.ones((2, 3, 4)), step_size=0.1, n_references=2)


class Recorder:
    """A controller that emits its reference and keeps what it listens to."""

    def control_signal(self, reference: float) -> float:
        return reference

    def update(self, error: float) -> None:
        pass

    def listen(self, references: np.ndarray, errors: np.ndarray) -> None:
        self.heard = references


@pytest.mark.parametrize(
    ("controller", "path", "options", "message"),
    [
        (ONE, [0.1, 0.2], {}, "delay of a sample at least"),
        (SEVERAL, [0.0, 1.0], {}, r"must be \(I references, J loudspeakers, taps\)"),
        (SEVERAL, np.zeros((1, 3, 4)), {}, r"n_references of 2, got \(1, 3, 4\)"),
        (SEVERAL, np.zeros((2, 2, 4)), {}, r"n_loudspeakers of 3, got \(2, 2, 4\)"),
        (ONE, [0.0, 1.0], {"amplifier": 2.0}, "amplifier must be a function"),
        (3, [0.0, 1.0], {}, "controller must have control_signal"),
    ],
)
def test_what_does_not_fit_is_refused(controller: Any, path: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        FeedbackNeutralizer(controller, path, **options)


def test_a_feedback_path_is_for_its_sample_rate() -> None:
    neutral = FeedbackNeutralizer(ONE, fir_path([0.0, 1.0], FS))
    with pytest.raises(ValueError, match="feedback path is for 8000 Hz"):
        simulate(neutral, np.ones(5), Plant([1.0], [1.0], fs=16000.0))
    assert repr(neutral).startswith("<FxLMS with feedback neutralisation: 2 taps, <FxLMS: 10 taps")
