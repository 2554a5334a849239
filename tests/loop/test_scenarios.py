"""`simulate_scenarios`: many runs on one gain sequence, each as `simulate` leaves it alone."""

import copy
import math

import numpy as np
import pytest
from helpers.comparing import assert_goes_on_as, assert_same_run
from helpers.loop import AMPLIFIERS, S_HAT, S

from kfopc_filterpy import (
    KFOPC,
    FxLMS,
    HardClipAmplifier,
    KalmanController,
    MOVFxLMS,
    OutputLimiter,
    OutputPowerConstraint,
    fx_rls,
    kf_anc,
    kf_opc,
    kf_pb,
    simulate,
)
from kfopc_filterpy import simulate_scenarios as run_scenarios
from kfopc_filterpy.loop import scenarios
from kfopc_filterpy.paths import fir_path

FS = 8000.0
STRETCH = scenarios.STRETCH


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
    """A reference, and what differs from one scenario to the next."""
    x, *others = np.random.default_rng(seed).standard_normal((count + 1, n))
    amplifiers = [ours for ours, _ in AMPLIFIERS.values()]
    return x, {
        "disturbance": np.array(
            [np.convolve(x, [0.0, 0.0, 1.2, -0.7, 0.1 * i])[:n] + 0.1 * own for i, own in enumerate(others)]
        ),
        "amplifier": [amplifiers[i % 4] for i in range(count)],
        "sensor_noise_std": [0.05 * (1 + i % 3) for i in range(count)],
        "rng": [100 + i for i in range(count)],
        "secondary_path": [(0.9 + 0.2 * i / count) * S * (np.arange(5) < 3 + i % 3) for i in range(count)],
    }


def one_by_one(made, x, own, **options):
    """`simulate` for each, with its own of each list."""
    each = [{name: values[i] for name, values in own.items()} for i in range(len(made))]
    return [simulate(c, x, fs=FS, **mine, **options) for c, mine in zip(made, each, strict=True)]


def assert_as_alone(results, expected, made=(), alone=()):
    """To the bit: the same sums in the same order."""
    for got, want in zip(results, expected, strict=True):
        assert_same_run(got, want)
    assert_untouched(made, alone)


def assert_untouched(made, fresh):
    for one, other in zip(made, fresh, strict=True):
        assert_goes_on_as(one, other)


# ---- As run one by one


@pytest.mark.parametrize(
    ("count", "n", "of_filters", "of_run"),
    [
        *(
            (count, 777, {"n_taps": taps}, {}) for count, taps in ((1, 7), (3, 1), (9, 40), (35, 7))
        ),  # groups of 32 inside
        *((3, n, {}, {"rated_power": 2.0}) for n in (1, 64, 129, STRETCH, 3 * STRETCH + 1)),
        *((count, 400, {}, {"switch_on_s": 123 / FS}) for count in (2, 9)),  # each has heard its own disturbance before
        (9, 400, {"window": "sliding"}, {"switch_on_s": 30 / FS}),
    ],
)
def test_scenarios_are_their_runs_one_by_one(count, n, of_filters, of_run):
    made, alone = (filters(count, **of_filters) for _ in range(2))
    x, own = differing(count, n)
    results = run_scenarios(made, x, fs=FS, record_powers=True, **own, **of_run)
    assert_as_alone(results, one_by_one(alone, x, own, record_powers=True, **of_run), made, alone)
    assert len({r.error.tobytes() for r in results}) == count
    if n > 300:
        assert min(r.constraint_factor.min() for r in results) < 0.9  # it did act, and so did the amplifiers
        saturated = {i % 4 for i, r in enumerate(results) if np.any(r.amplifier_output != r.control_signal)}
        assert saturated == {2, 3} & set(range(count))


def test_progress_comes_after_each_block():
    x, own = differing(9, STRETCH + 7)
    counts = []
    run_scenarios(filters(9), x, fs=FS, progress=counts.append, **own)
    assert counts == [9 * STRETCH, 9 * 7]


def limited(rated_power):
    made = kf_opc(7, S_HAT, rated_power=rated_power, state_noise=1e-5, measurement_noise=0.1)
    made.limiter = OutputLimiter(rated_power, fs=16000.0)
    made.secondary_path_uncertainty = 1.0
    return made


def supplied(rated_power):
    made = kf_opc(7, S_HAT, rated_power=rated_power, state_noise=1e-5, measurement_noise=0.1)
    made.constraint.factor = rated_power
    return made


ALGORITHMS = {
    "FxRLS": lambda _: fx_rls(7, S_HAT, forgetting=0.999),
    "limiter and guard": limited,
    "factor supplied": supplied,
    "FxLMS": lambda _: FxLMS(7, S_HAT, step_size=0.01),
    "MOV-FxLMS": lambda power: MOVFxLMS(7, S_HAT, step_size=0.01, rated_power=power),
}


@pytest.mark.parametrize("name", ALGORITHMS)
def test_any_algorithm_of_the_core(name):
    made, alone = ([ALGORITHMS[name](power) for power in (0.05, 0.1, 0.4)] for _ in range(2))
    x, own = differing(3, 500)
    for run in range(2):  # and they go on
        results = run_scenarios(made, x, **own)
        expected = [simulate(c, x, **{key: values[i] for key, values in own.items()}) for i, c in enumerate(alone)]
        assert_as_alone(results, expected, made, alone)
        assert len({r.control_signal.tobytes() for r in results}) == 3, run


@pytest.mark.parametrize("primary", [False, True])
def test_what_is_one_for_all(primary):
    """One amplifier, path, disturbance or primary path; and one seed: each hears the same noise, and before the switch."""
    x, own = differing(1, 300)
    options = {"amplifier": HardClipAmplifier(0.7), "sensor_noise_std": 0.1, "rng": 5, "secondary_path": S.tolist()}
    options["switch_on_s"] = 20 / FS
    options |= {"primary_path": [0.0, 0.0, 1.2, -0.7]} if primary else {"disturbance": own["disturbance"][0]}
    made, alone = filters(9), filters(9)
    results = run_scenarios(made, x, fs=FS, **options)
    assert_as_alone(results, one_by_one(alone, x, {}, **options), made, alone)
    noise = results[0].error - results[0].disturbance + results[0].anti_noise
    np.testing.assert_allclose(noise, 0.1 * np.random.default_rng(5).standard_normal(300)[20:], rtol=0, atol=1e-14)


def test_systems_generators_and_other_sequences_one_each():
    x, own = differing(3, 200)
    given = {
        "secondary_path": [fir_path(np.trim_zeros(s, "b"), FS) for s in own["secondary_path"]],
        "sensor_noise_std": np.array(own["sensor_noise_std"]),
        "rng": [np.random.default_rng(seed) for seed in own["rng"]],
        "amplifier": tuple(own["amplifier"]),
        "disturbance": own["disturbance"].tolist(),
    }
    results, plain = (run_scenarios(filters(3), x, fs=FS, **each) for each in (given, own))
    x[:], own["disturbance"][:] = 0.0, 0.0  # the results are no views of what was given
    assert_as_alone(results, plain)
    assert np.all(plain[0].reference)
    assert np.all(plain[0].disturbance)


# ---- The controllers afterwards


def test_an_interrupted_run_leaves_the_controllers_as_they_were():
    """All or nothing: a covariance a block ahead of the weights would be neither."""
    x, own = differing(9, 3 * STRETCH)
    made, alone, calls = filters(9), filters(9), []

    def interrupt(n_samples):
        calls.append(n_samples)
        if len(calls) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_scenarios(made, x, fs=FS, progress=interrupt, **own)
    assert_untouched(made, alone)
    assert_as_alone(run_scenarios(made, x, fs=FS, **own), one_by_one(alone, x, own), made, alone)


# ---- Divergence, and samples that are refused


@pytest.mark.parametrize("cause", ["path", "disturbance"])
def test_a_scenario_that_diverges_leaves_the_others_alone(cause):
    """A true path of the wrong sign; or a disturbance a million times what the amplifier can cancel."""
    count, bad, n = 11, 8, 1500
    made, alone = (filters(count, state_noise=1e-2) for _ in range(2))
    x, own = differing(count, n)
    own |= {"amplifier": [HardClipAmplifier(5.0) if cause == "disturbance" else None] * count}
    own |= {"secondary_path": [np.append(S_HAT, 0.0) for _ in range(count)]}
    own["secondary_path" if cause == "path" else "disturbance"][bad] *= -1.0 if cause == "path" else 1e6
    options = {"record_powers": True, "rated_power": 1e-4 if cause == "path" else None}  # another limit, an earlier end
    results = run_scenarios(made, x, fs=FS, **own, **options)
    rest = [i for i in range(count) if i != bad]
    one_each = one_by_one(alone, x, own, **options)
    assert_as_alone(results, one_each, [made[i] for i in rest], [alone[i] for i in rest])
    assert [i for i in range(count) if results[i].diverged_at_s is not None] == [bad]
    np.testing.assert_array_equal(made[bad].weights, alone[bad].weights)
    np.testing.assert_array_equal(made[bad].covariance, made[0].covariance)  # that of the end of the run
    end = round(results[bad].diverged_at_s * FS)
    assert 0 < end < n
    for name in ("error", "control_signal", "amplifier_output", "anti_noise", "constraint_factor", "disturbance_power"):
        np.testing.assert_array_equal(np.isnan(getattr(results[bad], name)), np.arange(n) >= end, err_msg=name)


def test_when_all_have_diverged_the_run_ends():
    x, own = differing(3, 3000)
    own |= {"secondary_path": [-scale * np.append(S_HAT, 0.0) for scale in (1.0, 2.0, 4.0)], "amplifier": [None] * 3}
    noises, counts = {"state_noise": 1e-2, "measurement_noise": 0.1}, []
    made, alone = ([kf_anc(7, S_HAT, **noises) for _ in range(3)] for _ in range(2))
    results = run_scenarios(made, x, fs=FS, rated_power=1e-4, progress=counts.append, **own)
    ends = [r.diverged_at_s for r in results]
    assert len(set(ends)) > 1
    assert ends == [r.diverged_at_s for r in one_by_one(alone, x, own, rated_power=1e-4)]
    assert sum(counts) == 3 * round(max(ends) * FS)


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("disturbance", r"too loud.*sample 50 of the run, the loudest error is controllers\[4\]'s"),
        ("reference", r"the reference is too loud.*\(sample 50 of the run\)"),
    ],
)
def test_a_signal_whose_square_overflows_is_named_with_scenario_and_sample(what, message):
    x, own = differing(9, 300)
    (own["disturbance"][4] if what == "disturbance" else x)[50] = 1e200
    made, untouched = filters(9), filters(9)
    with pytest.raises(ValueError, match=message):
        run_scenarios(made, x, fs=FS, **own)
    assert_untouched(made, untouched)


# ---- What each scenario may have of its own


@pytest.mark.parametrize("several", [lambda one: one, lambda one: [one, 1, one]])
def test_one_generator_for_several_scenarios_is_refused(several):
    """They would draw from it in turns, and what each gets would depend on the length of the blocks."""
    x, own = differing(3, 50)
    with pytest.raises(ValueError, match="rng holds one Generator for several controllers"):
        run_scenarios(filters(3), x, fs=FS, **own | {"rng": several(np.random.default_rng(0))})


# ---- Refusals

X, OWN = differing(3, 50)
D = OWN["disturbance"]


def one_of_three(heard=(), **options):
    """Three filters, the second of other options; or the last ones have heard X of one sign or the other."""
    made = filters(3)
    made[1] = filters(2, **options)[1]
    for c, sign in zip(made[::-1], heard, strict=False):
        simulate(c, sign * X, disturbance=D[0], secondary_path=S, fs=FS)
    return made


HEARD = r"controllers\[2\] must agree in the reference heard so far"
TWICE = r"controllers\[1\] is in the list twice"
AGREE = r"controllers\[0\] and controllers\[1\] must agree in "
REFUSED = [
    (list, ValueError, "controllers must hold one controller at least"),
    (lambda: filters(1)[0], TypeError, r"controllers must be a sequence of controllers: \[controller\] for one"),
    (
        lambda: [*filters(2), FxLMS(7, S_HAT, step_size=0.1)],
        ValueError,
        r"controllers\[2\] must agree in the algorithm",
    ),
    (lambda: [*filters(2), "KF-OPC"], TypeError, r"controllers\[2\] must be a controller of the core.*got 'KF-OPC'"),
    (
        lambda: [kf_pb(7, S_HAT, rated_power=1.0, fs=FS)] * 2,
        ValueError,
        r"controllers\[0\], KF-PB, learns the plant.*: use simulate",
    ),
    (lambda: [kf_anc(7, S_HAT[None, None], state_noise=1e-5, measurement_noise=0.1)], TypeError, "of one channel"),
    (lambda: [KalmanController(KFOPC(7), S)], ValueError, r"controllers\[0\] has steps of its own in Python"),
    (lambda: filters(1) * 3, ValueError, TWICE),
    (lambda: one_of_three(n_taps=6), ValueError, AGREE + "n_taps"),
    (lambda: one_of_three(secondary=0.9 * S_HAT), ValueError, AGREE + "their estimated secondary path"),
    (lambda: one_of_three(window="sliding"), ValueError, AGREE + "the length of the sliding windows of their powers"),
    (lambda: one_of_three(heard=[-1, 1, 1]), ValueError, HEARD),  # with the same covariance
    ({"amplifier": [None] * 2}, ValueError, "amplifier must be one value or 3, one for each controller, got 2"),
    ({"rng": [1, 2], "sensor_noise_std": 0.1}, ValueError, "rng must be one value or 3"),
    ({"disturbance": D[:, :-1]}, ValueError, "disturbance must have 50 values, got 49"),
    ({"amplifier": math.tanh}, TypeError, "amplifier must be one of the package's models or None, .* use simulate"),
    ({"fs": 16000.0}, ValueError, "fs is 16000 Hz but the controller's power memory is for 8000 Hz"),
]


@pytest.mark.parametrize(("wrong", "kind", "message"), REFUSED, ids=[message[:60] for *_, message in REFUSED])
def test_refused_with_nothing_changed(wrong, kind, message):
    options = {"reference": X, "disturbance": D, "secondary_path": S, "fs": FS, "switch_on_s": 10 / FS}
    made = wrong() if callable(wrong) else filters(3)
    if not callable(wrong):  # with all in order they run, before and after
        run_scenarios(made, **options)
        options |= wrong
    before = copy.deepcopy(made)
    with pytest.raises(kind, match=message):
        run_scenarios(made, **options)
    assert_untouched(*([c for c in np.ravel(each) if hasattr(c, "update")] for each in (made, before)))
    if not callable(wrong):
        run_scenarios(made, X, disturbance=D, secondary_path=S, fs=FS)
