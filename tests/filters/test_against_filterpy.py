"""filterpy's filter and ours take the same steps in any order: one machine, whose oracle is filterpy's own KalmanFilter.

The general filter equals it in every bit. The random walk, which sums in another order, agrees to 1e-9 of the largest
value: the rounding of some ten steps times the condition of these problems, whose variances are 0.1 to 1000.

With a rated power, filterpy's filter gets the measurement scaled by our constraint factor (eq. 9), which must be that of
the oracle (eq. 10-13) to 1e-10, the rounding of running means.
"""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from filterpy.common import Saver
from helpers.filterpys import Oracle
from hypothesis import note, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from oracles.powers import Constraint

from kfopc_filterpy import KFOPC, OutputPowerConstraint

FILTERPY_2 = hasattr(Oracle, "update_sequential")  # 1.4.5 has none
STATE = ("x", "P", "x_prior", "P_prior", "x_post", "P_post", "K", "y", "S", "SI")
OTHERS = ("F", "Q", "R", "H", "M", "alpha")
LIKELIHOODS = ("log_likelihood", "likelihood", "mahalanobis")
CLOSE = 1e-9
FS, MEMORY_S = 1000.0, 0.02  # of the powers: 20 samples
OTHER_UPDATES = ["update_correlated", "update_steadystate"]
PREDICTIONS = ["", "", "", "none", "none", "F", "Q", "number Q", "u", "u and B", "steady"]
CORRECTIONS = ["", "", "", "none", "H", "H", "R", "number R", "H and R", "missed", *OTHER_UPDATES]
USES = ["", "", "look", "look", "look", "P[0, 0]", "P[0, 1]", "P *=", "x[0]", "x[0]"]
USES += [f"assign {name}" for name in ("x", "P", "H", "R", "F", "Q", "alpha", "inv")]
seeds = st.integers(0, 2**32 - 1)


def covariance(rng: np.random.Generator, n: int) -> np.ndarray:
    root = rng.normal(size=(n, n))
    return root @ root.T / n + 0.1 * np.eye(n)


def transition(rng: np.random.Generator, n: int) -> np.ndarray:
    F = rng.normal(size=(n, n))
    return 0.95 * F / np.abs(np.linalg.eigvals(F)).max()


class Twins(RuleBasedStateMachine):
    """Both filters. A rule draws numbers with one seed, so that each filter can be given arrays of its own."""

    oracle: Any
    ours: Any
    moved = False  # by a control input

    def begin(self, ours: Any, n: int, m: int, k: int, x_ndim: int, seed: int) -> None:
        self.oracle, self.ours = Oracle(n, m, k), ours

        def system(kf: Any, rng: np.random.Generator) -> None:
            kf.x, kf.H = rng.normal(size=(n, 1)[:x_ndim]), self.row(rng)
            kf.P, kf.R = covariance(rng, n), covariance(rng, m)
            # 1.4.5 makes M (m, m). So small that 20 updates leave P positive: filterpy would go on with a negative one.
            kf.M = 1e-3 * rng.normal(size=(n, m)) / n
            for name, value in self.model(rng).items():
                setattr(kf, name, value)

        self.both(seed, system)

    def both(self, seed: int, action: Callable[[Any, np.random.Generator], Any]) -> list[Any]:
        return [action(kf, np.random.default_rng(seed)) for kf in (self.oracle, self.ours)]

    def require_same(self, expected: Any, got: Any, what: str) -> None:
        if isinstance(expected, tuple):
            for one, other in zip(expected, got, strict=True):
                self.require_same(one, other, what)
            return
        assert np.shape(got) == np.shape(expected), what
        self.compare(expected, got, what)

    def compare(self, expected: Any, got: Any, what: str) -> None:
        assert type(got) is type(expected), what
        np.testing.assert_array_equal(got, expected, err_msg=what)

    def query(self, seed: int, action: Callable[[Any, np.random.Generator], Any], what: str) -> None:
        self.require_same(*self.both(seed, action), what)

    # What each kind of machine says: a system, and arguments of the steps.

    def shape(self) -> tuple[int, int, int, int]:
        """States, measurements, control inputs, axes of x."""
        kf = self.oracle
        return kf.dim_x, kf.dim_z, kf.dim_u, np.ndim(kf.x)

    def z(self, rng: np.random.Generator, form: int = 0) -> Any:
        """A measurement as a column, or in another form that filterpy takes."""
        _, m, _, x_ndim = self.shape()
        z = rng.normal(size=(m, 1))
        forms = [z, z.ravel(), z.reshape(1, m), z.ravel().tolist()]
        if m == 1:
            forms += [z.item(), np.float64(z.item()), np.array(z.item()), int(9 * z.item()), np.float32(z.item()), True]
        return forms[form % len(forms)] if form else z.reshape((m, 1)[:x_ndim])

    def row(self, rng: np.random.Generator) -> np.ndarray:
        return rng.normal(size=self.shape()[1::-1])

    def measure(self, method: str, z: Any, *before: Any, **arguments: Any) -> None:
        """Correct the state of both."""
        for kf in (self.oracle, self.ours):
            getattr(kf, method)(*before, *copy.deepcopy([z]), **copy.deepcopy(arguments))

    def leave(self, kf: Any) -> None:
        """Take steps with a filter that is not used any more, or put back."""
        kf.predict()
        kf.update(None)
        kf.update(self.z(np.random.default_rng(0)), **self.reference())

    def asked(self, kf: Any, z: Any) -> Any:
        """Return what a filter is asked for z."""
        return z

    def reference(self) -> dict[str, Any]:
        """Return an argument of our `update`."""
        return {}

    # A sample: a prediction and a correction of any form, and between them what a user does with the filter.

    @rule(seed=seeds, samples=st.integers(1, 40))
    def steps(self, seed: int, samples: int) -> None:
        """What is written into an array that was kept from before counts if no step was taken since, and only then."""
        rng = np.random.default_rng(seed)
        for seed in rng.integers(2**32, size=samples):
            kept, prediction, between, correction, after = (
                str(rng.choice(some)) for some in (["", "", "x", "P", "K"], PREDICTIONS, USES, CORRECTIONS, USES)
            )
            form = int(rng.integers(13))
            note(f"{seed=}, {kept=}, {prediction=}, {between=}, {correction=}, {form=}, {after=}")
            held = [getattr(kf, kept) for kf in (self.oracle, self.ours)] if kept else []
            if prediction != "none":
                self.predict(seed, prediction)
            self.use(between, seed)
            if correction != "none":
                self.correct(seed, correction, form)
            for array in held:
                array *= 1.5
            self.use(after, seed)
            self.same_x()

    def predict(self, seed: int, form: str) -> None:
        n, _, k, x_ndim = self.shape()

        def step(kf: Any, rng: np.random.Generator) -> None:
            u, B = rng.normal(size=(k, 1)[:x_ndim]), rng.normal(size=(n, k))
            arguments = {
                "F": {"F": transition(rng, n)},
                "Q": {"Q": covariance(rng, n)},
                "number Q": {"Q": 0.3},
                "u": {"u": u},
                "u and B": {"u": u, "B": B},
            }
            kf.B = B if form == "u" else None
            kf.predict_steadystate(u, B) if form == "steady" else kf.predict(**arguments.get(form, {}))
            kf.B = None

        self.both(seed, step)
        self.moved = self.moved or form in ("u", "u and B", "steady")

    def correct(self, seed: int, correction: str, form: int) -> None:
        rng = np.random.default_rng(seed)
        if correction in OTHER_UPDATES:
            self.measure(correction, None if form == 12 else self.z(rng, form))
            return
        # filterpy 2.0.0 does not reshape z if H is passed
        z, H = self.z(rng, 0 if "H" in correction else form), self.row(rng)
        arguments: dict[str, Any] = {"H": H} if "H" in correction else {}
        if "R" in correction:
            arguments["R"] = 0.4 if "number" in correction else covariance(rng, len(H))
        self.measure("update", None if correction == "missed" else z, **arguments)

    @rule(seed=seeds, masked=st.integers(1, 3))
    def mask(self, seed: int, masked: int) -> None:
        """The rows that are left correct filterpy's filter, to rounding; then it goes on from the same state."""
        _, m, _, x_ndim = self.shape()
        rng = np.random.default_rng(seed)
        z, there = rng.normal(size=m), np.arange(m) != masked - 1
        there[:] = there & there.any()
        self.ours.update(np.ma.array(np.where(there, z, np.nan), mask=~there))
        oracle = copy.deepcopy(self.oracle)
        if not there.any():
            self.oracle.update(None)
            return
        oracle.dim_z = there.sum()
        oracle.update(z[there].reshape((-1, 1)[:x_ndim]), R=oracle.R[np.ix_(there, there)], H=oracle.H[there])
        for name in ("x", "P", *LIKELIHOODS):
            np.testing.assert_allclose(
                getattr(self.ours, name), getattr(oracle, name), rtol=1e-10, atol=1e-10, err_msg=name
            )
        np.testing.assert_array_equal(np.ravel(self.ours.z), np.where(there, z, np.nan))
        assert not self.ours.y[~there].any()
        np.testing.assert_allclose(self.ours.K[:, ~there], 0.0, rtol=0, atol=1e-12)  # the rounding of a pseudo-inverse
        for name in STATE:
            setattr(self.oracle, name, np.copy(getattr(self.ours, name)))
        self.oracle._log_likelihood = self.oracle._likelihood = None
        self.ours._log_likelihood = self.ours._likelihood = self.ours._mahalanobis = None
        self.oracle.z = self.ours.z

    @precondition(lambda self: FILTERPY_2 and np.ndim(self.oracle.x) == 2)
    @rule(seed=seeds, number=st.booleans())
    def update_sequentially(self, seed: int, number: bool) -> None:
        """filterpy writes into z, which must have the rows of all measurements by then."""
        rng, m = np.random.default_rng(seed), self.shape()[1]
        start = seed % m
        self.measure("update", None)
        if number:
            self.measure("update_sequential", rng.normal(), start)
        else:
            self.measure("update_sequential", rng.normal(size=m - start), start, R_i=0.3, H_i=self.row(rng)[start:])

    @rule(
        seed=seeds, update_first=st.booleans(), given=st.sets(st.sampled_from(["Qs", "Hs", "Rs", "inputs", "missing"]))
    )
    def batch_and_smooth(self, seed: int, update_first: bool, given: set[str]) -> None:
        n, m, k, x_ndim = self.shape()
        steps = 4

        def batch(kf: Any, rng: np.random.Generator) -> tuple[Any, ...]:
            lists = {
                "Qs": [covariance(rng, n) for _ in range(steps)],
                "Hs": [self.row(rng) for _ in range(steps)],
                "Rs": [covariance(rng, m) for _ in range(steps)],
                "us": [rng.normal(size=(k, 1)[:x_ndim]) for _ in range(steps)],
                "Bs": [rng.normal(size=(n, k)) for _ in range(steps)],
            }
            zs = [self.z(rng) for _ in range(steps)]
            if "missing" in given:
                zs[1] = None
            lists = {
                name: value
                for name, value in lists.items()
                if name in given or ("inputs" in given and name in ("us", "Bs"))
            }
            found = kf.batch_filter(np.fromiter(zs, object), **lists, update_first=update_first)
            if kf.alpha == 1.0 and not self.moved:
                found += kf.rts_smoother(*found[:2], Qs=lists.get("Qs"))
            return found

        self.moved = self.moved or "inputs" in given
        self.query(seed, batch, "batch")

    # What a user assigns, writes into, holds and copies.

    def use(self, how: str, seed: int) -> None:
        if how == "look":
            self.look()
        else:
            self.both(seed, lambda kf, rng: self.write(kf, rng, how))

    def write(self, kf: Any, rng: np.random.Generator, how: str) -> None:
        n, m, _, x_ndim = self.shape()
        if how == "P[0, 0]":
            kf.P[0, 0] += 1.0
        elif how == "P[0, 1]":
            kf.P[0, -1] = kf.P[-1, 0] = 0.5 * np.sqrt(kf.P[0, 0] * kf.P[-1, -1])
            kf.P[np.diag_indices(n)] *= n  # so it stays positive definite
            kf.P /= n
        elif how == "P *=":
            kf.P *= 3.0 if kf.P[0, 0] < 100.0 else 0.1
        elif how == "x[0]":
            kf.x[0] = 1.0
        elif how.startswith("assign"):
            values = {
                "x": rng.normal(size=(n, 1)[:x_ndim]),
                "P": covariance(rng, n),
                "H": self.row(rng),
                "R": covariance(rng, m),
                "alpha": 1.0 + 0.01 * rng.integers(2),
                "inv": (np.linalg.inv, np.linalg.pinv)[rng.integers(2)],
            } | self.model(rng)
            setattr(kf, how.split()[1], values[how.split()[1]])

    def model(self, rng: np.random.Generator) -> dict[str, Any]:
        n = self.oracle.dim_x
        return {"F": transition(rng, n), "Q": covariance(rng, n)}

    @rule(how=st.sampled_from([copy.copy, copy.deepcopy, lambda kf: pickle.loads(pickle.dumps(kf)), "__dict__"]))
    def go_on_in_a_copy(self, how: Any) -> None:
        if how == "__dict__":
            attributes = copy.deepcopy(vars(self.ours))
            self.leave(self.ours)
            vars(self.ours).clear()
            vars(self.ours).update(attributes)
        else:
            before, self.ours = self.ours, how(self.ours)
            self.leave(before)
            before.x[:] = before.P[:] = 7.0
        self.oracle = copy.deepcopy(self.oracle)

    @rule()
    def save(self) -> None:
        """filterpy's `Saver` keeps what the attributes are now, whatever is written into them later."""
        savers = self.both(0, lambda kf, _: Saver(kf, save_current=True))
        self.both(0, lambda kf, rng: self.write(kf, rng, "P *="))
        for name in (*STATE, *OTHERS):
            self.require_same(*(getattr(saver, name)[0] for saver in savers), name)

    # What changes nothing.

    @rule(seed=seeds)
    def ask(self, seed: int) -> None:
        n, _, k, x_ndim = self.shape()
        if FILTERPY_2:  # 1.4.5's takes u only, and needs B
            arguments = {"u": np.ones((k, 1)[:x_ndim]), "B": np.ones((n, k))} if seed % 2 else {}
            self.query(seed, lambda kf, _: kf.get_prediction(**arguments), "get_prediction")
        self.query(seed, lambda kf, rng: kf.get_update(self.asked(kf, self.z(rng))), "get_update")
        self.query(seed, lambda kf, rng: kf.residual_of(self.asked(kf, self.z(rng))), "residual_of")
        self.query(seed, lambda kf, _: kf.measurement_of_state(kf.x), "measurement_of_state")
        if np.any(self.oracle.S):
            self.query(seed, lambda kf, rng: kf.log_likelihood_of(self.asked(kf, self.z(rng))), "log_likelihood_of")
            for name in LIKELIHOODS:
                self.require_same(getattr(self.oracle, name), getattr(self.ours, name), name)

    @invariant()
    def same_x(self) -> None:
        self.require_same(self.oracle.x, self.ours.x, "x")

    def look(self) -> None:
        """Not after each step: what is read may change what the next one does."""
        for name in (*STATE, *OTHERS):
            self.require_same(getattr(self.oracle, name), getattr(self.ours, name), name)
        np.testing.assert_array_equal(np.array(self.ours.z, float), np.array(self.oracle.z, float))

    def teardown(self) -> None:
        if hasattr(self, "ours"):
            self.look()


class General(Twins):
    @initialize(n=st.integers(1, 5), m=st.integers(1, 3), k=st.integers(1, 2), x_ndim=st.integers(1, 2), seed=seeds)
    def start(self, n: int, m: int, k: int, x_ndim: int, seed: int) -> None:
        self.begin(KFOPC(n, m, k), n, m, k, x_ndim, seed)


class RandomWalk(Twins):
    @initialize(n=st.integers(1, 9), x_ndim=st.integers(1, 2), seed=seeds)
    def start(self, n: int, x_ndim: int, seed: int) -> None:
        ours = KFOPC.random_walk(n, state_noise=1.0, measurement_noise=1.0)
        self.begin(ours, n, 1, 1, x_ndim, seed)

    def model(self, rng: np.random.Generator) -> dict[str, Any]:
        n, other = self.oracle.dim_x, rng.random() < 0.1
        return {"F": transition(rng, n) if other else np.eye(n), "Q": covariance(rng, n) if other else 0.01 * np.eye(n)}

    def compare(self, expected: Any, got: Any, what: str) -> None:
        scale = max(np.abs(expected).max(), 1.0)
        np.testing.assert_allclose(got, expected, rtol=0, atol=CLOSE * scale, err_msg=what)


class Rated(Twins):
    """Filters with a rated power: filterpy's filter gets the measurement scaled by their factor, which is the oracle's."""

    @initialize(n=st.integers(1, 5), x_ndim=st.integers(1, 2), seed=seeds)
    def start(self, n: int, x_ndim: int, seed: int) -> None:
        self.begin_rated(KFOPC(n, 1, 1, constraint=OutputPowerConstraint(0.5, fs=FS, memory_s=MEMORY_S)), x_ndim, seed)

    def begin_rated(self, ours: KFOPC, x_ndim: int, seed: int) -> None:
        self.rng, self.powers = np.random.default_rng(seed), Constraint(0.5, fs=FS, memory_s=MEMORY_S)
        self.begin(ours, ours.dim_x, 1, 1, x_ndim, seed)
        for _ in range(2):  # an H that never changes is refused
            self.measure("update", self.z(self.rng), H=self.row(self.rng))

    def model(self, rng: np.random.Generator) -> dict[str, Any]:
        return super().model(rng) | {"F": np.eye(self.oracle.dim_x)}

    def reference(self) -> dict[str, Any]:
        return {"reference": self.rng.normal()}

    def measure(self, method: str, z: Any, *before: Any, given: float | None = None, **arguments: Any) -> None:
        if z is None:
            super().measure(method, z, *before, **arguments)
            return
        x = self.rng.normal() if given is None else given
        own = copy.deepcopy(z)
        getattr(self.ours, method)(*before, own, **copy.deepcopy(arguments), reference=x)
        if isinstance(own, np.ndarray):
            own[...] = 7.0  # the filter has a copy
        newest = np.ravel(arguments.get("H", arguments.get("H_i", self.oracle.H)))[0]
        factor = self.powers.take(np.ravel(z).astype(float).item() ** 2, newest**2, x**2)
        for name, expected in {
            "constraint_factor": factor,
            "disturbance_power": self.powers.disturbance_power,
            "secondary_path_gain": self.powers.gain,
        }.items():
            assert getattr(self.ours, name) == pytest.approx(expected, rel=1e-10), name
        getattr(self.oracle, method)(*before, self.asked(self.oracle, z), **copy.deepcopy(arguments))
        self.oracle.z = np.asarray(z, float).reshape(np.shape(self.oracle.z))

    def asked(self, kf: Any, z: Any) -> Any:
        factor = self.ours.constraint_factor
        return z if kf is self.ours or factor == 1.0 else np.float64(factor) * np.asarray(z)  # a float32, too

    def predict(self, seed: int, form: str) -> None:
        super().predict(seed, "Q" if form == "F" else form)

    @rule(rated_power=st.floats(0.1, 4.0))
    def assign_a_rated_power(self, rated_power: float) -> None:
        self.ours.rated_power = self.powers.rated_power = rated_power

    @rule(seed=seeds)
    def mask(self, seed: int) -> None:
        """The only measurement."""
        super().mask(seed, 1)

    @rule(seed=seeds, update_first=st.booleans())
    def batch_and_smooth(self, seed: int, update_first: bool) -> None:
        """A batch is its steps."""
        rng, batch = np.random.default_rng(seed), copy.deepcopy(self.ours)
        zs, references = [self.z(rng), None, self.z(rng)], rng.normal(size=3).tolist()
        Hs = [self.row(rng) for _ in zs]
        means, covariances, _, _ = batch.batch_filter(zs, Hs=Hs, references=references, update_first=update_first)
        for k, z in enumerate(zs):
            for updates in (update_first, not update_first):
                if updates:
                    self.measure("update", z, H=Hs[k], given=references[k])
                    np.testing.assert_array_equal(means[k], self.ours.x)
                    np.testing.assert_array_equal(covariances[k], self.ours.P)
                else:
                    self.predict(seed, "")
        self.ours = batch


class RatedWalk(Rated, RandomWalk):
    @initialize(n=st.integers(1, 9), x_ndim=st.integers(1, 2), seed=seeds)
    def start(self, n: int, x_ndim: int, seed: int) -> None:
        constraint = OutputPowerConstraint(0.5, fs=FS, memory_s=MEMORY_S)
        ours = KFOPC.random_walk(n, state_noise=1.0, measurement_noise=1.0, constraint=constraint)
        self.begin_rated(ours, x_ndim, seed)


def several(examples: int) -> settings:
    return settings(max_examples=examples, stateful_step_count=20, report_multiple_bugs=False)


TestGeneral, TestRandomWalk = General.TestCase, RandomWalk.TestCase
TestRated, TestRatedWalk = Rated.TestCase, RatedWalk.TestCase
TestGeneral.settings = TestRandomWalk.settings = several(150)
TestRated.settings = TestRatedWalk.settings = several(60)
