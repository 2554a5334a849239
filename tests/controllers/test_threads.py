"""Two threads: a controller works for one of them, and while compiled code is at work, the other one runs."""

from __future__ import annotations

import pickle
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from kfopc_filterpy import HardClipAmplifier, LimitedController, OutputLimiter, Plant, fx_lms, kf_anc, simulate
from kfopc_filterpy.checkpoint import content_of
from kfopc_filterpy.controllers import FeedbackNeutralizer, core_controller
from kfopc_filterpy.power import amplifiers, limiter

FS = 8000.0
S = np.array([0.0, 0.8, -0.3])
X, E = np.random.default_rng(0).standard_normal((2, core_controller.LONGEST_CALL))


class Gate:
    """A place at which a second thread stops until it is told to go on; the first one passes."""

    def __init__(self) -> None:
        self._first, self._reached, self._opened = threading.get_ident(), threading.Event(), threading.Event()

    def pass_through(self) -> None:
        if threading.get_ident() != self._first:
            self._reached.set()
            self._opened.wait()

    @contextmanager
    def holding(self, run: Callable[[], object]) -> Iterator[None]:
        """Hold a second thread at the gate, and let it end afterwards."""
        thread = threading.Thread(target=run)
        thread.start()
        self._reached.wait()
        try:
            yield
        finally:
            self._opened.set()
            thread.join()


def test_a_second_thread_is_refused_and_the_first_one_is_unharmed(monkeypatch: pytest.MonkeyPatch) -> None:
    gate, compiled = Gate(), core_controller.process

    def process(*arguments: Any) -> Any:
        gate.pass_through()
        return compiled(*arguments)

    controller, alone = (fx_lms(64, S, step_size=1e-3) for _ in range(2))
    expected, y = alone.process(X, E), np.empty_like(X)
    monkeypatch.setattr(core_controller, "process", process)
    with gate.holding(lambda: controller.process(X, E, out=y)):
        for call in (
            lambda: controller.process(X[:10], E[:10]),
            lambda: controller.control_signal(1.0),
            lambda: controller.update(1.0),
            lambda: controller.listen(X[:10], E[:10]),
            lambda: setattr(controller, "secondary", S),
            lambda: setattr(controller, "limiter", OutputLimiter(1.0, fs=FS)),
            lambda: pickle.dumps(controller),
            lambda: simulate(controller, X[:10], Plant(S, fs=FS), disturbance=E[:10]),
        ):
            with pytest.raises(RuntimeError, match="in use by another thread"):
                call()
    np.testing.assert_array_equal(y, expected)
    assert content_of(controller) == content_of(alone)


class Patient(Gate):
    """A user's own controller, which stays in a step until it is told to go on."""

    def control_signal(self, reference: float) -> float:
        self.pass_through()
        return float(reference)

    def update(self, error: float) -> None: ...


@pytest.mark.parametrize(
    "wrap",
    [lambda own: LimitedController(own, OutputLimiter(4.0, fs=FS)), lambda own: FeedbackNeutralizer(own, [0.0, 0.1])],
)
def test_a_second_thread_is_refused_by_a_wrapper_of_ones_own_controller(wrap: Any) -> None:
    own, answers = Patient(), []
    controller = wrap(own)
    with own.holding(lambda: answers.append(controller.control_signal(1.0))):
        for call in (
            lambda: controller.control_signal(2.0),
            lambda: controller.update(1.0),
            lambda: controller.process([2.0], [1.0]),
            lambda: simulate(controller, [2.0], Plant(S, fs=FS), disturbance=[1.0]),
        ):
            with pytest.raises(RuntimeError, match="in use by another thread"):
                call()
    assert answers == [1.0]


def test_the_interpreter_lock_is_released() -> None:
    """This thread sees a block half done: with the lock held it could only look before the call, or after it."""
    controller = kf_anc(512, S, state_noise=1e-9, measurement_noise=1.0)
    half_done = False
    for _ in range(200):  # on a busy machine, this thread may not get a turn in time
        y = np.full_like(X, np.nan)
        thread = threading.Thread(target=controller.process, args=(X, E), kwargs={"out": y})
        thread.start()
        while thread.is_alive() and not half_done:
            half_done = not np.isnan(y[0]) and bool(np.isnan(y[-1]))  # in this order
        thread.join()
        if half_done:
            return
    pytest.fail("no block was seen half done")


@pytest.mark.parametrize(
    ("module", "name", "act"),
    [
        (limiter, "limit_all", lambda signal: OutputLimiter(1.0, fs=FS).process(signal)),
        (amplifiers, "amplify_all", HardClipAmplifier(1.0)),
    ],
)
def test_a_long_signal_is_given_to_compiled_code_in_parts(
    module: Any, name: str, act: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between the parts, other threads run and Ctrl-C is heard, which here comes in the second one."""
    parts, compiled = [], getattr(module, name)

    def interrupted(*arguments: Any) -> None:
        compiled(*arguments)
        parts.append(arguments[-1])
        if len(parts) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(module, name, interrupted)
    with pytest.raises(KeyboardInterrupt):
        act(np.ones(5 * core_controller.LONGEST_CALL))
    assert parts == 2 * [core_controller.LONGEST_CALL]
