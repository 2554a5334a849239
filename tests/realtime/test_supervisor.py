"""The supervisor's promises: finite, within limits, nothing learned from bad samples, recovery, a health record."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from copy import deepcopy
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.channels import random_paths
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from kfopc_filterpy import OutputPowerConstraint, Plant, fx_lms, kf_opc
from kfopc_filterpy.controllers import with_internal_model
from kfopc_filterpy.realtime import SimulatedInterface, Supervisor
from kfopc_filterpy.realtime.adaptation import Adaptation

FS = 8000.0
BLOCK, LATENCY = 32, 64
S = np.array([0.0, 0.8, -0.3])
PATH = np.concatenate((np.zeros(LATENCY), S))
PRIMARY = np.zeros(90)
PRIMARY[[70, 75, 82]] = 1.0, 0.5, -0.3
PATHS = np.concatenate((np.zeros((2, 2, LATENCY)), random_paths(2, 2, 5, seed=2)), axis=2)
LIMIT = 4.0

KALMAN = {"state_noise": 1e-7, "measurement_noise": 1e-2, "initial_variance": 1e-2}
MAKERS: dict[str, Any] = {
    "FxLMS": lambda: fx_lms(24, PATH, step_size=1e-3),
    "KF-OPC": lambda: kf_opc(24, PATH, constraint=OutputPowerConstraint(0.5, fs=FS), **KALMAN),
    "FxLMS of several channels": lambda: fx_lms(16, PATHS, step_size=3e-4),
    "hybrid FxLMS of several channels": lambda: with_internal_model(fx_lms(16, PATHS, step_size=3e-4, n_references=3)),
}


class Playing:
    """A controller that plays what a function of the number of the sample says, from 1 on."""

    def __init__(self, played: Callable[[int], float]) -> None:
        self.played, self.n = played, 0

    def control_signal(self, reference: float) -> float:
        self.n += 1
        return self.played(self.n)

    def update(self, error: float) -> None:
        pass


def supervised(controller: Any, **changed: Any) -> Supervisor:
    """Return a supervisor that begins at once; `test_loudness.py` has those that listen first."""
    settings = {"fs": FS, "amplitude_limit": LIMIT, "full_scale": 50.0, "mute_after_s": 2.0, "louder_s": None}
    return Supervisor(controller, **settings | changed)


def plant(several: bool = False, seconds: float = 3.0, **changed: Any) -> SimulatedInterface:
    x = np.random.default_rng(5).standard_normal(round(seconds * FS))
    primary = np.stack((PRIMARY, 0.7 * PRIMARY))[:, np.newaxis] if several else PRIMARY
    secondary = PATHS[..., LATENCY:] if several else S
    return SimulatedInterface(x, Plant(secondary, primary, fs=FS), block=BLOCK, latency=LATENCY, **changed)


def loop(supervisor: Supervisor, interface: SimulatedInterface, spoil: Any = None) -> tuple[np.ndarray, np.ndarray]:
    """Run to the end; `spoil(references, errors, first_sample)` changes what is heard. Return y and the true errors."""
    ys, es = [], []
    first = 0
    while (block := interface.read()) is not None:
        x, e = block.references.copy(), block.errors.copy()
        es.append(block.errors)
        given = (x, e) if spoil is None else spoil(x, e, first)
        if not supervisor.multichannel:
            given = tuple(None if signal is None else signal[0] for signal in given)
        y = np.atleast_2d(supervisor.process(*given))
        interface.write(y)
        ys.append(y)
        first += BLOCK
    return np.concatenate(ys, axis=1), np.concatenate(es, axis=1)


def db(e: np.ndarray, d: np.ndarray) -> float:
    return float(10 * np.log10(np.sum(d**2) / np.sum(e**2)))


@pytest.mark.parametrize("name", MAKERS)
def test_without_faults_it_changes_nothing(name: str) -> None:
    several = name.endswith("channels")
    supervisor, bare = supervised(MAKERS[name](), amplitude_limit=100.0), MAKERS[name]()
    y, _ = loop(supervisor, plant(several, 1.0))
    again = plant(several, 1.0)
    direct = []
    while (block := again.read()) is not None:
        x, e = (signal if several else signal[0] for signal in block[:2])
        direct.append(np.atleast_2d(bare.process(x, e)))
        again.write(direct[-1])
    np.testing.assert_array_equal(y, np.concatenate(direct, axis=1))
    assert not supervisor.health.counts


BAD: dict[str, Any] = {
    "NaN": lambda v: np.full_like(v, np.nan),
    "Inf": lambda v: np.full_like(v, -np.inf),
    "huge": lambda v: np.full_like(v, 1e250),
    "stuck": lambda v: np.full_like(v, 0.123),
    "unplugged": np.zeros_like,
    "offset": lambda v: v + 20.0,
    "clipped": lambda v: np.sign(v) * 50.0,
    "sign": lambda v: -v,
    "40 dB up": lambda v: 100.0 * v,
    "40 dB down": lambda v: 0.01 * v,
}


@settings(max_examples=8, deadline=None)
@given(
    fault=st.sampled_from(sorted(BAD)),
    where=st.sampled_from(["reference", "error", "both"]),
    begin=st.integers(1, 16000),
    log_length=st.floats(0.0, 5.0),
    louder_s=st.sampled_from([None, 0.25]),
)
@pytest.mark.parametrize("name", MAKERS)
def test_whatever_comes_in_what_goes_out_is_finite_and_within_the_limit(
    name: str, fault: str, where: str, begin: int, log_length: float, louder_s: float | None
) -> None:
    end = begin + round(10.0**log_length)

    def spoil(x: np.ndarray, e: np.ndarray, first: int) -> tuple[Any, Any]:
        a, b = max(begin - first, 0), min(end - first, BLOCK)
        if a < b:
            if where != "error":
                x[-1, a:b] = BAD[fault](x[-1, a:b])
            if where != "reference":
                e[-1, a:b] = BAD[fault](e[-1, a:b])
        return x, e

    supervisor = supervised(MAKERS[name](), pause_s=0.3, louder_s=louder_s)
    y, _ = loop(supervisor, plant(name.endswith("channels"), 3.0), spoil)
    assert np.all(np.isfinite(y))
    assert np.max(np.abs(y)) <= LIMIT
    if fault in ("NaN", "Inf", "huge"):
        n_heard = min(end, 24000) - begin
        assert supervisor.health.samples["not finite"] == n_heard * (2 if where == "both" else 1)
    if fault == "clipped":
        assert supervisor.health.counts["clipped"] >= 1


@pytest.mark.parametrize("name", ["FxLMS", "KF-OPC", "FxLMS of several channels"])
@pytest.mark.parametrize("where", ["reference", "error"])
def test_nothing_is_learned_from_bad_samples(name: str, where: str) -> None:
    """Weights, running powers and covariance stay until the recovery, and then go on."""
    supervisor = supervised(MAKERS[name]())
    several = name.endswith("channels")
    loop(supervisor, plant(several, 1.0))
    controller: Any = supervisor.controller
    before = deepcopy(controller)
    rng = np.random.default_rng(0)
    x = rng.standard_normal((controller.n_references if several else 1, 400))
    e = rng.standard_normal((2 if several else 1, 400))
    bad_x, bad_e = x.copy(), e.copy()
    (bad_x if where == "reference" else bad_e)[-1, :100] = np.nan
    recovery = supervisor.recovery_samples if where == "reference" else 0
    assert supervisor.recovery_samples == (16 + 69 if several else 24 + 67) + 48

    def process(begin: int, end: int) -> None:
        part = slice(begin, end)
        supervisor.process(*((bad_x[:, part], bad_e[:, part]) if several else (bad_x[0, part], bad_e[0, part])))

    process(0, 100)
    process(100, 100 + recovery) if recovery else None
    np.testing.assert_array_equal(controller.weights, before.weights)
    np.testing.assert_array_equal(controller.disturbance_power, before.disturbance_power)
    if name == "KF-OPC":
        np.testing.assert_array_equal(controller.covariance, before.covariance)
    process(100 + recovery, 101 + recovery)
    assert not np.array_equal(controller.weights, before.weights)


@pytest.mark.parametrize("missing", ["references", "errors"])
def test_missing_blocks_and_values_are_bad_samples(missing: str) -> None:
    supervisor = supervised(MAKERS["FxLMS"]())
    good = np.random.default_rng(0).standard_normal(32)
    blocks = {"references": good, "errors": good}
    assert supervisor.process(**blocks | {missing: None}).shape == (32,)
    supervisor.process(**blocks | {missing: [*good[:-1].tolist(), None]})
    assert supervisor.health.samples["not finite"] == 33


@pytest.mark.parametrize("what", ["repeated", "lost"])
def test_nothing_is_learned_from_repeated_blocks_and_at_once_after_lost_ones(what: str) -> None:
    supervisor, rng = supervised(MAKERS["FxLMS"]()), np.random.default_rng(0)
    blocks = rng.standard_normal((10, 2, 32))
    for block in blocks:
        supervisor.process(*block)
    weights = supervisor.controller.weights
    lost = 2**53 if what == "lost" else 0
    supervisor.process(*(rng.standard_normal((2, 32)) if lost else blocks[-1]), lost=lost)
    np.testing.assert_array_equal(supervisor.controller.weights, weights)
    assert supervisor.health.samples == {what: lost or 64}
    for _ in range(1024 * (what == "lost")):  # the clock goes on beyond an integer of 64 bits
        supervisor.process([*rng.standard_normal(2), np.nan], rng.standard_normal(3), lost=lost)
    if lost:
        assert supervisor.health.events[-1].time_s == pytest.approx(1025 * 2**53 / FS)


@pytest.mark.parametrize(("name", "length"), [("FxLMS", 1), ("KF-OPC", 8000), ("FxLMS of several channels", 100)])
def test_the_noise_reduction_recovers_within_half_a_second(name: str, length: int) -> None:
    """After NaN in reference and error; the filter is not lost, so it need not learn anew."""
    several = name.endswith("channels")

    def spoil(x: np.ndarray, e: np.ndarray, first: int) -> tuple[Any, Any]:
        n = first + np.arange(BLOCK)
        bad = (n >= 24000) & (n < 24000 + length)
        x[:, bad] = e[:, bad] = np.nan
        return x, e

    free, faulty = plant(several, 5.0), plant(several, 5.0)
    _, expected = loop(supervised(MAKERS[name]()), free)
    _, got = loop(supervised(MAKERS[name]()), faulty, spoil)
    after = slice(24000 + length + 4000, 24000 + length + 8000)
    d = free.disturbance[:, : got.shape[1]]
    assert db(got[:, after], d[:, after]) > db(expected[:, after], d[:, after]) - 1.0


def diverging(**changed: Any) -> Supervisor:
    return supervised(fx_lms(24, -PATH, step_size=3e-3), **changed)  # wrong sign: it must diverge


def test_a_divergence_is_noticed_and_acted_on() -> None:
    supervisor = diverging(pause_s=0.5)
    y, _ = loop(supervisor, plant(seconds=4.0))
    counts = supervisor.health.counts
    assert counts["diverged: power"] >= 1
    assert counts["muted"] == counts["diverged: power"]
    assert np.max(np.abs(y)) <= LIMIT
    assert counts["running again"] >= 1
    assert np.mean(y == 0.0) > 0.3
    muted = [event.time_s for event in supervisor.health.events if event.what == "muted"]
    assert np.all(np.diff(muted) > 0.5)
    assert np.diff(muted)[-1] > np.diff(muted)[0]  # the pauses grow


@pytest.mark.parametrize(("gain", "last"), [(1.4, ""), (1.6, "power")])
def test_three_loud_windows_are_a_divergence_if_the_gain_has_grown(gain: float, last: str) -> None:
    adaptation, found = Adaptation(1, 10), []
    for level, weight in ((0.1, 1.0), *[(9.0, gain)] * 3):
        assert adaptation.play(np.full((1, 10), level))
        found.append(adaptation.judged(SimpleNamespace(weights=np.array([weight]), rated_power=1.0), 1e6))
    assert found == ["", "", "", last]


def test_long_faults_fade_out_and_in_again() -> None:
    def spoil(x: np.ndarray, e: np.ndarray, first: int) -> tuple[Any, Any]:
        return x, (np.full_like(e, np.nan) if 8000 <= first < 20000 else e)

    supervisor = supervised(MAKERS["FxLMS"](), mute_after_s=0.5)
    y, _ = loop(supervisor, plant(seconds=4.0), spoil)
    counts = supervisor.health.counts
    assert counts["silent: no usable input"] == counts["running again"] == 1
    assert y[0, 12000] != 0.0
    assert not np.any(y[0, 13000:19900])
    assert np.std(y[0, 21000:]) > 0.1


def test_a_users_controller_gets_all_channels_that_it_states() -> None:
    class Sum(Playing):
        n_references = 2

        def control_signal(self, reference: Any) -> np.ndarray:
            return np.sum(reference, keepdims=True)

    x = np.random.default_rng(0).standard_normal((2, 8))
    np.testing.assert_array_equal(supervised(Sum(abs)).process(x, 0.1 * x[:1]), [x[0] + x[1]])


@pytest.mark.parametrize("n_references", [0, 1], ids=["feedback", "hybrid"])
def test_an_internal_model_knows_of_fades_limits_and_bad_errors(n_references: int) -> None:
    """With an exact path, what is played is the settled filter's output for x and d(n - 1), faded and limited.

    The filter predicts a tone, so its loop gain is one: where it is not heard, it would oscillate by itself.
    """
    n, rng = round(4 * FS), np.random.default_rng(3)
    d, x = np.sin(0.2 * np.arange(n)) + 0.05 * rng.standard_normal(n), rng.standard_normal((n_references, n))
    path = PATH[np.newaxis, np.newaxis] if n_references else PATH
    supervisor = supervised(with_internal_model(fx_lms(24, path, step_size=1e-3, n_references=1 + n_references)))
    interface = SimulatedInterface(
        x if n_references else None, Plant(path[..., LATENCY:], fs=FS), disturbance=d, block=BLOCK, latency=LATENCY
    )
    out, back, spoilt, end = 20000, 22080, 22496, 22688  # the first samples of blocks
    weights = []

    def spoil(x: np.ndarray, e: np.ndarray, first: int) -> tuple[Any, Any]:
        if first in (out, back):
            (supervisor.fade_out if first == out else supervisor.fade_in)()
            supervisor.amplitude_limit = np.array([1.3])
        weights.append(supervisor.controller.weights)
        return (x if n_references else None), (np.full_like(e, np.nan) if spoilt <= first < end else e)

    y, _ = loop(supervisor, interface, spoil)
    settled = weights[out // BLOCK]
    np.testing.assert_array_equal(weights[end // BLOCK], settled)  # it never adapts between two faults
    known = np.where((np.arange(n) >= spoilt) & (np.arange(n) < end), 0.0, d)
    heard_before = np.concatenate((x, np.roll(known, 1)[np.newaxis]))
    filtered = sum(lfilter(w, 1.0, one) for w, one in zip(settled.reshape(-1, 24), heard_before, strict=True))
    fade = np.interp(np.arange(n), [out - 1, out - 1 + 400, back - 1, back - 1 + 400], [1.0, 0.0, 0.0, 1.0])
    until = end + supervisor.recovery_samples // BLOCK * BLOCK
    np.testing.assert_allclose(y[0, out:until], np.clip(fade * filtered, -1.3, 1.3)[out:until], rtol=0, atol=1e-9)
    assert supervisor.health.counts.keys() == {"limited", "not finite"}


def test_a_controller_with_a_longer_path_begins_as_if_nothing_had_been_played() -> None:
    n, begin = round(2 * FS), 8000
    d = np.sin(0.2 * np.arange(n)) + 0.05 * np.random.default_rng(3).standard_normal(n)

    def made(path: np.ndarray) -> Any:
        return with_internal_model(fx_lms(24, path, step_size=1e-3))

    def played(path: np.ndarray, d: np.ndarray, spoil: Any) -> tuple[np.ndarray, Supervisor]:
        supervisor = supervised(made(path))
        interface = SimulatedInterface(None, Plant(S, fs=FS), disturbance=d, block=BLOCK, latency=LATENCY)
        return loop(supervisor, interface, lambda x, e, first: spoil(supervisor, e, first))[0], supervisor

    def assign(supervisor: Supervisor, e: np.ndarray, first: int) -> tuple[None, np.ndarray]:
        if first == begin:
            supervisor.controller = made(longer)
        return None, e

    longer = np.pad(PATH, (0, 40))
    got, supervisor = played(PATH, d, assign)
    expected, _ = played(longer, d[begin:], lambda supervisor, e, first: (None, e))
    assert np.std(got[0, begin - 1000 : begin]) > 0.5  # of which the new one must not be told
    np.testing.assert_allclose(got[0, begin:], expected[0], rtol=0, atol=1e-9)  # sums in another order
    assert not supervisor.health.counts


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"amplitude_limit": 0.0}, "amplitude_limit must be greater than 0"),
        ({"full_scale": -1.0}, "full_scale must be greater than 0"),
        ({"louder_db": 101.0}, "louder_db must be at most 100 dB, got 101; louder_s=None never listens"),
        ({"controller": object()}, "controller must have control_signal"),
        (
            {"controller": kf_opc(8, PATH, rated_power=1.0, fs=16000, state_noise=1e-6, measurement_noise=1e-2)},
            "the run is at 8000 Hz: make it with the fs of the run",
        ),
    ],
)
def test_settings_that_are_out_of_range_are_refused(changed: dict[str, Any], message: str) -> None:
    with pytest.raises((TypeError, ValueError), match=message):
        supervised(**{"controller": MAKERS["FxLMS"]()} | changed)


def test_its_results_depend_on_the_blocks_only_through_the_windows() -> None:
    """Without a divergence, any cut of the signals gives the same control signals and finds the same faults."""
    x, e = 0.2 * np.random.default_rng(3).standard_normal((2, 8000))
    x[100:110], e[300] = np.nan, np.inf
    e[500:1500], x[3000:] = 0.3, x[3000:] + 0.7
    whole, parts = (supervised(MAKERS["FxLMS"](), full_scale=1.0) for _ in range(2))
    expected = whole.process(x, e)
    cuts = [0, 1, 50, 105, 513, 514, 1501, 3001, 8000]
    got = [parts.process(x[a:b], e[a:b]) for a, b in itertools.pairwise(cuts)]
    np.testing.assert_array_equal(np.concatenate(got), expected)
    assert parts.health.samples == whole.health.samples
    assert set(whole.health.samples) == {"not finite", "stuck", "offset", "clipped"}


@pytest.mark.parametrize("user", ["leaves it alone", "fades out in the pause"])
def test_a_pause_lasts_as_long_as_it_says_and_its_end_is_noted_once(user: str) -> None:
    """Blocks of 64: NaN in block 3, silence from block 4 on, 13 blocks are the first to make 800 samples."""
    faults = [200]  # the controller that replaces the first one is sound
    once = Playing(lambda n: np.nan if faults and n == faults[0] and faults.pop() else 1.0)
    supervisor = Supervisor(once, fs=FS, amplitude_limit=2.0, pause_s=0.1, fade_s=0.016, louder_s=None)
    rng = np.random.default_rng(0)
    y = []
    for block in range(30):
        if user != "leaves it alone" and block == 10:
            supervisor.fade_out()
        y.append(supervisor.process(*rng.standard_normal((2, 64))))
    again = [event.time_s for event in supervisor.health.events if event.what == "running again"]
    assert supervisor.health.counts["diverged: not finite"] == 1
    assert np.all(np.isfinite(y))
    assert np.any(y[3])
    assert not np.any(y[4:17])
    if user == "leaves it alone":
        assert again == [16 * 64 / FS]
        np.testing.assert_allclose(y[17], np.arange(1, 65) / 128)  # fades in over 0.016 s
        np.testing.assert_array_equal(y[19:], 1.0)
    else:
        assert not again
        assert not np.any(y[17:])
        assert supervisor.muted


@pytest.mark.parametrize("kind", ["refuses", "fails"])
def test_a_controller_that_cannot_go_on_is_replaced(kind: str) -> None:
    class Broken(Playing):
        def update(self, error: float) -> None:
            if kind == "refuses" and self.n > 1000:
                raise ValueError("cannot go on")

    def played(n: int) -> float:
        if kind == "fails" and n == 3000:
            raise RuntimeError("out of order")
        return 0.1

    supervisor = supervised(Broken(played), pause_s=0.05)
    noise = np.random.default_rng(0).standard_normal((100, 2, 64))
    y = np.concatenate([supervisor.process(*block) for block in noise])
    begin = 64 * (15 if kind == "refuses" else 46)  # of the block in which that is
    np.testing.assert_array_equal(y[begin - 64 : begin + 64], np.repeat([0.1, 0.0], 64))
    what = "RefusedUpdate: cannot go on" if kind == "refuses" else "RuntimeError: out of order"
    assert supervisor.health.counts[f"diverged: {what}"] >= 1
    assert supervisor.controller.n < 6400


def test_silence_with_bad_samples_keeps_the_delay_lines_in_time() -> None:
    """What is heard in silence after a bad sample is what a controller hears that was never disturbed."""
    supervisor, other = supervised(MAKERS["KF-OPC"](), louder_s=1.0), MAKERS["KF-OPC"]()
    supervisor.fade_out()
    x, e = np.random.default_rng(0).standard_normal((2, 2000))
    bad = x.copy()
    bad[100] = np.nan
    for n in range(0, 2000, 50):
        supervisor.process(bad[n : n + 50], e[n : n + 50])
    clean = np.where(np.isnan(bad), 0.0, bad)
    adapt = np.ones(2000, bool)
    adapt[100 : 101 + supervisor.recovery_samples] = False
    other.listen(clean, e, adapt=adapt)
    assert supervisor.controller.disturbance_power == other.disturbance_power
    np.testing.assert_array_equal(supervisor.process(x[:50], e[:50]), 0.0)
    supervisor.controller.listen(x[:1], e[:1])


@pytest.mark.parametrize(
    ("lost", "error", "message"),
    [
        (1.5, TypeError, "lost must be a whole number"),
        (-1, ValueError, "lost must be at least 0"),
        (10**400, ValueError, "lost must be finite"),
        (2**53 + 1, ValueError, "lost must be at most 9007199254740992 samples"),
    ],
    ids=["fraction", "negative", "beyond a float", "beyond a clock"],
)
def test_a_wrong_number_of_lost_samples_changes_nothing(lost: Any, error: type[Exception], message: str) -> None:
    supervisor, block = supervised(MAKERS["FxLMS"]()), np.full(8, np.nan)
    with pytest.raises(error, match=message):
        supervisor.process(block, block, lost=lost)
    assert not supervisor.health.samples
    supervisor.process([None] * 7 + [1.0], block, lost=2)
    assert supervisor.health.samples == {"not finite": 15, "lost": 2}
