"""An algorithm that a user adds: a state of its own and a step for it, in one file; the loop finds it by the type."""

from __future__ import annotations

import copy
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from helpers.comparing import assert_same_run
from helpers.loop import AMPLIFIERS, FEEDBACK, N_TAPS, S_HAT, S, noises, run, sensor_noise
from oracles import modified_anc as oracle

from kfopc_filterpy import OutputLimiter, OutputPowerConstraint, simulate
from kfopc_filterpy.controllers.base import FilteredReferenceController
from kfopc_filterpy.controllers.step import Lines, adapt, disturbance_estimate, output
from kfopc_filterpy.kernels.delay_lines import latest, newest
from kfopc_filterpy.kernels.records import new_record
from kfopc_filterpy.kernels.vectors import dot
from kfopc_filterpy.power.constraint import ConstraintState, advance_constraint

ROOT = Path(__file__).resolve().parents[2]
MU = 0.01


class SignState(NamedTuple):
    """What the step of `SignFxLMS` reads and advances."""

    lines: Lines
    weights: np.ndarray
    constraint: ConstraintState
    step_size: float
    heard: np.ndarray  # record: the mean of |e|, and how many samples it is of


@adapt.register(SignState)
def adapt_sign(state, error, control_signal):
    """Set w(n+1) = w(n) + mu m(n) sign(e) x'(n) with the mean m of |e|."""
    d = disturbance_estimate(state.lines, error)
    advance_constraint(state.constraint, d, latest(state.lines.filtered), latest(state.lines.reference))
    heard = state.heard[0]
    heard.count += 1
    heard.mean += (abs(error) - heard.mean) / heard.count
    w = state.weights
    filtered = newest(state.lines.filtered, w.size)
    for i in range(w.size):
        w[i] += state.step_size * heard.mean * np.sign(error) * filtered[i]
    return True


class SignFxLMS(FilteredReferenceController):
    """Sign-error FxLMS whose step follows the mean of |e|."""

    name = "sign FxLMS"

    def __init__(self, n_taps: int, secondary_path: Any, step_size: float, **options: Any) -> None:
        super().__init__(n_taps, secondary_path, **options)
        self._state = SignState(*self._common(), step_size, new_record(mean=0.0, count=0))


class HalvedState(NamedTuple):
    """A state whose output is a matter of its own too."""

    lines: Lines
    weights: np.ndarray
    constraint: ConstraintState
    step_size: float
    heard: np.ndarray


adapt.register(HalvedState)(adapt_sign)


@output.register(HalvedState)
def output_halved(state, j):
    """Return half of w'x."""
    return 0.5 * dot(state.weights, newest(state.lines.reference, state.weights.size))


class Halved(SignFxLMS):
    """The same with half the control signal."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._state = HalvedState(*self._state)


class WrittenOut:
    """The algorithm for `oracles.modified_anc`."""

    def __init__(self, share: float) -> None:
        self.w, self.share, self.errors, self.factor = np.zeros(N_TAPS), share, [], oracle.Factor(None)

    @property
    def weights(self) -> np.ndarray:
        """What makes y of the reference."""
        return self.share * self.w

    def adapt(self, e: float, d: float, y: float, xf: np.ndarray, x: np.ndarray) -> None:
        self.factor.take(d, xf[0], x[0])
        self.errors.append(abs(e))
        self.w = self.w + MU * np.mean(self.errors) * np.sign(e) * xf


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize(("kind", "share"), [(SignFxLMS, 1.0), (Halved, 0.5)])
def test_the_loop_runs_its_equations(kind: type, share: float, compiled: bool) -> None:
    """Rounding of 500 steps in another order of sums."""
    x, d, _ = noises()
    algorithm = WrittenOut(share)
    expected = oracle.modified_anc(
        algorithm, x, d, S, S_HAT, noise=sensor_noise(), amplifier=AMPLIFIERS["soft"][1], feedback=FEEDBACK
    )
    made = kind(N_TAPS, S_HAT, MU)
    result = run(made, amplifier=AMPLIFIERS["soft"][0], feedback=FEEDBACK, compiled=compiled)
    for name in ("error", "control_signal", "anti_noise", "disturbance_power", "secondary_path_gain"):
        np.testing.assert_allclose(getattr(result, name), expected[name], rtol=0, atol=1e-11, err_msg=name)
    np.testing.assert_allclose(made.weights, algorithm.w, rtol=0, atol=1e-11)
    assert np.mean(expected["error"][-100:] ** 2) < 0.8 * np.mean(d[-100:] ** 2)  # it did cancel
    assert result.algorithm == "sign FxLMS"
    assert result.power_weight is None


@pytest.mark.parametrize("options", ["", "limiter", "amplifier", "constraint"])
@pytest.mark.parametrize("kind", [SignFxLMS, Halved])
def test_compiled_run_is_the_steps_bit_for_bit(kind: type, options: str) -> None:
    """With all that the package's controllers have."""

    def made() -> Any:
        given: dict[str, Any] = {}
        if options == "limiter":
            given["limiter"] = OutputLimiter(0.05, fs=8000.0, window_s=0.01)
        if options == "amplifier":
            given["amplifier"] = AMPLIFIERS["hard"][0]
        if options == "constraint":
            given["constraint"] = OutputPowerConstraint(0.3, fs=8000.0, memory_s=0.01, window="sliding")
        return kind(N_TAPS, S_HAT, MU, **given)

    fast, slow = made(), made()
    scene = {"amplifier": AMPLIFIERS["hard"][0], "feedback": FEEDBACK, "on": 17}
    assert_same_run(run(fast, **scene), run(slow, compiled=False, **scene))
    np.testing.assert_array_equal(fast.weights, slow.weights)
    assert_same_run(run(fast, n=50), run(slow, n=50, compiled=False))  # and they go on alike
    assert_same_run(run(fast, n=50, compiled=False), run(slow, n=50))
    assert (fast.rated_power == 0.3) == (options == "constraint")
    for twin in (copy.deepcopy(fast), pickle.loads(pickle.dumps(fast))):
        assert_same_run(run(twin, n=50), run(copy.deepcopy(slow), n=50))


def test_a_state_without_a_step_says_what_to_register() -> None:
    class Forgotten(NamedTuple):
        lines: Lines
        weights: np.ndarray
        constraint: ConstraintState

    class Unfinished(FilteredReferenceController):
        def __init__(self) -> None:
            super().__init__(2, [1.0])
            self._state = Forgotten(*self._common())

    with pytest.raises(NotImplementedError, match=r"no step is registered .*adapt\.register\(Forgotten\)\(step\)"):
        simulate(Unfinished(), np.ones(5), disturbance=np.ones(5), secondary_path=[1.0])
    with pytest.raises(NotImplementedError, match=r"no step is registered .*adapt\.register\(Forgotten\)\(step\)"):
        Unfinished().control_signal(1.0)


# ---- In a file of the user's, outside the package

USERS_FILE = """
from typing import NamedTuple

import numpy as np

from kfopc_filterpy.controllers.base import FilteredReferenceController
from kfopc_filterpy.controllers.step import Lines, adapt
from kfopc_filterpy.kernels.delay_lines import newest
from kfopc_filterpy.power.constraint import ConstraintState


class State(NamedTuple):
    lines: Lines
    weights: np.ndarray
    constraint: ConstraintState


@adapt.register(State)
def step(state, error, control_signal):
    state.weights[0] += 0.5 * error * newest(state.lines.filtered, 1)[0]
    return True


class Own(FilteredReferenceController):
    def __init__(self):
        super().__init__(1, [1.0])
        self._state = State(*self._common())
"""

USERS_PROGRAM = """
import numpy as np
from kfopc_filterpy import simulate
from users_file import Own

results = [
    simulate(Own(), np.ones(2), disturbance=np.ones(2), secondary_path=[1.0], compiled=compiled)
    for compiled in (True, False)
]
print(*(result.error[1] for result in results))
"""

OTHER_PROGRAM = """
import numpy as np
from kfopc_filterpy import FxLMS, simulate

results = [
    simulate(FxLMS(1, [1.0], step_size=0.5), np.ones(2), disturbance=np.ones(2), secondary_path=[1.0], compiled=compiled)
    for compiled in (True, False)
]
print(*(result.error[1] for result in results))
"""


def test_a_users_own_file_can_be_edited_and_is_no_ones_business(tmp_path: Path) -> None:
    """What is kept on disk must not outlive the step it was made of, nor need the user's file in another program."""

    def words(program: str, path: Path) -> list[str]:
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(path)}
        command = [sys.executable, "-c", program]
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout.split()

    users = tmp_path / "users"
    users.mkdir()
    file = users / "users_file.py"
    file.write_text(USERS_FILE)
    assert words(USERS_PROGRAM, users) == ["0.5", "0.5"]
    assert words(OTHER_PROGRAM, tmp_path) == ["0.5", "0.5"]
    file.write_text(USERS_FILE.replace("0.5 * error", "0.25 * error"))
    assert words(USERS_PROGRAM, users) == ["0.75", "0.75"]
