"""Controllers whose secondary path is verified: a wrong one is learned, and the noise does not become much louder."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import pytest
from helpers.controllers import ALL
from helpers.simulation import Integrator
from hypothesis import given, settings
from hypothesis import strategies as st

from kfopc_filterpy import FxLMS, FxNLMS, HardClipAmplifier, OutputLimiter, kf_anc, kf_opc, kf_pb, simulate
from kfopc_filterpy.controllers import VerifiedController
from kfopc_filterpy.controllers.posterior import BLOCK_S
from kfopc_filterpy.controllers.verified import FIRST_PAUSE_S, HOLD_S, LEAST_VOLUME, STEP_S
from kfopc_filterpy.paths import PathTolerance

FS = 2000.0
L, M = 24, 16


def resonance(delay: int, decay: float, frequency: float, taps: int) -> np.ndarray:
    """Return a path of unit energy."""
    n = np.arange(taps) - delay
    path = np.where(n < 0, 0.0, decay ** np.abs(n) * np.cos(frequency * n))
    return path / np.linalg.norm(path)


PATH = resonance(4, 0.6, 0.9, 12)
S = np.pad(PATH, (0, M - 12))
P = resonance(9, 0.8, 0.5, 26)
PATHS = np.array([[S, 0.3 * np.roll(S, 1)], [0.2 * np.roll(S, 2), S]])
MAKERS: dict[str, Callable[..., Any]] = {
    "FxLMS": lambda path=S, **o: FxLMS(L, path, step_size=0.002, **o),
    "FxNLMS": lambda path=S, **o: FxNLMS(L, path, step_size=0.05, **o),
    "KF-ANC": lambda path=S, **o: kf_anc(L, path, state_noise=1e-8, measurement_noise=0.01, initial_variance=0.1, **o),
}
FAULTS = {
    "polarity": -S,
    "two samples late": np.roll(S, 2),
    "two samples early": np.roll(S, -2),
    "3 dB louder": 1.41 * S,
    "another path": resonance(3, 0.5, 1.6, M),
}


def verified(controller: Any, **settings: Any) -> VerifiedController:
    return VerifiedController(controller, **{"fs": FS} | settings)


def noises(seconds: float, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return a white reference and the disturbance, 1 % of whose power it does not explain."""
    x, other = np.random.default_rng(seed).standard_normal((2, round(seconds * FS)))
    return x, np.convolve(x, P)[: x.size] + 0.1 * other


def noises_of_two(seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Return two references and what two microphones hear of them."""
    (x1, d1), (x2, d2) = noises(seconds), noises(seconds, seed=2)
    return np.array([x1, x2]), np.array([d1 + 0.5 * d2, d2 - 0.5 * d1])


def run(controller: Any, x: np.ndarray, d: np.ndarray, path: Any, later: Any = None, at: int = 0) -> np.ndarray:
    """Return errors and control signals, (K + J, n), in a room whose path is another one from a sample on."""
    paths = [(0.0, later)] if at == 0 and later is not None else [(0.0, path)]
    if at:
        paths.append((at / FS, later))
    # The run must not end when the control signal is far too loud: what follows is tested.
    result = simulate(controller, x, disturbance=d, secondary_path=paths, fs=FS, rated_power=1e200)
    return np.concatenate((np.atleast_2d(result.error), np.atleast_2d(result.control_signal)))


def changes_db(error: np.ndarray, d: np.ndarray, seconds: float = 1.0) -> np.ndarray:
    """Return by how many dB each stretch of time is louder than without control, over all microphones."""
    n = round(seconds * FS)
    e2, d2 = (np.sum(np.atleast_2d(signal) ** 2, axis=0) for signal in (error, d))
    whole = e2.size // n * n
    return 10 * np.log10(e2[:whole].reshape(-1, n).mean(axis=1) / d2[:whole].reshape(-1, n).mean(axis=1))


def names(controller: VerifiedController) -> list[str]:
    return [event.what for event in controller.events]


# What it is for.


@pytest.mark.parametrize("begin", ["at once", "silent reference", "two channels"])
@pytest.mark.parametrize("name", ["FxLMS", "KF-ANC"])
def test_on_an_exact_path_nothing_is_noticed_and_little_is_lost(name: str, begin: str) -> None:
    several = begin == "two channels"
    x, d = noises_of_two(3.0) if several else noises(3.0)
    path, options = (PATHS, {"n_references": 2}) if several else (S, {})
    if begin == "silent reference":
        x[:2001], d = 0.0, 0.0 * d
        d = np.convolve(x, P)[: x.size] + 0.1 * np.random.default_rng(3).standard_normal(x.size)
    controller = verified(MAKERS[name](path, **options))
    result = run(controller, x, d, path)
    bare = simulate(MAKERS[name](path, **options), x, disturbance=d, secondary_path=path, fs=FS)
    assert controller.events == []
    assert controller.volume == 1.0
    late = np.subtract(*(changes_db(error, d)[-1] for error in (result[: len(result) // 2], bare.error)))
    # It begins to adapt 0.06 s later: FxLMS has reached -15 dB or less by then.
    assert late < 1.0


def test_after_listening_it_begins_softly_with_the_signal_of_the_controller_itself() -> None:
    x, d = noises(2.0)
    plant: dict[str, Any] = {"disturbance": d, "secondary_path": S, "fs": FS, "switch_on_s": 1.0}
    controller = verified(MAKERS["FxLMS"]())
    own, bare = simulate(controller, x, **plant), simulate(MAKERS["FxLMS"](), x, **plant)
    first = slice(48)  # a block of 64 samples ends after 2048
    assert np.any(bare.control_signal[first])
    # On the exact path, the error at full volume is the one that it would hear; rounding of sums of order 1.
    np.testing.assert_allclose(own.control_signal[first], LEAST_VOLUME * bare.control_signal[first], atol=1e-13)
    assert controller.events == []
    assert controller.volume == 1.0
    # Of 2000 samples, each of the 39 taps is known to 0.1 / sqrt(2000), in all 0.014 of the path.
    assert np.linalg.norm(controller.primary_path[:26] - P) < 0.05


# Every fault at the start and as a jump, each algorithm several times.
CASES = [
    (list(MAKERS)[number % 3], fault, at)
    for number, (fault, at) in enumerate([(fault, at) for fault in FAULTS for at in (0, 3001)])
]


@pytest.mark.parametrize(("name", "fault", "at"), CASES)
def test_a_wrong_path_is_learned_before_the_noise_is_much_louder(name: str, fault: str, at: int) -> None:
    x, d = noises(5.5)
    controller = verified(MAKERS[name]())
    error, _ = run(controller, x, d, S, FAULTS[fault], at)
    exact = simulate(MAKERS[name](FAULTS[fault]), x, disturbance=d, secondary_path=FAULTS[fault], fs=FS)
    assert changes_db(error, d).max() < 1.0
    # A failure costs the first pause, five doublings of the volume and the time to adapt.
    assert 1.0 + FIRST_PAUSE_S + HOLD_S + 5 * STEP_S < 4.5
    assert np.mean(error[-2000:] ** 2) < 10**0.1 * np.mean(exact.error[-2000:] ** 2)
    if at and fault != "3 dB louder":  # with that the noise stays more than 6 dB softer than without control
        assert names(controller)[0] == "alarm"
        assert at <= controller.events[0].time_s * FS < at + 0.5 * FS
    assert controller.alarms >= names(controller).count("alarm")
    assert np.linalg.norm(controller.secondary_path - FAULTS[fault]) < 0.3


def test_of_several_loudspeakers_one_may_change() -> None:
    x, d = noises_of_two(6.0)
    later = PATHS * np.array([1.0, -1.0])[:, np.newaxis]
    controller = verified(MAKERS["FxLMS"](PATHS, n_references=2))
    result = run(controller, x, d, PATHS, later, 2001)
    exact = simulate(MAKERS["FxLMS"](later, n_references=2), x, disturbance=d, secondary_path=later, fs=FS)
    changes = changes_db(result[:2], d)
    assert changes.max() < 1.0
    assert changes[-1] < changes_db(exact.error, d)[-1] + 1.0
    assert controller.alarms > 0
    assert controller.primary_path.shape == (2, 2, L + M - 1)


def test_what_it_cannot_follow_is_silenced_for_longer_and_longer() -> None:
    """The true path is longer than the estimate."""
    x, d = noises(12.0)
    controller = verified(MAKERS["KF-ANC"]())
    error, y = run(controller, x, d, np.concatenate((np.zeros(14), -S)))
    assert changes_db(error, d, 0.5).max() < 2.2
    assert np.mean(error[-8000:] ** 2) < 10**0.05 * np.mean(d[-8000:] ** 2)
    times = [event.time_s for event in controller.events if event.what == "louder"]
    assert len(times) > 2
    assert np.all(np.diff(times, 2) > 0.0)  # each pause is longer than the last one
    assert np.any(y[-16000:])  # but it tries again
    assert "unstable" not in names(controller)  # a new controller adapts well in silence


def test_an_adaptation_that_diverges_on_the_right_path_stays_silent() -> None:
    x, d = noises(3.0)
    controller = verified(FxLMS(L, S, step_size=0.5))
    error, _ = run(controller, x, d, S)
    assert "unstable" in names(controller)
    assert "full volume" not in names(controller)
    np.testing.assert_array_equal(error[-4000:], d[-4000:])


def test_after_an_alarm_the_controller_does_not_adapt() -> None:
    x, d = noises(3.5)
    controller = verified(MAKERS["FxLMS"]())
    paths = [(0.0, S), (5001 / FS, FAULTS["another path"])]
    result = simulate(controller, x, disturbance=d, secondary_path=paths, fs=FS, record_weights_every=1)
    adapts = np.any(np.diff(result.weights, axis=0), axis=1)
    assert names(controller) == ["alarm"]
    alarm = round(controller.events[0].time_s * FS)
    held, block = alarm + round(HOLD_S * FS), round(BLOCK_S * FS)
    assert held > alarm + block  # at least one posterior
    assert all(adapts[1000 : alarm - 1])
    assert not any(adapts[alarm + 1 : held])
    assert all(adapts[held + block :])


def test_a_noise_that_no_reference_hears_is_not_blamed_on_the_control_for_ever() -> None:
    x, d = noises(7.0)
    d[4001:] += 3.0 * np.random.default_rng(7).standard_normal(d.size - 4001)
    controller = verified(MAKERS["KF-ANC"]())
    error, y = run(controller, x, d, S)
    assert "louder" in names(controller)
    assert controller.volume == 1.0
    assert np.mean(y[-2000:] ** 2) > 0.3  # as loud as the part of the noise that it can cancel, of power 1
    assert changes_db(error, d)[-1] < 0.0


def test_a_louder_primary_path_is_followed() -> None:
    """It was not so loud when the room was last silent."""
    x, d = noises(6.0)
    d[4001:] *= -2.0
    controller = verified(MAKERS["KF-ANC"]())
    error, _ = run(controller, x, d, S)
    assert changes_db(error, d).max() < 1.0
    assert changes_db(error, d)[-1] < -15.0


# What it must withstand.


class Own:
    """A user's controller, which breaks once."""

    secondary_path, n_taps = S, L

    def __init__(self, breaks_at: int, value: float = np.nan) -> None:
        self.samples, self.breaks_at, self.value = 0, breaks_at, value

    def control_signal(self, reference: float) -> float:
        self.samples += 1
        return self.value if self.samples >= self.breaks_at else 0.1 * reference

    def update(self, error: float) -> None:
        pass


@pytest.mark.parametrize("value", [np.nan, 1e60])
def test_a_control_signal_that_is_not_finite_is_silence_and_another_start(value: float) -> None:
    x, d = noises(3.9)
    controller = verified(Own(4000, value))
    _, y = run(controller, x, d, S)
    assert names(controller)[:2] == ["not finite", "full volume"]
    assert controller.events[0].time_s == 3999 / FS
    assert np.isfinite(y).all()
    assert not y[3999 : 3999 + round((FIRST_PAUSE_S - BLOCK_S) * FS)].any()
    assert np.any(y[-100:])


def test_a_control_signal_that_is_never_finite_is_one_event() -> None:
    x, d = noises(1.0)
    controller = verified(Own(0))
    assert not run(controller, x, d, S)[1].any()
    assert names(controller) == ["not finite"]


def test_blocks_around_a_controller_that_states_no_channels() -> None:
    x, d = noises(0.2)
    blocks, steps = verified(Own(10**6)), verified(Own(10**6))
    expected = []
    for reference, error in zip(x, d, strict=True):
        expected.append(steps.control_signal(reference))
        steps.update(error)
    np.testing.assert_array_equal(blocks.process(x, d), expected)


def test_errors_that_never_come_do_not_stop_it() -> None:
    x, d = noises(4.0)
    heard = np.random.default_rng(5).random(x.size) > 2e-3
    heard[4000:4500] = False
    controller, played, error = verified(MAKERS["FxNLMS"](-S)), np.zeros(M), np.zeros(x.size)
    for n in range(x.size):
        played = np.append(controller.control_signal(x[n]), played[:-1])
        error[n] = d[n] - S @ played
        if heard[n]:
            controller.update(error[n])
    assert changes_db(error, d).max() < 1.0
    assert changes_db(error, d)[-1] < -15.0


@given(
    sizes=st.lists(st.sampled_from([0.0, 1e-30, 1e-3, 1.0, 30.0, 1e4]), min_size=2, max_size=12),
    flips=st.booleans(),
    seed=st.integers(0, 99),
)
@settings(max_examples=10, deadline=None)
def test_it_never_plays_more_than_the_controller_asks_for(sizes: list[float], flips: bool, seed: int) -> None:
    rng, asked = np.random.default_rng(seed), []

    class Recorded(FxLMS):
        kept: ClassVar[list[float]] = asked

        def control_signal(self, reference: Any) -> Any:
            y = super().control_signal(reference)
            self.kept.append(y)
            return y

    controller = verified(Recorded(8, [0.0, 1.0], step_size=0.05))
    for number, size in enumerate(sizes):
        for x, e in size * rng.standard_normal((60, 2)):
            y = controller.control_signal(x)
            assert 0.0 <= controller.volume <= 1.0
            assert not abs(y) > abs(asked[-1])
            controller.update(-e * y if flips and number % 2 else e)


# What is assigned to it, and what is saved.


def test_what_was_assigned_survives_a_new_start() -> None:
    """Also that of the copy with which it starts: it fails twice."""
    x, d = noises(4.0)
    limiter = OutputLimiter(0.05, fs=FS, window_s=1.0)
    own = kf_opc(L, S, rated_power=4.0, state_noise=1e-8, measurement_noise=0.01, initial_variance=0.1, fs=FS)
    controller = verified(own)
    first = controller.controller
    controller.limiter, controller.rated_power = limiter, 2.0
    controller.secondary_path, controller.secondary_path_uncertainty = -0.9 * S, PathTolerance(gain_db=1.0)
    assert (first.limiter, first.rated_power) == (limiter, 2.0)
    np.testing.assert_array_equal(first.secondary_path, -0.9 * S)
    controller.limiter = limiter = OutputLimiter(3.0, fs=FS, window_s=0.1)
    _, y = run(controller, x, d, np.concatenate((np.zeros(14), -S)))
    assert names(controller).count("louder") > 1
    assert controller.controller is not first
    assert controller.limiter is limiter
    assert controller.rated_power == 2.0
    assert controller.secondary_path_uncertainty == PathTolerance(gain_db=1.0)
    power = np.convolve(y**2, np.full(200, 1 / 200))
    assert 0.1 < power.max() < 3.0 * (1 + 1e-9)


def test_a_path_that_is_assigned_is_the_one_to_which_an_alarm_returns() -> None:
    x, d = noises(2.0)
    controller = verified(MAKERS["FxLMS"]())
    run(controller, x, d, S)
    controller.secondary_path = -S
    np.testing.assert_array_equal(controller.secondary_path, -S)
    error, _ = run(controller, *noises(3.0, seed=4), -S)
    assert changes_db(error, noises(3.0, seed=4)[1])[-1] < -15.0
    assert np.linalg.norm(controller.secondary_path + S) < 0.3  # the first spread, to which nothing adds


def test_with_the_amplifier_known_the_path_is_learned_although_it_clips() -> None:
    x, d = noises(4.0)
    left = []
    for known in (None, HardClipAmplifier(0.5)):
        controller = verified(MAKERS["FxLMS"](1.5 * S), amplifier=known)
        simulate(controller, x, disturbance=d, secondary_path=S, fs=FS, amplifier=HardClipAmplifier(0.5))
        left.append(np.linalg.norm(controller.secondary_path - S))
    assert left[1] < 0.1 < left[0]


FXLMS = MAKERS["FxLMS"]()


@pytest.mark.parametrize(
    ("controller", "settings", "message"),
    [
        (1.0, {}, "must have control_signal"),
        (Integrator(), {}, "must have secondary_path and n_taps"),
        (ALL["VirtualMicrophones"](), {}, "virtual microphones have other paths"),
        (kf_pb(L, S, rated_power=1.0, fs=FS), {}, "verifies its path itself"),
        (verified(FXLMS), {}, "verifies its path itself"),
        (FXLMS, {"fs": 0.0}, "fs"),
        (FXLMS, {"memory_s": 0.0}, "memory_s"),
    ],
)
def test_what_cannot_be_verified_is_refused(controller: Any, settings: dict[str, float], message: str) -> None:
    with pytest.raises((TypeError, ValueError), match=message):
        verified(controller, **settings)


def test_a_run_at_another_rate_and_a_path_that_is_too_long_are_refused() -> None:
    controller = verified(FXLMS)
    with pytest.raises(ValueError, match="verification is for 2000 Hz: make it with the fs of the run"):
        simulate(controller, np.ones(9), disturbance=np.ones(9), secondary_path=S, fs=8000.0)
    with pytest.raises(ValueError, match="at most the 16 taps"):
        controller.secondary_path = np.ones(17)
