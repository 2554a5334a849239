"""An algorithm that a user adds: its steps in a C file outside the package, its class in Python."""

from __future__ import annotations

import copy
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.channels import random_paths
from helpers.comparing import assert_goes_on_as, assert_same_run
from helpers.loop import AMPLIFIERS, FEEDBACK, FS, N_TAPS, S_HAT, noises, run

from kfopc_filterpy import OutputLimiter, OutputPowerConstraint, simulate
from kfopc_filterpy.controllers import CoreController, load_algorithm
from kfopc_filterpy.core.block import _Algorithm as AlgorithmTable
from kfopc_filterpy.core.block import _Setting as SettingOfTable
from kfopc_filterpy.core.own import CACHE_VARIABLE, fault_of
from kfopc_filterpy.paths import PathTolerance

ROOT = Path(__file__).resolve().parents[2]
MU = 0.01

# Sign-error FxLMS whose step follows the mean m of |e|, w(n+1) = w(n) + mu m(n) sign(e) x'(n), and that plays half of
# what the filter gives.
CODE = """
#include "signals.h"
#define SHARE 0.5

typedef struct {
    signals s;
    real *count, *mean, *next; /* samples; (K) mean of |e|, and with the present sample in it */
} sign_signals;

enum { STEP_SIZE };
static const anc_setting settings[] = {{"step_size", 0, 1, 0}, {0}};

static void layout(anc_view *view, const anc_plan *plan, const anc_setting *settings, anc_layout *at)
{
    sign_signals *own = (sign_signals *)view;
    layout_signals(&own->s, plan, settings, at);
    own->count = reals(at, "count", ANC_STATE, 1, 1, 1, 1);
    own->mean = reals(at, "mean_error", ANC_STATE, 1, 1, 1, plan->microphones);
    own->next = reals(at, "next_mean", ANC_SCRATCH, 1, 1, 1, plan->microphones);
}

static int control_signal(anc_view *view, const real *reference, real *control)
{
    signals *s = (signals *)view;
    const int refused = take_reference(s, reference);
    for (int32_t j = 0; !refused && j < s->J; j++) emit(s, j, SHARE * filter_output(s, j)), control[j] = s->control[j];
    return refused;
}

static int update(anc_view *view, const real *error)
{
    sign_signals *own = (sign_signals *)view;
    signals *s = &own->s;
    int refused = error ? estimate(s, error) : ANC_DONE;
    if (!error || refused) return refused;
    for (int32_t j = 0; j < s->J; j++) set_step(s, j, 1, *s->setting[STEP_SIZE], 0);
    for (int32_t k = 0; k < s->K; k++) {
        own->next[k] = own->mean[k] + ((real)fabs(error[k]) - own->mean[k]) / (*own->count + 1);
        s->estimate[k] = own->next[k] * ((error[k] > 0) - (error[k] < 0));
    }
    refused = descend(s, s->estimate);
    if (refused) return refused;
    *own->count += 1;
    for (int32_t k = 0; k < s->K; k++) own->mean[k] = own->next[k];
    return ANC_DONE;
}

const anc_algorithm anc_own_sign = {"own sign FxLMS", settings, layout, start_plain, control_signal, update};
"""


class SignFxLMS(CoreController):
    """Sign-error FxLMS whose step follows the mean of |e|."""

    name = "sign FxLMS"

    def __init__(self, n_taps: int, secondary_path: Any, step_size: Any = MU, **options: Any) -> None:
        super().__init__(n_taps, secondary_path, settings={"step_size": step_size}, **options)

    @property
    def mean_error(self) -> np.ndarray:
        """Mean of |e| of each microphone, a copy."""
        return self._opened().fields["mean_error"].ravel().copy()


@pytest.fixture(scope="module", autouse=True)
def source(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Compile the file, into a cache that is empty."""
    folder = tmp_path_factory.mktemp("own")
    file = folder / "own_sign.c"
    file.write_text(CODE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(CACHE_VARIABLE, str(folder / "cache"))
        SignFxLMS.algorithm = load_algorithm(file)
        yield file


def made_with(option: str) -> Any:
    """Return a controller with something that the package's controllers have."""
    given: dict[str, Any] = {
        "limiter": {"limiter": OutputLimiter(0.05, fs=FS, window_s=0.01)},
        "amplifier": {"amplifier": AMPLIFIERS["hard"][0]},
        "constraint": {"constraint": OutputPowerConstraint(0.3, fs=FS, memory_s=0.01, window="sliding")},
    }
    controller = SignFxLMS(N_TAPS, S_HAT, **given.get(option, {}))
    if option == "uncertainty":
        controller.secondary_path_uncertainty = PathTolerance(delay_samples=0.5, gain_db=1.0)
    return controller


@pytest.mark.parametrize("option", ["", "limiter", "amplifier", "constraint", "uncertainty"])
def test_a_run_of_the_loop_is_the_steps_bit_for_bit(option: str) -> None:
    fast, slow = made_with(option), made_with(option)
    scene = {"amplifier": AMPLIFIERS["hard"][0], "feedback": FEEDBACK, "on": 17}
    result = run(fast, **scene)
    assert_same_run(result, run(slow, compiled=False, **scene))
    assert_same_run(run(fast, n=50), run(slow, n=50, compiled=False))  # and they go on alike
    assert_same_run(run(fast, n=50, compiled=False), run(slow, n=50))
    name = "disturbance_power" if option in ("amplifier", "constraint") else "error"  # what the option changes
    without = run(made_with(""), **scene)
    assert np.array_equal(getattr(result, name), getattr(without, name)) == (option == "")
    for twin in (copy.deepcopy(fast), pickle.loads(pickle.dumps(fast))):
        assert_same_run(run(twin, n=50), run(copy.deepcopy(slow), n=50))


def test_several_channels_follow_the_equation() -> None:
    """Rounding of 200 steps in another order of sums."""
    K, J, I, L, M, n_samples = 3, 2, 2, 5, 4, 200  # noqa: E741
    s = random_paths(K, J, M, seed=1)
    rng = np.random.default_rng(5)
    x, d = rng.standard_normal((I, n_samples)), rng.standard_normal((K, n_samples))
    w, m, y = np.zeros((J, I, L)), np.zeros(K), np.zeros((J, n_samples))
    rows = np.zeros((I, max(L, M) + L))
    filtered, errors = np.zeros((K, J, I, L)), np.zeros((K, n_samples))
    for n in range(n_samples):
        rows = np.concatenate([x[:, n : n + 1], rows[:, :-1]], axis=1)
        filtered = np.concatenate([np.einsum("kjm,im->kji", s, rows[:, :M])[..., None], filtered[..., :-1]], axis=3)
        y[:, n] = 0.5 * np.einsum("jil,il->j", w, rows[:, :L])
        errors[:, n] = d[:, n] - sum(s[:, :, k] @ y[:, n - k] for k in range(min(M, n + 1)))
        m = np.mean(np.abs(errors[:, : n + 1]), axis=1)
        w = w + MU * np.einsum("k,kjil->jil", m * np.sign(errors[:, n]), filtered)
    controllers = [SignFxLMS(L, s, n_references=I) for _ in range(2)]
    runs = [
        simulate(made, x, disturbance=d, secondary_path=s, compiled=compiled)
        for made, compiled in zip(controllers, (True, False), strict=True)
    ]
    assert_same_run(*runs)
    assert runs[0].algorithm == "sign FxLMS"
    np.testing.assert_allclose(runs[0].error, errors, rtol=0, atol=1e-11)
    np.testing.assert_allclose(controllers[0].weights, w, rtol=0, atol=1e-11)
    np.testing.assert_allclose(controllers[0].mean_error, m, rtol=1e-12)


def test_it_works_in_blocks_and_leaves_samples_out() -> None:
    x, d, _ = noises(300)
    adapt = np.arange(300) % 3 > 0
    whole, steps = SignFxLMS(N_TAPS, S_HAT), SignFxLMS(N_TAPS, S_HAT)
    y = whole.process(x, d, adapt=adapt)
    for n in range(300):
        assert steps.control_signal(x[n]) == y[n]
        if adapt[n]:
            steps.update(d[n])
    assert_goes_on_as(whole, steps)
    assert whole.mean_error == pytest.approx([np.mean(np.abs(d[adapt]))])


@pytest.mark.parametrize("error", [1e101, 1e80])
def test_what_a_step_refuses_changes_nothing(error: float) -> None:
    """The first is refused by `estimate`, the second by `descend`, after the mean has been computed."""
    made = SignFxLMS(N_TAPS, S_HAT)
    run(made, n=50)
    made.control_signal(1.0)
    before = copy.deepcopy(made)
    with pytest.raises(ValueError, match="nothing was changed"):
        made.update(error)
    assert_goes_on_as(made, before)
    np.testing.assert_array_equal(made.mean_error, before.mean_error)


def test_settings_are_checked_by_the_class_and_by_the_file() -> None:
    with pytest.raises(ValueError, match="step_size must be"):
        SignFxLMS(N_TAPS, S_HAT, -1.0)
    with pytest.raises(ValueError, match=r"out of its range: .*2"):
        SignFxLMS(N_TAPS, S_HAT, 2.0)

    class Other(CoreController):
        algorithm = SignFxLMS.algorithm

    for settings in ({}, {"step_size": 0.1, "leak": 0.1}):
        with pytest.raises(TypeError, match=r"has the settings \['step_size'\], got "):
            Other(2, [1.0], settings=settings)


def test_a_saved_controller_goes_on(tmp_path: Path) -> None:
    made = SignFxLMS(N_TAPS, S_HAT, limiter=OutputLimiter(0.05, fs=FS))
    run(made, n=100)
    made.save(tmp_path / "own.kfopc")
    again = SignFxLMS.load(tmp_path / "own.kfopc")
    np.testing.assert_array_equal(again.mean_error, made.mean_error)
    assert_same_run(run(again, n=100), run(made, n=100))


# The file.


def test_a_copy_of_an_algorithm_names_the_file_and_not_the_library(source: Path) -> None:
    for twin in (copy.deepcopy(SignFxLMS.algorithm), pickle.loads(pickle.dumps(SignFxLMS.algorithm))):
        assert (twin.name, twin.source, twin.path) == ("own_sign", source, SignFxLMS.algorithm.path)
    (elsewhere := source.with_name("elsewhere.c")).write_text(CODE)
    stored = pickle.dumps(load_algorithm(elsewhere, "own_sign"))
    elsewhere.unlink()
    with pytest.raises(FileNotFoundError, match=r"there is no file .*elsewhere\.c"):
        pickle.loads(stored)


USERS_FILE = """
from kfopc_filterpy.controllers import CoreController, load_algorithm


class Own(CoreController):
    algorithm = load_algorithm("own_sign.c")
"""

USERS_PROGRAM = """
import pickle, sys
import numpy as np
from kfopc_filterpy import simulate
from users_file import Own

for compiled in (True, False):
    made = Own(1, [1.0], settings={"step_size": 0.5})
    run = simulate(made, np.ones(2), disturbance=np.ones(2), secondary_path=[1.0], compiled=compiled)
    print(run.error[1])
if sys.argv[1:]:
    print(pickle.load(open(sys.argv[1], "rb")).weights[0])
pickle.dump(made, open("made.pickle", "wb"))
"""


def test_a_file_that_was_edited_is_compiled_again(tmp_path: Path) -> None:
    """In programs of their own, with a header of the user's; the second one takes up what the first one pickled."""

    def words(*arguments: str) -> list[str]:
        environment = os.environ | {CACHE_VARIABLE: str(tmp_path / "cache"), "PYTHONPATH": str(ROOT)}
        command = [sys.executable, "program.py", *arguments]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout.split()

    (tmp_path / "users_file.py").write_text(USERS_FILE)
    (tmp_path / "program.py").write_text(USERS_PROGRAM)
    (tmp_path / "own_sign.c").write_text('#include "share.h"\n' + CODE.replace("#define SHARE 0.5", ""))
    (tmp_path / "share.h").write_text("#define SHARE 1\n")
    assert words() == ["0.5", "0.5"]
    (tmp_path / "share.h").write_text("#define SHARE 0.5\n")
    # The weight that was pickled is mu m(0) + mu m(1) with m(0) = 1 and m(1) = (1 + 0.5) / 2.
    assert words("made.pickle") == ["0.75", "0.75", "0.875"]
    assert len(list((tmp_path / "cache").iterdir())) == 2


def test_a_library_is_compiled_once(source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    assert load_algorithm(source).path == SignFxLMS.algorithm.path
    (edited := source.with_name("edited.c")).write_text(CODE + "\n")
    with pytest.raises(RuntimeError, match="no-such-compiler does not start"):
        load_algorithm(edited, "own_sign")


def test_a_name_that_cannot_be_loaded_is_refused_before_anything_is_compiled(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"there is no file .*missing\.c"):
        load_algorithm(tmp_path / "missing.c")
    with pytest.raises(ValueError, match=r"name ends with \.c, got .*sign\.py"):
        load_algorithm(tmp_path / "sign.py")
    for name, match in (
        ("sign-error", "cannot be part of a name in C.*rename sign-error.c"),
        ("fxlms", "has .* anc_fxlms"),
    ):
        (file := tmp_path / f"{name}.c").write_text(CODE)
        with pytest.raises(ValueError, match=match):
            load_algorithm(file)
    assert not (tmp_path / "cache").exists()


FAULTS = {
    "does not compile": ("return ANC_DONE;", "return ANC_FINE;", RuntimeError, r"faulty\.c does not compile:\n(.|\n)*ANC_FINE"),
    "without the symbol": ("anc_own_sign", "anc_other", ValueError, r"defines no algorithm anc_own_sign.*or give the name"),
    "without the signals": ("layout_signals(&own->s", "if (0) layout_signals(&own->s", ValueError, "layout_signals first"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_file_says_what_to_mend(fault: str, tmp_path: Path) -> None:
    before, after, error, match = FAULTS[fault]
    assert before in CODE
    (file := tmp_path / "faulty.c").write_text(CODE.replace(before, after))
    with pytest.raises(error, match=match):
        load_algorithm(file, "own_sign")


@pytest.mark.parametrize(
    ("entries", "says"),
    [
        ({}, ""),
        ({"name": None}, "its first entry must be the algorithm's name"),
        ({"settings": []}, "its settings must be an array that ends with {0}, also if there is none"),
        ({"layout": None, "start": None}, "it has no layout and no start; it must be {name, settings, layout, start,"),
        ({"settings": [("a", 0, 0), ("b", 2, 1)]}, "the range of b is from 2 to 1, which is empty"),
        ({"settings": [(f"s{i}", 0, 0) for i in range(8)]}, ""),
        ({"settings": [(f"s{i}", 0, 0) for i in range(9)]}, "it can have 8 settings, and they must end with {0}"),
        ({"settings": [("a", 0, 0), ("a", 0, 0)]}, "two fields have the name a"),
    ],
)
def test_a_table_is_checked(entries: dict[str, Any], says: str) -> None:
    """The struct is changed in Python: to compile a file for each fault takes long."""
    struct = AlgorithmTable.from_buffer_copy(SignFxLMS.algorithm._struct)
    for name, value in entries.items():
        if name == "settings":
            value = (
                (SettingOfTable * (len(value) + 1))(*((n.encode(), *bounds) for n, *bounds in value)) if value else None
            )
        setattr(struct, name, value)
    assert fault_of(struct).startswith(says)
    assert bool(fault_of(struct)) == bool(says)
