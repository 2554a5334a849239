"""`simulate` with several controllers: each run is as it is alone, to the bit, whether gains are shared or not."""

import copy
import math

import numpy as np
import pytest
from helpers.comparing import assert_goes_on_as, assert_same_run
from helpers.loop import AMPLIFIERS, FS, S_HAT, S
from helpers.simulation import Integrator, Stepwise

from kfopc_filterpy import (
    KFOPC,
    HardClipAmplifier,
    KalmanController,
    OutputPowerConstraint,
    Plant,
    fx_lms,
    kf_anc,
    kf_opc,
    kf_pb,
    simulate,
)
from kfopc_filterpy.loop import simulation
from kfopc_filterpy.loop.inputs import STRETCH


def filters(count, n_taps=7, *, secondary=S_HAT, window="exponential", **options):
    """KF-OPC of different rated powers, every third a KF-ANC (not with a sliding window); some know their amplifier."""
    kalman = {"state_noise": 1e-5, "measurement_noise": 0.1, "initial_variance": 0.5} | options
    known = [HardClipAmplifier(0.7) if i % 4 == 2 else None for i in range(count)]
    constraints = [OutputPowerConstraint(0.1 * 1.5**i, fs=FS, memory_s=0.01, window=window) for i in range(count)]
    return [
        kf_anc(n_taps, secondary, amplifier=known[i], **kalman)
        if i % 3 == 2 and window == "exponential"
        else kf_opc(n_taps, secondary, constraint=constraints[i], amplifier=known[i], **kalman)
        for i in range(count)
    ]


def differing(count, n, seed=3):
    """A reference, and what differs from one run to the next."""
    x, *others = np.random.default_rng(seed).standard_normal((count + 1, n))
    amplifiers = [ours for ours, _ in AMPLIFIERS.values()]
    plants = [
        Plant(
            (0.9 + 0.2 * i / count) * S * (np.arange(5) < 3 + i % 3),
            amplifier=amplifiers[i % 4],
            fs=FS,
            sensor_noise_std=0.05 * (i % 3),  # some have none
        )
        for i in range(count)
    ]
    disturbances = [np.convolve(x, [0.0, 0.0, 1.2, -0.7, 0.1 * i])[:n] + 0.1 * own for i, own in enumerate(others)]
    return x, plants, {"disturbance": disturbances, "rng": [100 + i for i in range(count)]}


def one_by_one(made, x, plants, own, **options):
    """`simulate` for each, with its own of each list."""
    each = [{name: values[i] for name, values in own.items()} for i in range(len(made))]
    return [simulate(c, x, plant, **mine, **options) for c, plant, mine in zip(made, plants, each, strict=True)]


def assert_as_alone(results, expected, made=(), alone=()):
    """To the bit: the same sums in the same order."""
    for got, want in zip(results, expected, strict=True):
        assert_same_run(got, want)
    assert_same_state(made, alone)


def assert_same_state(made, others):
    for one, other in zip(made, others, strict=True):
        assert_goes_on_as(one, other)


@pytest.fixture
def shared(monkeypatch):
    """The numbers of runs that shared gains."""
    counts = []

    def noted(runs, progress):
        counts.append(len(runs))
        return run_together(runs, progress)

    run_together = simulation.run_together
    monkeypatch.setattr(simulation, "run_together", noted)
    return counts


@pytest.mark.parametrize(
    ("count", "n", "of_filters", "on"),
    [
        (3, 777, {"n_taps": 1}, 0),
        (35, 300, {}, 0),  # groups of 32 inside
        *((3, n, {}, 0) for n in (1, 64, STRETCH, 3 * STRETCH + 1)),
        (9, 400, {}, 123),  # each has heard its own disturbance before
        (9, 400, {"window": "sliding"}, 30),
    ],
)
def test_runs_that_share_gains_are_their_runs_one_by_one(shared, count, n, of_filters, on):
    made, alone = (filters(count, **of_filters) for _ in range(2))
    x, plants, own = differing(count, n)
    results = simulate(made, x, plants, switch_on_s=on / FS, **own)
    assert shared == [count]
    assert_as_alone(results, one_by_one(alone, x, plants, own, switch_on_s=on / FS), made, alone)
    assert len({r.error.tobytes() for r in results}) == count
    if n > 300:
        assert min(r.constraint_factor.min() for r in results) < 0.9  # it did act, and so did the amplifiers
        saturated = {i % 4 for i, r in enumerate(results) if np.any(r.amplifier_output != r.control_signal)}
        assert saturated == {2, 3} & set(range(count))


KALMAN = {"state_noise": 1e-5, "measurement_noise": 0.1}
APART = {  # what cannot share with a plain KF-ANC, each for a reason of its own
    "KF-PB learns the plant": lambda: kf_pb(7, S_HAT, rated_power=1.0, fs=FS),
    "steps in Python": lambda: KalmanController(KFOPC(7), S_HAT),
    "a user's class": Integrator,
    "hidden in a user's class": lambda: Stepwise(kf_anc(7, S_HAT, **KALMAN)),
    "other taps": lambda: kf_anc(6, S_HAT, **KALMAN),
    "another path": lambda: kf_anc(7, 0.9 * S_HAT, **KALMAN),
    "another noise": lambda: kf_anc(7, S_HAT, state_noise=1e-4, measurement_noise=0.1),
    "another law": lambda: fx_lms(7, S_HAT, step_size=0.01),
}


def test_those_that_cannot_share_run_alone_in_their_places(shared):
    x, (plant, *_), own = differing(1, 400)
    together = [kf_anc(7, S_HAT, **KALMAN), *(make() for make in APART.values()), kf_anc(7, S_HAT, **KALMAN)]
    alone = copy.deepcopy(together)
    options = {"disturbance": own["disturbance"][0], "rng": 1}
    results = simulate(together, x, plant, **options)
    assert shared == [2]
    assert_as_alone(results, [simulate(c, x, plant, **options) for c in alone])


@pytest.mark.parametrize(
    "plant",
    [
        Plant(S, fs=FS).changed_at(0.01, secondary=-S),
        Plant(S, feedback=[0.0, 0.1], fs=FS),
        Plant(S, amplifier=math.tanh, fs=FS),
    ],
    ids=["changes", "feedback", "a user's amplifier"],
)
def test_plants_that_do_not_allow_to_share(shared, plant):
    x, _, own = differing(1, 200)
    made, alone = ([kf_anc(7, S_HAT, **KALMAN), kf_anc(7, S_HAT, **KALMAN)] for _ in range(2))
    results = simulate(made, x, plant, disturbance=own["disturbance"][0])
    assert shared == []
    assert_as_alone(results, [simulate(c, x, plant, disturbance=own["disturbance"][0]) for c in alone], made, alone)


def test_an_interrupted_run_leaves_the_controllers_as_they_were():
    """All or nothing: a covariance a block ahead of the weights would be neither."""
    x, plants, own = differing(9, 3 * STRETCH)
    made, alone, calls = filters(9), filters(9), []

    def interrupt(n_samples):
        calls.append(n_samples)
        if len(calls) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(made, x, plants, progress=interrupt, **own)
    assert_same_state(made, alone)


def test_a_run_that_diverges_leaves_the_others_alone():
    """A disturbance a million times what the amplifier can cancel."""
    count, bad, n = 11, 8, 1500
    made, alone = (filters(count, state_noise=1e-2) for _ in range(2))
    x, _, own = differing(count, n)
    plants = [Plant(np.append(S_HAT, 0.0), amplifier=HardClipAmplifier(5.0), fs=FS)] * count
    own["disturbance"][bad] = 1e6 * own["disturbance"][bad]
    results = simulate(made, x, plants, **own)
    rest = [i for i in range(count) if i != bad]
    expected = one_by_one(alone, x, plants, own)
    assert_as_alone(results, expected, [made[i] for i in rest], [alone[i] for i in rest])
    assert [i for i in range(count) if results[i].diverged_at_s is not None] == [bad]
    np.testing.assert_array_equal(made[bad].weights, alone[bad].weights)
    np.testing.assert_array_equal(made[bad].covariance, made[0].covariance)  # that of the end of the run
    end = round(results[bad].diverged_at_s * FS)
    assert 0 < end < n
    for name in ("error", "control_signal", "amplifier_output", "anti_noise", "constraint_factor", "disturbance_power"):
        np.testing.assert_array_equal(np.isnan(getattr(results[bad], name)), np.arange(n) >= end, err_msg=name)


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("disturbance", r"too loud.*sample 50 of the run, the loudest error is that of run 4"),
        ("reference", r"the reference is too loud.*\(sample 50 of the run\)"),
    ],
)
def test_a_signal_whose_square_overflows_is_named_with_run_and_sample(what, message):
    x, plants, own = differing(9, 300)
    (own["disturbance"][4] if what == "disturbance" else x)[50] = 1e200
    made, untouched = filters(9), filters(9)
    with pytest.raises(ValueError, match=message):
        simulate(made, x, plants, **own)
    assert_same_state(made, untouched)


X, PLANTS, OWN = differing(3, 50)
REFUSED = [
    (lambda made, options: made.clear(), ValueError, "controllers must hold one controller at least"),
    (lambda made, options: made.__setitem__(1, made[0]), ValueError, r"controllers\[1\] is in the list twice"),
    (lambda made, options: options.update(plant=PLANTS[:2]), ValueError, "plant must be one for all .* a list of 3"),
    (lambda made, options: options.update(rng=[1, 2]), ValueError, "rng must be one for all controllers"),
    (lambda made, options: options["disturbance"].append(X), ValueError, "disturbance must be one for all"),
    (
        lambda made, options: options.update(rng=np.random.default_rng(0)),
        ValueError,
        "rng is one Generator for several",
    ),
    (lambda made, options: options["disturbance"].__setitem__(2, X[:-1]), ValueError, r"got \(1, 49\)"),
]


@pytest.mark.parametrize(("spoil", "kind", "message"), REFUSED, ids=[message[:40] for *_, message in REFUSED])
def test_refused_with_nothing_changed(spoil, kind, message):
    made = filters(3)
    options = {"plant": PLANTS, "disturbance": list(OWN["disturbance"]), "rng": OWN["rng"], "switch_on_s": 10 / FS}
    spoil(made, options)
    before = copy.deepcopy([one for one in made if hasattr(one, "update")])
    with pytest.raises(kind, match=message):
        simulate(made, X, **options)
    assert_same_state([one for one in made if hasattr(one, "update")], before)
