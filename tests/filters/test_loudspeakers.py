"""KFOPC with several measurements and a rated power for each loudspeaker: against eq. 9-13 around filterpy's filter."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from oracles.powers import Constraint, least_factor, loudspeaker_factors

from kfopc_filterpy import KFOPC, OutputPowerConstraint

K, J, I, L = 3, 2, 2, 4  # microphones, loudspeakers, references, taps  # noqa: E741
N, FS, MEMORY = J * I * L, 16000.0, 40
RATED = np.array([0.5, 2.0])


def signals(n_samples: int = 150, seed: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Measurements (n, K), observations (n, K, N), references (n, I)."""
    rng = np.random.default_rng(seed)
    z, xf = rng.standard_normal((n_samples, K)), rng.standard_normal((n_samples, K, J, I)) * [[[2.0], [0.7]]]
    rows = np.zeros((n_samples, K, J, I, L))
    for m in range(L):
        rows[m:, ..., m] = xf[: n_samples - m]
    return 2.0 * z, rows.reshape(n_samples, K, N), rng.standard_normal((n_samples, I))


def constraints() -> list[OutputPowerConstraint]:
    return [OutputPowerConstraint(power, fs=FS, memory_s=MEMORY / FS) for power in RATED]


def made(**changed: Any) -> KFOPC:
    kf = KFOPC(N, K, **({"constraint": constraints()} | changed))
    kf.Q, kf.R = 1e-4 * np.eye(N), np.diag([0.1, 0.2, 0.3])
    return kf


def oracles() -> list[Constraint]:
    return [Constraint(power, fs=FS, memory_s=MEMORY / FS) for power in RATED]


def test_each_step_is_filterpys_of_the_measurements_scaled_by_the_least_factor() -> None:
    """Bit for bit given the factor, which agrees to 1e-12."""
    z, rows, x = signals()
    ours, theirs = made(), KalmanFilter(N, K)
    theirs.Q, theirs.R = ours.Q, ours.R
    deciding, oracle = set(), oracles()
    for n in range(len(z)):
        for kf in (ours, theirs):
            kf.predict()
        ours.update(z[n], H=rows[n], reference=x[n])
        factors = loudspeaker_factors(oracle, z[n], rows[n].reshape(K, J, I, L), x[n][:, np.newaxis])
        assert ours.constraint_factor == pytest.approx(factors.min(), rel=1e-12)
        deciding.add(int(factors.argmin()))
        theirs.update(ours.constraint_factor * z[n].reshape(-1, 1), H=rows[n])
        np.testing.assert_array_equal(ours.x, theirs.x)
        np.testing.assert_array_equal(ours.z, z[n].reshape(-1, 1))
    np.testing.assert_array_equal(ours.P, theirs.P)
    assert deciding == {0, 1}  # at times one loudspeaker decides, at times the other
    assert ours.constraint_factor < 0.9
    np.testing.assert_allclose(ours.disturbance_power, oracle[0].disturbance_power, rtol=1e-12)


def test_one_rated_power_for_several_measurements_is_one_loudspeaker() -> None:
    """Squares are summed over measurements, and over references."""
    z, rows, x = signals()
    one, listed, two = (KFOPC(N, K, rated_power=power, fs=FS) for power in (0.5, [0.5], [0.5]))
    for n in range(20):
        for kf, reference in ((one, x[n, 0]), (listed, x[n, 0]), (two, x[n])):
            kf.predict()
            kf.update(z[n], H=rows[n], reference=reference)
    for kf, n_references in ((one, 1), (two, 2)):
        newest = rows.reshape(-1, K, 1, n_references, N // n_references)[:20, ..., 0]
        gain = np.sum(newest**2) / np.sum(x[:20, :n_references] ** 2)
        factor = np.sqrt(0.5 * gain / np.mean(np.sum(z[:20] ** 2, axis=1)))
        np.testing.assert_allclose(kf.secondary_path_gain, gain, rtol=1e-12)
        assert kf.constraint_factor == pytest.approx(factor, rel=1e-12)
        assert factor < 1.0
    np.testing.assert_array_equal(one.x, listed.x)
    assert isinstance(one.rated_power, float)
    assert listed.rated_power.tolist() == [0.5]


def test_a_loudspeaker_that_no_microphone_hears_is_left_out() -> None:
    z, rows, x = signals()
    unplugged = rows.reshape(-1, K, J, I, L).copy()
    unplugged[:, :, 1] = 0.0
    kf, oracle = made(), oracles()
    for n in range(len(z)):
        kf.predict()
        kf.update(z[n], H=unplugged[n].reshape(K, N), reference=x[n])
        loudspeaker_factors(oracle, z[n], unplugged[n], x[n][:, np.newaxis])
    np.testing.assert_array_equal(kf.x.reshape(J, -1)[1], 0.0)
    assert kf.constraint_factor == pytest.approx(least_factor(oracle), rel=1e-12)
    kf = KFOPC(N, K, rated_power=RATED, fs=FS)  # none is heard: eq. 13 gives 0, as with one loudspeaker
    kf.update(z[0], H=np.zeros((K, N)), reference=x[0])
    assert kf.constraint_factor == 0.0


def test_supplied_values_need_no_reference() -> None:
    z, rows, _ = signals()
    kf = KFOPC(N, K, rated_power=RATED, fs=FS)
    kf.disturbance_power, kf.secondary_path_gain = 4.0, [1.0, 0.125]
    kf.update(z[0], H=rows[0])
    assert kf.constraint_factor == 0.25  # the least of sqrt(0.5 / 4) and sqrt(2 * 0.125 / 4)
    np.testing.assert_array_equal(kf.secondary_path_gain, [1.0, 0.125])
    kf.constraint_factor = 0.5
    kf.update(z[0], H=rows[0])
    assert kf.constraint_factor == 0.5
    kf.constraint_factor = None
    kf.secondary_path_gain = None
    with pytest.raises(ValueError, match="secondary-path gain is unknown"):
        kf.update(z[0], H=rows[0])


def test_the_rated_powers_can_be_changed_and_lifted_and_the_settings_stay() -> None:
    z, rows, x = signals()
    kf = made()
    kf.update(z[0], H=rows[0], reference=x[0])
    kf.rated_power = 3.0
    assert kf.rated_power.tolist() == [3.0, 3.0]
    assert kf.disturbance_power[0] > 0.0  # the powers stay
    for bad, message in (([1.0, 2.0, 3.0], "each of the 2 loudspeakers"), ([1.0, 0.0], "must be greater than 0")):
        with pytest.raises(ValueError, match=message):
            kf.rated_power = bad
    assert kf.rated_power.tolist() == [3.0, 3.0]
    kf.rated_power = None
    assert (kf.rated_power, kf.constraint, kf.constraint_factor) == (None, None, 1.0)
    kf.rated_power = 1.0
    assert [one.memory_s for one in kf.constraint] == [MEMORY / FS] * 2
    assert kf.disturbance_power.tolist() == [0.0, 0.0]  # new powers
    single = KFOPC(N, K, constraint=constraints()[0])
    single.rated_power = RATED
    assert [one.memory_s for one in single.constraint] == [MEMORY / FS] * 2


def test_batches_are_the_steps_and_the_constraints_are_the_filters_own() -> None:
    z, rows, x = signals()
    given = constraints()
    kf, steps = made(constraint=given), made()
    given[0].rated_power = 99.0
    assert kf.rated_power[0] == RATED[0]
    kf.batch_filter(list(z[:30, :, np.newaxis]), Hs=list(rows[:30]), references=x[:30])
    for n in range(30):
        steps.predict()
        steps.update(z[n], H=rows[n], reference=x[n])
    np.testing.assert_array_equal(kf.x, steps.x)
    assert kf.constraint_factor == steps.constraint_factor


FAULTS: dict[str, tuple[Callable[[KFOPC], Any], type[Exception], str]] = {
    "NaN": (lambda kf: kf.update([1.0, np.nan, 1.0], H=np.ones((K, N)), reference=[1.0, 1.0]), ValueError, "z must be finite"),
    "overflow": (lambda kf: kf.update([1.0, 1e200, 1.0], H=np.ones((K, N)), reference=[1.0, 1.0]), ValueError, "the measurement must have a finite square"),
    "no reference": (lambda kf: kf.update(np.ones(K), H=np.ones((K, N))), ValueError, "pass reference="),
    "NaN reference": (lambda kf: kf.update(np.ones(K), H=np.ones((K, N)), reference=[1.0, np.nan]), ValueError, "reference must be finite"),
    "three references": (lambda kf: kf.update(np.ones(K), H=np.ones((K, N)), reference=np.ones(3)), ValueError, r"2 loudspeaker\(s\) for 3 reference\(s\)"),
    "two rows": (lambda kf: kf.update(np.ones(2), R=np.eye(2), H=np.ones((2, N)), reference=np.ones(2)), ValueError, "needs all dim_z = 3 measurements, rows of H, got 2"),
    "short batch": (lambda kf: kf.batch_filter([np.ones((K, 1))] * 3, references=np.ones((2, I))), ValueError, "references must have 3 values"),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_what_does_not_fit_is_refused_with_nothing_changed(name: str) -> None:
    z, rows, x = signals()
    kf, twin = made(), made()
    for one in (kf, twin):
        one.update(z[0], H=rows[0], reference=x[0])
    call, error, message = FAULTS[name]
    with pytest.raises(error, match=message):
        call(kf)
    for one in (kf, twin):
        one.update(z[1], H=rows[1], reference=x[1])
    np.testing.assert_array_equal(kf.x, twin.x)
    np.testing.assert_array_equal(kf.disturbance_power, twin.disturbance_power)


def test_settings_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="dim_x = 5 states cannot be the control filters of 2 loudspeakers"):
        KFOPC(5, rated_power=[1.0, 2.0], fs=FS)
    for bad in ([], [1.0, "loud"]):
        with pytest.raises(TypeError):
            KFOPC(4, rated_power=bad, fs=FS)
    with pytest.raises(TypeError, match="constraint must be an OutputPowerConstraint or None"):
        KFOPC(4, constraint=[OutputPowerConstraint(1.0, fs=8000), 2.0])
    fast = KFOPC.random_walk(4, state_noise=0.0, measurement_noise=1.0, fs=FS)
    with pytest.raises(TypeError, match=r"this filter has one loudspeaker, .* not a sequence of 2"):
        fast.rated_power = [1.0, 2.0]
    fast.rated_power = 1.0
    with pytest.raises(TypeError, match="reference must be a single number"):
        fast.update(1.0, H=np.ones(4), reference=[1.0, 2.0])
