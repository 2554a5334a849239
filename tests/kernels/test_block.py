"""The filter in blocks: against filterpy's, against its own steps, and in the loop against sample by sample."""

import copy
import pickle

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from test_loop import S_HAT, SIGNALS, S, assert_same_estimator, assert_same_run, noises
from test_random_walk import rows_of

from kfopc_filterpy import KFOPC, HardClipAmplifier, KalmanController, kf_anc, kf_opc, simulate
from kfopc_filterpy.kernels.block import Block, settle
from kfopc_filterpy.kernels.covariance import CANCELLATION, INVERSE_S, LAST_INVERSE_S, covariance_matrix, new_covariance
from kfopc_filterpy.loop import simulation


def assert_close(got, want, tolerance=1e-10, scale=None, name=""):
    """To a tolerance relative to the largest value, or to `scale`; NaN where NaN is wanted."""
    scale = np.nanmax(np.abs(want)) if scale is None else scale
    np.testing.assert_allclose(got, want, rtol=0, atol=tolerance * scale, err_msg=name)


# ---- What a block starts from


@pytest.mark.parametrize("owed", [(1.0, 0.0, 0.0), (1.0, 2e-3, 0.0), (1.02, 1e-3, 0.4), (0.5, 0.0, 3.0)])
@pytest.mark.parametrize("n", [1, 7, 16])
def test_settling_pays_what_is_owed(n, owed):
    """scale (T - g g'/S) + diagonal I written out; 4 roundings of numbers up to the largest in P."""
    rng = np.random.default_rng(n)
    A = rng.standard_normal((n, n))
    cov, g, (scale, diagonal, inverse_S) = new_covariance(A @ A.T), rng.standard_normal(n), owed
    cov.gain_direction[:] = g
    cov.owed[:3] = owed
    P = scale * (A @ A.T - inverse_S * np.outer(g, g)) + diagonal * np.eye(n)
    settle(cov)
    np.testing.assert_array_equal(cov.owed[:3], [1.0, 0.0, 0.0])
    np.testing.assert_array_equal(cov.gain_direction, g)
    np.testing.assert_allclose(np.tril(cov.triangle[:n, :n]), np.tril(P), rtol=0, atol=1e-15 * 4 * np.abs(P).max())
    np.testing.assert_array_equal(cov.triangle[n:], 0.0)


# ---- A block whose rows are all known


class Filter:
    """A covariance that blocks of rows advance."""

    def __init__(self, P, r, q, alpha=1.0):
        self.cov, self.noises, self.n = new_covariance(np.array(P, dtype=float)), (r, q, alpha**2), len(P)

    def take(self, rows, how="advance"):
        """Gain directions and S of a block, in products where they serve or ("advance_by_steps") by steps."""
        block = Block(self.n, len(rows))
        block.rows[:, : self.n] = rows
        S = getattr(block, how)(self.cov, *self.noises)
        np.testing.assert_array_equal(block.rows[:, : self.n], rows)
        for padding in (block.rows[:, self.n :], block.directions[:, self.n :], self.cov.triangle[self.n :]):
            np.testing.assert_array_equal(padding, 0.0)
        return block.directions[:, : self.n], S

    @property
    def P(self):
        return covariance_matrix(self.cov)


def filterpys(P, rows, r, q, alpha=1.0):
    """g_k = S_k K_k, S_k and P after the rows, of filterpy's filter."""
    kf = KalmanFilter(len(P), 1)
    kf.P, kf.Q, kf.R, kf.alpha = np.array(P), r * np.eye(len(P)), np.array([[q]]), alpha
    directions, variances = [], []
    for row in rows:
        kf.predict()
        kf.update(np.zeros((1, 1)), H=row.reshape(1, -1))
        directions.append(kf.K[:, 0] * kf.S[0, 0])
        variances.append(kf.S[0, 0])
    return np.array(directions), np.array(variances), kf.P


def refuse_steps(monkeypatch):
    def steps(*arguments):
        raise AssertionError("fell back to steps")

    monkeypatch.setattr(Block, "advance_by_steps", steps)


@pytest.mark.parametrize(
    "how",
    [("advance",), ("advance_by_steps",), ("advance_in_pairs",), ("advance", "advance_by_steps", "advance_in_pairs")],
    ids="+".join,
)
@pytest.mark.parametrize("r", [0.0, 1e-4])
@pytest.mark.parametrize("kind", ["unrelated", "line"])
@pytest.mark.parametrize("size", [1, 5, 48, 100])
@pytest.mark.parametrize("n", [1, 3, 8, 30, 67])
def test_consecutive_blocks_are_filterpys_filter(n, size, kind, r, how, monkeypatch):
    """In products, by steps, or in turns. S stays below 1000 q, which costs three digits: errors were 6e-14 at most."""
    if how == ("advance",):
        refuse_steps(monkeypatch)
    count, q = (3 if size > 5 else 9), 0.5
    rows = rows_of(kind, n, count * size, np.random.default_rng(n))
    made, taken = Filter(np.eye(n), r, q), []
    for k in range(count):
        g, S = made.take(rows[k * size : (k + 1) * size], how[k % len(how)])
        np.testing.assert_array_equal(made.cov.gain_direction, g[-1])
        assert made.cov.owed[LAST_INVERSE_S] == 1.0 / S[-1]
        taken.append((g, S))
    directions, variances = (np.concatenate(parts) for parts in zip(*taken, strict=True))
    for got, want in zip((directions, variances, made.P), filterpys(np.eye(n), rows, r, q), strict=True):
        assert_close(got, want, 1e-12)


@pytest.mark.parametrize("r", [0.0, 1e-5])
@pytest.mark.parametrize("kind", ["line", "low-passed line", "tonal line"])
@pytest.mark.parametrize("n", [8, 30])
def test_P_stays_symmetric_and_positive_definite(n, kind, r, monkeypatch):
    """3000 rows, some of which leave whole directions unseen, where P keeps its first variance or grows by r."""
    refuse_steps(monkeypatch)
    made = Filter(np.eye(n), r, 0.5)
    for rows in rows_of(kind, n, 3000, np.random.default_rng(n)).reshape(-1, 50, n):
        made.take(rows / np.abs(rows).max())
        np.testing.assert_array_equal(made.P, made.P.T)
        np.linalg.cholesky(made.P)  # raises where it is not positive definite
    assert np.linalg.eigvalsh(made.P)[0] < 0.05  # it did learn


ROWS = {
    "white": lambda n, size, rng: rng.standard_normal((size, n)),
    # S passes the limit in the last row: by then the products are made, and thrown away
    "loud at last": lambda n, size, rng: np.vstack([0.1 * rng.standard_normal((size - 1, n)), np.full((1, n), 40.0)]),
    "one tap": lambda n, size, rng: np.repeat(np.eye(n)[:1], size, axis=0),
    "silent": lambda n, size, rng: rng.standard_normal((size, n)) * (np.arange(size) < 4)[:, None],
    # what the indefinite P below is positive on, then what it is negative on
    "contrary": lambda n, size, rng: np.array([np.eye(n)[-1]] * 4 + [np.eye(n)[0] - np.eye(n)[1]] * (size - 4)),
}


@pytest.mark.parametrize(
    ("kind", "P00", "P01", "r", "q", "unsolved_from"),
    [
        ("white", 1e6, 0.0, 1e-4, 1e-2, None),
        ("white", 1.0, 0.0, 1e-4, 0.0, None),
        ("loud at last", 1.0, 0.0, 1e-4, 1.0, None),
        ("one tap", 1.0, 0.0, 0.0, 0.0, 1),  # S of the second is 1 - 1, exactly
        ("silent", 1.0, 0.0, 1e-4, 0.0, 4),
        ("contrary", 1.0, 4.0, 0.0, 1.0, 4),  # no Cholesky factor, though q > 0
    ],
)
@pytest.mark.parametrize("size", [5, 12])
@pytest.mark.parametrize("n", [3, 9])
def test_a_block_that_falls_back_is_its_steps_bit_for_bit(n, size, kind, P00, P01, r, q, unsolved_from):
    """And where a sample has no solution, S is NaN from there on and the covariance that of the samples before."""
    P = P00 * np.eye(n)
    P[0, 1] = P[1, 0] = P01
    rows = ROWS[kind](n, size, np.random.default_rng(n))
    one, two = Filter(P, r, q), Filter(P, r, q)
    (g, S), (want_g, want_S) = one.take(rows), two.take(rows, "advance_by_steps")
    solved = np.arange(size) < (size if unsolved_from is None else unsolved_from)
    np.testing.assert_array_equal(np.isfinite(S), solved)
    assert unsolved_from is not None or S.max() > CANCELLATION * q
    np.testing.assert_array_equal(S, want_S)
    np.testing.assert_array_equal(g[solved], want_g[solved])
    for mine, theirs in zip((*one.cov, one.P), (*two.cov, two.P), strict=True):  # what they owe too
        np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize("loud", [None, 3])
def test_blocks_after_one_that_fell_back_are_products_again(loud):
    """P0/q = 1e8: judged by the steps, since filterpy loses digits that ours keep. Errors were 1e-13."""
    n, q = 12, 1e-4
    one, two = (Filter(1e4 * np.eye(n), 1e-6, q) for _ in range(2))
    in_products = []
    for k, rows in enumerate(rows_of("line", n, 160, np.random.default_rng(0)).reshape(-1, 8, n)):
        rows = 1e3 * rows if k == loud else rows
        (g, S), (want_g, want_S) = one.take(rows), two.take(rows, "advance_by_steps")
        assert_close(S, want_S)
        assert_close(g, want_g)
        assert_close(one.P, two.P)
        assert (S.max() > CANCELLATION * q) == (k in (0, 1, loud))
        in_products.append(one.cov.owed[INVERSE_S] == 0.0)  # by steps, the last downdate is owed
    assert in_products[2 if loud is None else 4 :] == [True] * (18 if loud is None else 16)


@pytest.mark.parametrize("n", [1, 6, 17])
def test_fading_memory_takes_the_steps(n):
    rows, alpha = np.random.default_rng(n).standard_normal((60, n)), 1.01
    one, two = (Filter(np.eye(n), 1e-4, 0.5, alpha) for _ in range(2))
    one_left, two_left = (*one.take(rows), one.P), (*two.take(rows, "advance_by_steps"), two.P)
    for got, same, want in zip(one_left, two_left, filterpys(np.eye(n), rows, 1e-4, 0.5, alpha), strict=True):
        np.testing.assert_array_equal(got, same)
        assert_close(got, want)


# ---- A block whose rows come one at a time: in the loop

FS, N = 8000.0, 500
NAMES = ("KF-ANC", "KF-OPC")
FEEDBACK = [0.0, 0.05]


def controller(name, n_taps=9, block_size=None, secondary=S_HAT, **options):
    kalman = {"state_noise": 1e-5, "measurement_noise": 0.1, "initial_variance": 0.5, "block_size": block_size}
    if name == "KF-ANC":
        return kf_anc(n_taps, secondary, **kalman | options)
    return kf_opc(n_taps, secondary, rated_power=0.3, fs=FS, power_memory=0.01, **kalman | options)


def run(made, x=None, d=None, **options):
    if x is None:
        x, d, _ = noises(N)
    options = {"fs": FS, "secondary_path": S, "sensor_noise_std": 0.05, "rng": 11, "record_powers": True} | options
    return simulate(made, x, disturbance=d, **options)


def assert_run_close(got, want):
    # The same equations with sums in another order. The loop contracts, so that rounding does not grow: errors were
    # 1e-13 of the largest value, and of P, which falls to a hundredth of P0 on the way, 1e-12.
    for name in (*SIGNALS, "weights_time_s"):
        if getattr(want, name) is not None:
            assert_close(getattr(got, name), getattr(want, name), name=name)
    for name in ("algorithm", "fs", "rated_power", "diverged_at_s"):
        assert getattr(got, name) == getattr(want, name), name


def assert_controller_close(got, want):
    mine, theirs = got.estimator, want.estimator
    measured = max(np.abs(theirs.z).max(), 1.0)  # z and y are sums of signals about 1 and larger
    scales = {"x_prior": np.abs(theirs.x).max(), "z": measured, "y": measured}
    for name in ("x", "x_prior", "P", "P_prior", "P_post", "K", "S", "SI", "z", "y"):
        assert_close(getattr(mine, name), getattr(theirs, name), scale=scales.get(name), name=name)
    np.testing.assert_array_equal(mine.P, mine.P.T)
    np.linalg.cholesky(mine.P)
    np.testing.assert_array_equal(got.weights, mine.x[:, 0])
    for name in ("constraint_factor", "disturbance_power", "secondary_path_gain"):
        assert getattr(got, name) == pytest.approx(getattr(want, name), rel=1e-10), name


def ended_in_a_block(made):
    """Sample by sample the last downdate is owed; at the end of a block it is done."""
    return made.estimator._covariance.arrays.owed[INVERSE_S] == 0.0


def assert_block_is_streaming(block, streaming, in_block=True, **options):
    got, want = run(block, **options), run(streaming, **options)
    assert not ended_in_a_block(streaming)
    assert ended_in_a_block(block) == in_block
    assert_run_close(got, want)
    assert_controller_close(block, streaming)
    return got


@pytest.mark.parametrize("feedback", [None, FEEDBACK], ids=["", "feedback"])
@pytest.mark.parametrize("size", [1, 7, 48, 1000])
@pytest.mark.parametrize("n_taps", [1, 3, 64])
@pytest.mark.parametrize("name", NAMES)
def test_blocks_are_sample_by_sample(name, n_taps, size, feedback):
    block, streaming = controller(name, n_taps, size), controller(name, n_taps)
    result = assert_block_is_streaming(block, streaming, feedback_path=feedback)
    assert (result.constraint_factor.min() < 0.9) == (name == "KF-OPC")  # it did act


@pytest.mark.parametrize("size", [7, 48])
@pytest.mark.parametrize("name", NAMES)
def test_options_of_the_run_and_no_state_noise(name, size):
    for options in ({"switch_on_s": 100 / FS}, {"record_weights_every": 13, "feedback_path": FEEDBACK}):
        assert_block_is_streaming(controller(name, block_size=size), controller(name), **options)
    options = {"amplifier": HardClipAmplifier(0.4), "record_weights_every": 1}
    clipped = assert_block_is_streaming(controller(name, block_size=size), controller(name), **options)
    assert np.any(clipped.amplifier_output != clipped.control_signal)
    assert len(np.unique(clipped.weights, axis=0)) > 0.9 * N  # of each sample, not of the ends of blocks
    for n_taps in (1, 9, 40):
        block, streaming = (controller(name, n_taps, m, state_noise=0.0, measurement_noise=0.2) for m in (size, None))
        assert_block_is_streaming(block, streaming)


@pytest.mark.parametrize(("size", "in_block"), [(7, True), (48, True), (1000, False)])
@pytest.mark.parametrize("n_taps", [1, 9, 40])
@pytest.mark.parametrize("name", NAMES)
def test_after_a_large_start_samples_leave_the_block(name, n_taps, size, in_block):
    """P0/q = 1e7: S passes 1000 q after a quiet beginning, within a block under way. The next block is open again."""
    options = {"state_noise": 1e-9, "initial_variance": 1e3, "measurement_noise": 1e-4, "secondary": S}
    x, d, _ = noises(N)
    x[:20] *= 1e-3
    filtered = np.convolve(x, S)[:N]
    assert 1e3 * np.sum(filtered[:20] ** 2) < 0.9 * CANCELLATION * 1e-4 < 1e3 * filtered[21] ** 2
    block, streaming = controller(name, n_taps, size, **options), controller(name, n_taps, **options)
    assert_block_is_streaming(block, streaming, in_block, x=x, d=d)
    assert_block_is_streaming(block, streaming)  # the same controllers, once they have learnt


@pytest.mark.parametrize("name", NAMES)
def test_what_the_block_is_not_for_goes_on_by_steps_bit_for_bit(name):
    """Fading memory, filterpy's own equations, a run that is not compiled."""
    for alpha, Q, compiled in ((1.001, 1e-5, True), (1.0, np.diag(np.linspace(1e-6, 1e-5, 9)), True), (1.0, 0, False)):
        block, streaming = controller(name, block_size=16), controller(name)
        for made in (block, streaming):
            made.estimator.alpha, made.estimator.Q = alpha, Q
        assert_same_run(run(block, compiled=compiled), run(streaming, compiled=compiled))
        assert_same_estimator(block.estimator, streaming.estimator)


@pytest.mark.parametrize("size", [1, 7, 48, 1000])
@pytest.mark.parametrize("name", NAMES)
def test_runs_go_on_where_the_last_one_ended(name, size):
    """Runs, steps by hand, listening and edits in turn, as of a controller that knows no blocks."""
    block, streaming = controller(name, block_size=size), controller(name)
    x, d, _ = noises(N, seed=8)
    assert_block_is_streaming(block, streaming)
    assert_block_is_streaming(block, streaming, x=x[:30], d=d[:30])
    for made in (block, streaming):
        for reference, error in zip(x[:5], d[:5], strict=True):
            made.control_signal(reference)
            made.update(error)
    assert_controller_close(block, streaming)
    assert_block_is_streaming(block, streaming, x=x[:77], d=d[:77], switch_on_s=10 / FS)
    for made in (block, streaming):
        made.estimator.P[0, 0] *= 3.0
        made.estimator.predict()
    assert_block_is_streaming(block, streaming)


@pytest.mark.parametrize("step", [1, 7, 48, 499])
def test_pieces_of_the_run_do_not_show(step, monkeypatch):
    """A piece ends the block under way: another order of sums, so to rounding."""
    whole, done = run(controller("KF-OPC", block_size=48), record_weights_every=10), []
    monkeypatch.setattr(simulation, "STEP", step)
    made = controller("KF-OPC", block_size=48)
    assert_run_close(run(made, record_weights_every=10, progress=done.append), whole)
    assert (sum(done), max(done)) == (N, step)
    assert ended_in_a_block(made)


@pytest.mark.parametrize("size", [7, 48, 4000])
def test_a_run_that_diverges(size):
    """The loop feeds back positively: rounding grows with the signals, and is no larger part of them."""
    x, d, _ = noises(3000)
    block, streaming = (controller("KF-ANC", 6, m, secondary=-S_HAT, state_noise=1e-2) for m in (size, None))
    result = assert_block_is_streaming(block, streaming, x=x, d=d)
    assert 0 < result.diverged_at_s * FS < 3000
    np.testing.assert_array_equal(np.isnan(result.error), result.time_s >= result.diverged_at_s)
    for made in (block, streaming):  # from where it is it diverges at once
        assert run(made, x=x, d=d).diverged_at_s < result.diverged_at_s


@pytest.mark.parametrize("size", [7, 48, 1000])
def test_a_sample_that_is_refused_leaves_the_samples_before_it(size):
    x, d, _ = noises(N)
    d[60] = 1e200
    block, streaming = controller("KF-OPC", block_size=size), controller("KF-OPC")
    for made in (block, streaming):
        with pytest.raises(ValueError, match="measurement must have a finite square") as caught:
            run(made, x=x, d=d)
        assert caught.value.__notes__ == ["in sample 60 of the run"]
    assert_controller_close(block, streaming)
    assert_block_is_streaming(block, streaming)


@pytest.mark.parametrize(("place", "heard"), [("progress", 100), ("run", 20)])
def test_an_interrupted_run_leaves_a_controller_that_goes_on(place, heard, monkeypatch):
    """Control-C in the second block of ten comes through when the compiled loop returns, before its answer is kept."""
    monkeypatch.setattr(simulation, "STEP", 100)
    compiled_run, calls = simulation.run, []

    def interrupt(*arguments):
        calls.append(place == "progress" or compiled_run(*arguments))
        if place == "progress" or len(calls) == 2:
            raise KeyboardInterrupt
        return calls[-1]

    block, streaming = controller("KF-OPC", block_size=10), controller("KF-OPC")
    x, d, _ = noises(N)
    if place == "run":
        monkeypatch.setattr(simulation, "run", interrupt)
    with pytest.raises(KeyboardInterrupt):
        run(block, x=x, d=d, progress=interrupt if place == "progress" else None)
    monkeypatch.setattr(simulation, "run", compiled_run)
    run(streaming, x=x[:heard], d=d[:heard])
    assert_controller_close(block, streaming)
    assert_block_is_streaming(block, streaming)


def test_a_block_run_that_ends_in_its_first_sample():
    """Opening a block pays what the last hand step owed: P_prior and P_post must not notice."""
    block, streaming = controller("KF-OPC", block_size=48), controller("KF-OPC")
    x, d, _ = noises()
    for made in (block, streaming):
        for n in range(5):
            made.control_signal(x[n])
            made.update(d[n])
        made.estimator.x[0] = 1e9
        assert run(made).diverged_at_s == 0.0
    assert_controller_close(block, streaming)


@pytest.mark.parametrize("growth", [2.0, 5.0, 10.0])
def test_an_amplitude_that_grows_within_a_block(growth):
    """Each sample's S is moderate, but the block as a whole takes nearly all of P: it must not cost P's digits."""
    x = 0.03 * growth ** np.arange(12.0)
    got, want = (
        simulate(
            kf_anc(1, [1.0], state_noise=0.0, measurement_noise=1.0, initial_variance=1e6, block_size=size),
            x,
            disturbance=np.ones(12),
            secondary_path=[1.0],
            record_weights_every=1,
            record_powers=True,
        )
        for size in (12, None)
    )
    assert_run_close(got, want)


@pytest.mark.parametrize(
    "clone", [copy.deepcopy, lambda made: pickle.loads(pickle.dumps(made))], ids=["copy", "pickle"]
)
def test_a_copy_goes_on_alone(clone):
    made = controller("KF-OPC", block_size=16)
    run(made)
    twin = clone(made)
    assert_same_run(run(made), run(twin))
    assert ended_in_a_block(twin)
    assert_same_estimator(made.estimator, twin.estimator)


@given(n_taps=st.integers(1, 40), size=st.integers(1, 60), seed=st.integers(0, 1000))
@settings(max_examples=25)
def test_any_taps_and_any_size(n_taps, size, seed):
    x, d, _ = noises(200, seed)
    assert_block_is_streaming(controller("KF-OPC", n_taps, size), controller("KF-OPC", n_taps), x=x, d=d)


@pytest.mark.parametrize("name", [*NAMES, None])
@pytest.mark.parametrize(
    ("size", "kind", "message"),
    [
        (0, ValueError, "block_size must be at least 1, got 0"),
        (-1, ValueError, "block_size must be at least 1, got -1"),
        (2.5, TypeError, "block_size must be a whole number, got 2.5"),
        ("8", TypeError, "block_size must be a whole number, got '8'"),
    ],
)
def test_refuses(size, kind, message, name):
    with pytest.raises(kind, match=message):
        controller(name, block_size=size) if name else KalmanController(KFOPC(4), S_HAT, block_size=size)


# ---- Two samples at a time


@pytest.mark.parametrize("alpha", [1.0, 1.001])
@pytest.mark.parametrize("n", [1, 7, 30])
def test_pairs_leave_to_steps_what_would_cancel(n, alpha):
    """S starts 1e6 times q: those samples are as by steps to the bit, the rest to rounding; so is a fading memory."""
    rows = rows_of("line", n, 101, np.random.default_rng(n))
    pairs, steps = (Filter(1e3 * np.eye(n), 1e-6, 1e-3, alpha) for _ in range(2))
    (g, S), (g_steps, S_steps) = pairs.take(rows, "advance_in_pairs"), steps.take(rows, "advance_by_steps")
    assert S_steps[0] > 1e3 * 1e-3
    np.testing.assert_array_equal(S[: min(n, 16)], S_steps[: min(n, 16)])
    assert_close(S, S_steps, 1e-9)
    assert_close(g, g_steps, 1e-9)
    assert_close(pairs.P, steps.P, 1e-9)
    assert np.array_equal(S, S_steps) == (alpha != 1.0)


def test_pairs_stop_where_a_sample_has_no_solution():
    """A silent row without measurement noise, after ones that are taken."""
    rows = rows_of("line", 5, 20, np.random.default_rng(0))
    rows[9:] = 0.0
    _, S = Filter(np.eye(5), 1e-4, 0.0).take(rows, "advance_in_pairs")
    np.testing.assert_array_equal(np.isnan(S), np.arange(20) >= 9)


@pytest.mark.parametrize("n", [3, 16, 21])
def test_the_blocks_on_the_diagonal_stay_symmetric_to_the_bit(n):
    kept = Filter(np.eye(n), 1e-4, 0.5)
    kept.take(rows_of("line", n, 400, np.random.default_rng(n)), "advance_in_pairs")
    for i in range(0, n, 8):
        block = kept.cov.triangle[i : i + 8, i : i + 8]
        np.testing.assert_array_equal(block, block.T)
