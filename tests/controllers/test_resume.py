"""Checkpoints of every controller: saved at any sample, it continues to the bit."""

from __future__ import annotations

import copy
import inspect
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.checkpoints import N, Room, assert_same_contents
from helpers.controllers import ALL, IN_BLOCKS, OWN, SEVERAL, OwnController, made, own_amplifier
from helpers.loop import S_HAT
from hypothesis import example, given, settings
from hypothesis import strategies as st

import kfopc_filterpy
from kfopc_filterpy import FxLMS, controllers
from kfopc_filterpy.checkpoint import Checkpointed
from kfopc_filterpy.controllers import CoreController, VerifiedController
from kfopc_filterpy.controllers.posterior import PathObserver


def again(controller: Any, folder: Path) -> Any:
    """Save a controller and load it."""
    path = folder / "run.kfopc"
    controller.save(path)
    return type(controller).load(path, trusted=OWN)


@pytest.mark.parametrize("name", ALL)
def test_a_controller_that_is_saved_at_any_sample_continues_to_the_bit(
    name: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("saved")

    @given(samples=st.integers(0, N - 30), halfway=st.booleans())
    @example(samples=0, halfway=False)
    @settings(max_examples=4)
    def check(samples: int, halfway: bool) -> None:
        controller = ALL[name]()
        room = Room(controller)
        room.run(controller, samples)
        if halfway:  # the control signal was emitted, the error is still to come
            room.play(controller)
        loaded, twin = again(controller, folder), room.copy()
        assert type(loaded) is type(controller)
        assert_same_contents(loaded, controller)
        if halfway:
            room.hear(controller)
            twin.hear(loaded)
        rest = N - room.n
        np.testing.assert_array_equal(twin.run(loaded, rest), room.run(controller, rest))
        assert_same_contents(loaded, controller)

    check()


@pytest.mark.parametrize("name", ALL)
def test_copies_and_pickles_continue_too(name: str) -> None:
    controller = ALL[name]()
    room = Room(controller)
    room.run(controller, 150)
    twins = copy.deepcopy(controller), pickle.loads(pickle.dumps(controller))
    runs = [room.copy().run(twin, 200) for twin in twins]
    expected = room.run(controller, 200)  # what the others did has not reached it
    for twin, got in zip(twins, runs, strict=True):
        np.testing.assert_array_equal(got, expected)
        assert_same_contents(twin, controller)


def test_a_verified_controller_does_not_keep_the_arrays_that_it_is_given() -> None:
    """A process may write each sample into the same array."""
    fresh, reused = (ALL["VerifiedController, many"]() for _ in range(2))
    room, buffer = Room(fresh), np.empty(3)
    for x, d in zip(room.x, room.d, strict=True):
        fresh.control_signal(x)
        fresh.update(d)
        reused.control_signal(x)
        buffer[:] = d
        reused.update(buffer)
        buffer[:] = np.nan
    np.testing.assert_array_equal(fresh.weights, reused.weights)
    np.testing.assert_array_equal(fresh.primary_path, reused.primary_path)


OFFERED = {name: getattr(package, name) for package in (kfopc_filterpy, controllers) for name in package.__all__}


def leaves(kind: type) -> set[type]:
    """Return the package's classes under this one from which no other is derived."""
    derived = [one for one in kind.__subclasses__() if one.__module__.startswith("kfopc_filterpy.")]
    return set().union(*map(leaves, derived)) if derived else {kind}


def test_every_controller_of_the_package_is_saved_by_these_tests() -> None:
    wanted = {kind for kind in leaves(Checkpointed) if kind.__module__.startswith("kfopc_filterpy.controllers.")}
    assert len(wanted) > 15
    assert {type(make()) for make in ALL.values()} >= wanted - {PathObserver}  # a part of VerifiedController


def test_every_function_and_class_of_several_channels_is_among_them() -> None:
    several = [own for own in (make() for make in (SEVERAL | IN_BLOCKS).values()) if own.multichannel]
    kinds = {type(own).__name__ for own in several}
    for name, offered in OFFERED.items():
        if (
            offered is not CoreController
            and callable(offered)
            and "n_references" in inspect.signature(offered).parameters
        ):
            assert name in kinds or any(key.split(",")[0] == name for key in SEVERAL), name


def test_a_base_class_loads_what_is_derived_from_it(tmp_path: Path) -> None:
    controller = made("KF-OPC", "plain")
    controller.save(tmp_path / "run.kfopc")
    assert isinstance(CoreController.load(tmp_path / "run.kfopc"), type(controller))


class Mine(FxLMS):
    """A user's subclass, which counts."""

    def __init__(self) -> None:
        super().__init__(4, S_HAT, step_size=0.01)
        self.heard = 0

    def update(self, error: float) -> None:
        self.heard += 1
        super().update(error)


def test_a_users_subclass_is_loaded_by_its_own_load_or_if_it_is_trusted(tmp_path: Path) -> None:
    controller, path = Mine(), tmp_path / "run.kfopc"
    Room(controller).run(controller, 20)
    controller.save(path)
    loaded = Mine.load(path)
    assert (type(loaded), loaded.heard) == (Mine, 20)
    assert type(FxLMS.load(path, trusted=[Mine])) is Mine
    with pytest.raises(ValueError, match=r"names test_resume.Mine, which is none .*trusted=\[Mine\]"):
        FxLMS.load(path)
    FxLMS(4, S_HAT, step_size=0.01).save(path)
    with pytest.raises(TypeError, match=r"has a FxLMS, which is no Mine: call FxLMS\.load"):
        Mine.load(path)


def test_a_users_controller_in_a_wrapper_has_to_be_trusted(tmp_path: Path) -> None:
    VerifiedController(OwnController()).save(tmp_path / "run.kfopc")
    with pytest.raises(ValueError, match=r"names helpers.controllers.OwnController, which is none of"):
        VerifiedController.load(tmp_path / "run.kfopc")


def test_an_amplifier_without_a_name_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    path = tmp_path / "run.kfopc"
    path.write_bytes(b"before")
    anonymous = VerifiedController(FxLMS(4, S_HAT, step_size=0.01), amplifier=lambda y: y)
    with pytest.raises(TypeError, match=r"VerifiedController\..*amplifiers cannot be saved.*<lambda>"):
        anonymous.save(path)
    assert path.read_bytes() == b"before"
    named = VerifiedController(FxLMS(4, S_HAT, step_size=0.01), amplifier=own_amplifier)
    named.save(path)
    assert_same_contents(VerifiedController.load(path, trusted=[own_amplifier]), named)
