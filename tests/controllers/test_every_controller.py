"""What holds for every controller of the package: the compiled loop and the steps from Python are one algorithm."""

from __future__ import annotations

import itertools
import pickle
from typing import Any

import numpy as np
import pytest
from helpers.channels import random_paths
from helpers.checkpoints import Room
from helpers.comparing import assert_same_run, numbers_of
from helpers.controllers import ALL, IN_BLOCKS, PATHS, SEVERAL, VARIANTS, I, J, K, made
from helpers.loop import AMPLIFIERS, FEEDBACK, FS, N_TAPS, run
from helpers.simulation import Stepwise

from kfopc_filterpy import HardClipAmplifier, Plant, simulate


@pytest.mark.parametrize(("name", "variant"), VARIANTS)
def test_compiled_run_is_the_steps_bit_for_bit(name: str, variant: str) -> None:
    fast, slow = made(name, variant), made(name, variant)
    scene = {"amplifier": AMPLIFIERS["soft"][0], "feedback": FEEDBACK, "on": 17, "n": 300}
    result = run(fast, **scene)
    assert_same_run(result, run(Stepwise(slow), **scene))
    np.testing.assert_array_equal(fast.weights, slow.weights)
    for mine, theirs in zip(numbers_of(fast.constraint.state), numbers_of(slow.constraint.state), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    if variant == "limiter":
        assert pickle.dumps(fast.limiter) == pickle.dumps(slow.limiter)
        assert fast.limiter.gain < 1.0  # it did act
    assert np.any(np.abs(np.diff(result.weights, axis=0)) > 0)
    assert_same_run(run(fast, n=50), run(Stepwise(slow), n=50))  # and they go on alike
    assert_same_run(run(Stepwise(fast), n=50), run(slow, n=50))


@pytest.mark.parametrize("name", SEVERAL)
def test_so_it_is_with_several_channels(name: str) -> None:
    """With feedback, amplifiers, sensor noise, and a controller that first listens; and they go on alike."""
    fast, slow = SEVERAL[name](), SEVERAL[name]()
    x = np.random.default_rng(3).standard_normal((I, 300))
    plant = Plant(
        1.1 * PATHS,
        random_paths(K, I, 9, seed=2, delay=3),
        feedback=0.02 * random_paths(I, J, 5, seed=4),
        amplifier=[HardClipAmplifier(1.0), None],
        fs=FS,
        sensor_noise_std=0.01,
    )
    both = [
        simulate(one, x, plant, rng=1, record_weights_every=7, switch_on_s=20 / FS) for one in (fast, Stepwise(slow))
    ]
    assert_same_run(*both)
    np.testing.assert_array_equal(fast.weights, slow.weights)
    assert_same_run(*(simulate(one, x[:, :50], plant, rng=1) for one in (Stepwise(fast), slow)))


@pytest.mark.parametrize("name", IN_BLOCKS)
def test_a_run_by_blocks_is_the_steps_bit_for_bit(name: str) -> None:
    """Also if the path changes within a block, if weights are recorded, and if it ends in a divergence."""
    path, several = IN_BLOCKS[name]().secondary, "many" in name
    rng = np.random.default_rng(5)
    x, d = rng.standard_normal((2, I, 200)), rng.standard_normal((2, K, 200))
    if not several:
        x, d = x[:, 0], d[:, 0]
    plant = Plant(path, amplifier=AMPLIFIERS["soft"][0], fs=FS, sensor_noise_std=0.1)
    plant = plant.changed_at(40 / FS, secondary=0.9 * path)
    options: dict[str, Any] = {"record_weights_every": 5, "switch_on_s": 3 / FS, "rng": 1}

    def both(gain: float) -> Any:
        made = [IN_BLOCKS[name]() for _ in range(2)]
        runs = [
            [
                simulate(one if k == i else Stepwise(one), x[k], plant, disturbance=gain * d[k], **options)
                for k in (0, 1)
            ]
            for i, one in enumerate(made)
        ]
        for one, other in zip(*runs, strict=True):
            assert_same_run(one, other)
        np.testing.assert_array_equal(made[0].weights, made[1].weights)
        return runs[0][0]

    result = both(1.0)
    assert result.diverged_at_s is None
    assert both(1.1e6 / np.abs(result.control_signal).max()).diverged_at_s > 0  # a run stops at 1e6


@pytest.mark.parametrize("name", [name for name in ALL if "a user's" not in name])
def test_blocks_are_the_steps_bit_for_bit(name: str) -> None:
    """However a recording is cut into blocks, and whichever samples are not adapted to."""
    blocks, steps = ALL[name](), ALL[name]()
    room = Room(blocks)
    x, d = room.x[:300].T, room.d[:300].T
    adapt = np.random.default_rng(1).random(300) < 0.9
    expected = []
    for n in range(300):
        expected.append(steps.control_signal(x[..., n]))
        if adapt[n]:
            steps.update(d[..., n])
    cuts = [0, 1, 2, 18, 82, 83, 300]
    got = [blocks.process(x[..., a:b], d[..., a:b], adapt=adapt[a:b]) for a, b in itertools.pairwise(cuts)]
    np.testing.assert_array_equal(np.concatenate(got, axis=-1), np.transpose(expected))
    np.testing.assert_array_equal(blocks.weights, steps.weights)
    blocks.update(d[..., -1]), steps.update(d[..., -1])  # they go on alike, sample by sample
    np.testing.assert_array_equal(blocks.weights, steps.weights)


@pytest.mark.parametrize("name", ["KF-OPC", "KF-PB", "FxLMS"])
def test_repr_names_the_algorithm_and_its_settings(name: str) -> None:
    controller, limited = made(name, "plain"), made(name, "limiter")
    run(controller, n=50)
    rated = "" if controller.rated_power is None else ", rated power 0.3"
    expected = f"<{controller.name}: {N_TAPS} taps{rated}, constraint factor {controller.constraint_factor:.3g}"
    assert repr(controller) == f"{expected}>"
    assert repr(limited).endswith(", limiter of rated power 0.05>")
