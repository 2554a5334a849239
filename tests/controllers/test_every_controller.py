"""What holds for every controller of the package, with every option that changes what it keeps, and for what wraps one.

That it is saved, copied and pickled to the bit is in `test_checkpoint.py`, with the same controllers; that nothing makes it
loud, in `test_little_excitation.py`.
"""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from helpers.channels import random_paths
from helpers.checkpoints import Room
from helpers.comparing import assert_same_run
from helpers.controllers import ALL, IN_BLOCKS, KALMAN, PATHS, I, J, K
from helpers.loop import AMPLIFIERS, FEEDBACK, FS, N_TAPS, S_HAT, S, noises
from helpers.simulation import Stepwise
from hypothesis import given, settings
from hypothesis import strategies as st

from kfopc_filterpy import HardClipAmplifier, Plant, kf_opc, simulate
from kfopc_filterpy.checkpoint import content_of
from kfopc_filterpy.controllers import RefusedUpdate
from kfopc_filterpy.controllers.frequency_domain import FrequencyDomainController

# What a step refuses, and what it takes.
LOUD = [-1e160, 1e308]
UNUSABLE = [np.nan, np.inf, *LOUD, "1.0", b"1", 1j, object(), 10**400, np.ma.masked, np.datetime64("2020-01-01")]
HUGE = [1e12, -1e24, 1e49]
PYTHONS = [name for name in ALL if "filterpy's" in name or "a user's" in name]  # filters whose steps are in Python


def scene_for(controller: Any, n: int = 300) -> tuple[Any, Plant, dict[str, Any]]:
    """Return a reference or None, a plant with all that it can have, which changes, and options of `simulate`."""
    heard = getattr(controller, "n_references", 1) > 0
    fed_back = heard and not isinstance(
        controller, FrequencyDomainController
    )  # with feedback, blocks end at each sample
    options: dict[str, Any] = {"rng": 1, "record_weights_every": 7, "switch_on_s": 20 / FS}
    if Room(controller).d.ndim == 2:
        rng = np.random.default_rng(3)
        x, d, secondary = rng.standard_normal((I, n)), rng.standard_normal((K, n)), 1.1 * PATHS
        feedback, amplifier = 0.02 * random_paths(I, J, 5, seed=4), [HardClipAmplifier(1.0), None]
    else:
        x, d, _ = noises(n)
        secondary, feedback, amplifier = S, FEEDBACK, AMPLIFIERS["soft"][0]
    plant = Plant(
        secondary, feedback=feedback if fed_back else None, amplifier=amplifier, fs=FS, sensor_noise_std=0.02
    ).changed_at(66 / FS, secondary=0.9 * secondary)  # within a block
    if not hasattr(controller, "listen"):
        del options["switch_on_s"]
    return (x if heard else None), plant, options | {"disturbance": d}


# One algorithm: a run in compiled code, blocks, and steps from Python.


@pytest.mark.parametrize("name", ALL)
def test_a_run_is_the_steps_bit_for_bit(name: str) -> None:
    """With feedback, amplifiers, sensor noise, and a controller that first listens; and they go on alike."""
    fast, slow = ALL[name](), ALL[name]()
    x, plant, options = scene_for(fast)
    result = simulate(fast, x, plant, **options)
    assert_same_run(result, simulate(Stepwise(slow), x, plant, **options))
    assert content_of(fast) == content_of(slow)
    assert np.any(np.abs(np.diff(result.weights, axis=0)) > 0)
    if name.endswith(" limiter"):
        assert fast.limiter.gain < 1.0  # it did act
    assert_same_run(*(simulate(one, x, plant, **options) for one in (Stepwise(fast), slow)))
    assert content_of(fast) == content_of(slow)


@pytest.mark.parametrize("name", IN_BLOCKS)
def test_a_run_by_blocks_that_diverges_ends_where_its_steps_do(name: str) -> None:
    fast, slow = IN_BLOCKS[name](), IN_BLOCKS[name]()
    x, plant, options = scene_for(fast)
    usual = simulate(IN_BLOCKS[name](), x, plant, **options)
    options["disturbance"] *= 1.1e6 / np.abs(usual.control_signal).max()  # a run stops at 1e6
    result = simulate(fast, x, plant, **options)
    assert result.diverged_at_s is not None
    assert result.diverged_at_s > 0.0
    assert_same_run(result, simulate(Stepwise(slow), x, plant, **options))


def step(controller: Any, x: Any, e: Any, adapts: bool = True) -> Any:
    """Take a sample by steps; an error that is not adapted to is still told to an internal model."""
    y = controller.control_signal(x)
    if adapts:
        controller.update(e)
    elif getattr(controller, "internal_model", False):
        controller.take_error(e)
    return y


@pytest.mark.parametrize("name", ALL)
def test_blocks_are_the_steps_bit_for_bit(name: str) -> None:
    """However a recording is cut into blocks, and whichever samples are not adapted to."""
    blocks, steps = ALL[name](), ALL[name]()
    x, d = Room(blocks).heard(slice(300))
    adapt = np.random.default_rng(1).random(300) < 0.9
    adapt[-1] = True  # what follows a sample that is left out is done with the next one
    expected = [step(steps, None if x is None else x[..., n], d[..., n], adapt[n]) for n in range(300)]
    got = [
        blocks.process(None if x is None else x[..., a:b], d[..., a:b], adapt=adapt[a:b])
        for a, b in itertools.pairwise([0, 1, 2, 18, 82, 83, 300])
    ]
    np.testing.assert_array_equal(np.concatenate(got, axis=-1), np.transpose(expected))
    assert content_of(blocks) == content_of(steps)


@pytest.mark.parametrize("name", ALL)
def test_runs_together_are_the_runs_one_by_one(name: str) -> None:
    """To the bit, whether they share gains or not, after listening, too."""
    together, alone = ([ALL[name]() for _ in range(3)] for _ in range(2))
    x, plant, options = scene_for(together[0])
    plants = [Plant(gain * plant.secondary, fs=FS, sensor_noise_std=0.1 * gain) for gain in (0.9, 1.0, 1.2)]
    d = [gain * options["disturbance"] for gain in (1.0, 0.7, -1.2)]
    results = simulate(together, x, plants, **options | {"disturbance": d, "rng": [1, 2, 3]})
    for k, result in enumerate(results):
        options |= {"disturbance": d[k], "rng": 1 + k}
        assert_same_run(result, simulate(alone[k], x, plants[k], **options))
        assert content_of(together[k]) == content_of(alone[k])
    assert not np.array_equal(results[0].error, results[1].error)


# What is refused leaves no trace, and what is taken is overcome.


def bad_sample(controller: Any, room: Room, half: str, value: Any, samples: int) -> tuple[bytes, Exception | None]:
    """Return what was held before a bad sample, and the error that it raised, if any."""
    room.run(controller, samples)
    if half == "update":
        room.play(controller)
    sample = room.heard(room.n)[half == "update"]
    given: Any = np.array(sample, dtype=object)
    if given.ndim:
        given[0] = value
    before = content_of(controller)
    try:
        getattr(controller, half)(given if given.ndim else value)
    except (TypeError, ValueError) as error:
        return before, error
    return before, None


@pytest.mark.parametrize("half", ["control_signal", "update"])
@pytest.mark.parametrize("name", ALL)
@settings(max_examples=6)
@given(value=st.sampled_from([*UNUSABLE, *HUGE]), samples=st.integers(0, 60))
def test_a_refused_sample_leaves_the_state_as_it_was(name: str, half: str, value: Any, samples: int) -> None:
    controller = ALL[name]()
    room = Room(controller)
    before, refused = bad_sample(controller, room, half, value, samples)
    if refused is None:
        taken_by_users_own = name == "LimitedController" and value in LOUD
        assert taken_by_users_own or not any(value is one for one in UNUSABLE), "it was taken"
        return
    assert content_of(controller) == before
    if half == "update":
        room.n += 1  # the run goes on without it
    room.run(controller, 20)
    assert np.isfinite(controller.weights).all()


@pytest.mark.parametrize("half", ["control_signal", "update"])
@pytest.mark.parametrize("name", [n for n in ALL if n not in ("FeedbackNeutralizer", "feedback FxLMS", "feedback MOV")])
def test_a_huge_sample_is_overcome(name: str, half: str) -> None:
    """In a closed loop; 1000 samples later nothing is refused, and nothing is infinite.

    FxLMS has learned huge weights by then: with them, what a neutraliser or an internal model subtracts is an unstable loop.
    """
    for value in HUGE:
        controller = ALL[name]()
        room, refusals = Room(controller), 0
        bad_sample(controller, room, half, value, 60)
        for n in range(1000):
            room.n = n % 300
            try:
                room.run(controller, 1)
            except ValueError:
                refusals = n
        assert refusals < 900, value
        assert np.isfinite(controller.weights).all(), value


@pytest.mark.parametrize("name", ALL)
def test_bad_blocks_are_refused_before_anything_changes(name: str) -> None:
    controller = ALL[name]()
    x, e = Room(controller).heard(slice(10))
    controller.process(x, e)
    before, with_nan = content_of(controller), e.copy()
    with_nan[..., 7] = np.nan
    bad: list[tuple[Any, Any, dict[str, Any], str]] = [
        (x, with_nan, {}, "errors must be finite, but holds NaN or Inf"),
        (x, e[..., :0], {}, "at least 1 sample|the same number of samples"),
        (x, e[np.newaxis, np.newaxis], {}, r"errors must be \(n_samples,\)"),
        (x, "noise", {}, "errors must be a sequence of real numbers"),
        (x, e, {"adapt": 1}, "adapt must be True, False or an array of bool"),
        (x, e, {"adapt": np.ones(9, bool)}, "one for each of the 10 samples"),
    ]
    if x is not None:
        bad += [(-np.inf * x, e, {}, "references must be finite"), (x[..., :9], e, {}, "got 9 and 10")]
    if hasattr(controller, "multichannel"):  # else the first sample shows the channels
        shape = (controller.n_loudspeakers, 10) if controller.multichannel else (10,)
        shared = np.zeros(e.size + 1)
        out, errors = shared[: np.prod(shape)].reshape(shape), shared[1:].reshape(e.shape)
        bad += [
            (x, e[0] if e.ndim == 2 else np.stack([e, e]), {}, r"errors must be \(.*n_samples.* for this"),
            (x, e, {"out": np.empty(3)}, r"out must be a writable, C-contiguous array of float64 of shape \("),
            (x, e, {"out": out.tolist()}, "out must be"),
            (x, errors, {"out": out}, "out must not overlap"),
        ]
        if x is not None:
            wrong = x[0] if x.ndim == 2 else np.stack([x, x])
            bad += [(wrong, e, {}, "for this controller, got shape|reference must have a value")]
    for references, errors, options, message in bad:
        with pytest.raises((ValueError, TypeError), match=message):
            controller.process(references, errors, **options)
        assert content_of(controller) == before, message
    if hasattr(controller, "multichannel"):
        for take in (controller.control_signal, controller.update, lambda v: controller.listen(x, np.outer(v, v))):
            with pytest.raises(
                (ValueError, TypeError), match=r"each of the|must be a single number|must be None|errors"
            ):
                take(np.ones(9))
            assert content_of(controller) == before


WRONG = [np.nan, -1.0, "x", [], np.ones(9), np.full(10, 1e200), object()]


def calls_with_wrong_arguments(kind: type, pair: Any) -> Iterator[tuple[Callable[..., Any], Any, dict[str, Any]]]:
    """Yield all public methods and the setters of all properties, each with arguments of which one is hardly right.

    `pair` is what a method of two arguments takes: references and errors.
    """
    for (name, own), wrong in itertools.product(inspect.getmembers_static(kind), WRONG):
        if name.startswith("_") or name in ("save", "state", "restore"):
            continue
        if isinstance(own, property) and own.fset is not None:
            yield own.fset, (wrong,), {}
        if not inspect.isfunction(own):
            continue
        _, *parameters = inspect.signature(own).parameters.values()
        options = [one.name for one in parameters if one.default is not one.empty]
        n_needed = len(parameters) - len(options)
        right = pair if n_needed == 2 else (1.0,) * n_needed
        for k in range(n_needed):
            yield own, (*right[:k], wrong, *right[k + 1 :]), {}
        for option in options:
            yield own, right, {option: wrong}


@pytest.mark.parametrize("name", [n for n in ALL if not n.endswith((" limiter", " known amplifier"))])
def test_a_public_call_that_is_refused_changes_nothing(name: str) -> None:
    """Whatever is called: a new method is tested here, too."""

    def after_50_samples() -> tuple[Any, bytes]:
        controller = ALL[name]()
        Room(controller).run(controller, 50)
        return controller, content_of(controller)

    (controller, before), refused = after_50_samples(), 0
    right = Room(controller).heard(slice(50, 60))
    for call, arguments, options in calls_with_wrong_arguments(type(controller), right):
        try:
            call(controller, *arguments, **options)
        except Exception as error:  # noqa: BLE001 - its message is tested with each method
            if not isinstance(error, RefusedUpdate):  # which comes after the samples before it
                assert content_of(controller) == before, (call, arguments, options)
                refused += 1
                continue
        controller, before = after_50_samples()
    assert refused > 20


LISTENERS = [n for n in ALL if hasattr(ALL[n](), "listen") and n not in ("LimitedController", *PYTHONS)]
BAD_SAMPLES = [(n, "reference") for n in LISTENERS if getattr(ALL[n](), "n_references", 1)]
BAD_SAMPLES += [(n, "error") for n in LISTENERS if n not in IN_BLOCKS]  # which take no error while they listen


@pytest.mark.parametrize(("name", "bad"), BAD_SAMPLES)
def test_listening_to_a_bad_sample_changes_nothing(name: str, bad: str) -> None:
    """Not even by the samples before it."""
    controller = ALL[name]()
    x, e = Room(controller).heard(slice(60))
    controller.process(x, e)
    before, spoilt = content_of(controller), np.array(e if bad == "error" else x)
    spoilt[..., 30] = 1e160
    with pytest.raises(ValueError, match=r"loud|finite|overflow|at most"):
        controller.listen(*((x, spoilt) if bad == "error" else (spoilt, e)))
    assert content_of(controller) == before


def test_a_pause_while_listening_teaches_the_constraint_nothing() -> None:
    controller = kf_opc(N_TAPS, S_HAT, rated_power=0.1, fs=FS, **KALMAN)
    x, e = Room(controller).heard(slice(200))
    controller.listen(x, e)
    before = [array.tobytes() for array in controller.constraint.state]
    assert 0.0 < controller.constraint_factor < 1.0
    controller.listen(100.0 * x, 200.0 * e, adapt=False)
    assert [array.tobytes() for array in controller.constraint.state] == before


@pytest.mark.parametrize("name", [name for name in ALL if name not in ("LimitedController", *PYTHONS)])
def test_a_refused_update_names_its_sample_and_the_rest_can_go_on(name: str) -> None:
    controller, steps = ALL[name](), ALL[name]()
    x, e = Room(controller).heard(slice(200))
    e = e.copy()
    e[..., 120] = 1e200  # finite, but its square is not
    with pytest.raises(RefusedUpdate, match=r"overflow|finite square|loud") as caught:
        controller.process(x, e)
    assert caught.value.sample == 120
    rest = controller.process(None if x is None else x[..., 121:], e[..., 121:])
    if getattr(steps, "internal_model", False):
        return  # an error that never comes counts as silence, one that is left out does not
    np.testing.assert_array_equal(rest, steps.process(x, e, adapt=np.arange(200) != 120)[..., 121:])
