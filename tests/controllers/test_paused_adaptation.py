"""KF-PB while it does not adapt: what is played in the meantime is spent, and heard, all the same."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.linalg

from kfopc_filterpy import kf_pb
from kfopc_filterpy.signals import band_limited_noise

FS, N_TAPS, RATED = 8000.0, 24, 0.3
S = np.array([0.0, 0.0, 0.0, 0.8, 0.3, -0.1])
PRIMARY = np.convolve(S, [0.0, 0.0, 1.5, -0.6, 0.4])
KALMAN: dict[str, Any] = {"state_noise": 1e-9, "measurement_noise": 1e-3, "initial_variance": 0.1}
X = band_limited_noise((100.0, 500.0), 6.0, fs=FS, rng=0)
X = X / X.std()
D = np.convolve(X, PRIMARY)[: X.size] + 0.01 * np.random.default_rng(1).standard_normal(X.size)


def made(form: str, **options: Any) -> Any:
    """One loudspeaker; "one channel" has no channel axis."""
    settings = {"rated_power": RATED, "fs": FS, "secondary_path_uncertainty": None} | options
    if form == "one channel":
        return kf_pb(N_TAPS, S, **KALMAN, **settings)
    return kf_pb(N_TAPS, S[np.newaxis, np.newaxis], form=form, **(KALMAN if form == "direct" else {}), **settings)


def run(controller: Any, paused: Callable[[int], bool], x: np.ndarray = X, d: np.ndarray = D) -> Any:
    """Sample by sample; return the control signal and the error."""
    y, e, played = np.zeros(x.size), np.zeros(x.size), np.zeros(S.size)
    several = controller.multichannel
    for n in range(x.size):
        y[n] = np.ravel(controller.control_signal(x[n : n + 1] if several else x[n]))[0]
        played[1:] = played[:-1].copy()
        played[0] = y[n]
        e[n] = d[n] - S @ played
        if not paused(n):
            controller.update(e[n : n + 1] if several else e[n])
    return y, e


FORMS = ("one channel", "direct", "shared gain", "frequency domain")


@pytest.mark.parametrize("form", FORMS)
def test_short_pauses_change_nothing(form: str) -> None:
    """10 ms of each 250 ms."""
    half = X.size // 2
    found = []
    for paused in (lambda n: False, lambda n: n % 2000 < 80):
        y, e = run(made(form), paused)
        found.append((np.mean(y[half:] ** 2) / RATED, -10 * np.log10(np.mean(e[half:] ** 2) / np.mean(D[half:] ** 2))))
    (power, reduction), (paused_power, paused_reduction) = found
    assert paused_power == pytest.approx(power, rel=0.03)
    assert paused_reduction == pytest.approx(reduction, abs=0.1)
    assert reduction > 4.0


@pytest.mark.parametrize("form", ["direct", "shared gain", "frequency domain"])
def test_the_correlation_stays_positive_definite(form: str) -> None:
    """After every block, whatever is left out, and if only a sample. To the rounding of its FFTs."""
    rng, controller = np.random.default_rng(3), made(form)
    paused = np.repeat(rng.random(X.size // 100 + 1) < 0.3, 100)[: X.size] | (rng.random(X.size) < 0.001)
    least = []

    def seen(n: int) -> bool:
        if n % 256 == 0 and controller._correlation.mass > 0.0:
            row = controller._correlation.faded[:N_TAPS, 0, 0]
            least.append(np.linalg.eigvalsh(scipy.linalg.toeplitz(row))[0] / row[0])
        return bool(paused[n])

    run(controller, seen, X[:16000], D[:16000])
    assert len(least) > 50
    assert min(least) > -1e-12


@pytest.mark.parametrize("how", ["not updated", "not adapted to", "refused"])
def test_what_is_played_meanwhile_is_booked(how: str) -> None:
    """All of it, and the correlations are those of the signal without gaps."""
    controller, steady = made("one channel", averaging_s=1.6), made("one channel", averaging_s=1.6)
    x, d = X[:20000], 0.0 * D[:20000]  # the error does not depend on the control signal
    n = np.arange(x.size)
    paused = (n % 100 > 70) & (n > 100) & (n < x.size - 1)
    y = np.zeros(x.size)
    if how == "not adapted to":
        y = controller.process(x, d, adapt=~paused)
    else:
        for n in range(x.size):
            y[n] = controller.control_signal(x[n])
            if not paused[n]:
                controller.update(d[n])
            elif how == "refused":
                with pytest.raises(ValueError, match="finite square"):
                    controller.update(1e200)
    budget = controller.estimator.budget
    spent = np.sum(y[-round(1.6 * FS) :] ** 2) / RATED / FS
    assert budget.account_s == pytest.approx(spent - 1.6, abs=1e-9)
    assert budget.state.numbers["limited"][0] == 0.0
    assert budget.ceiling == 2.0  # no limiter was heard
    steady.process(x, d)
    for name in ("own", "across", "counts"):
        ours, theirs = (getattr(one.estimator.budget.state, name) for one in (controller, steady))
        np.testing.assert_allclose(ours, theirs, rtol=1e-12)


def test_a_sample_that_cannot_be_squared_is_silence_to_the_budget() -> None:
    controller = made("one channel")
    controller.process(X[:4000], D[:4000])
    for _ in range(3):
        controller.control_signal(1e200)
        with pytest.raises(ValueError, match="finite square"):
            controller.update(0.0)
    controller.process(X[4000:4100], D[4000:4100], adapt=False)
    assert all(np.all(np.isfinite(part)) for part in (controller.estimator.budget.state.own, controller.control_filter))
    y = controller.process(X[4100:12000], D[4100:12000])
    assert np.mean(y[4000:] ** 2) < 2.0 * RATED


@pytest.mark.parametrize("form", FORMS)
def test_a_loud_noise_that_is_not_adapted_to_is_paid_for(form: str) -> None:
    """A quarter of each second, 6 dB louder.

    Without its power on the account, one channel spent 1.8 times the rating. With gaps in the correlation, which then was
    not positive definite, several channels spent 1e13 times it.
    """
    n = np.arange(72000)
    loud = n % 8000 < 2000
    x = band_limited_noise((100.0, 500.0), 9.0, fs=FS, rng=0) * np.where(loud, 2.0, 1.0)
    x /= x.std()
    d = np.convolve(x, PRIMARY)[: x.size]
    y, _ = run(made(form, averaging_s=3.0), lambda i: bool(loud[i]) and i > FS, x, d)
    assert np.mean(y[24000:] ** 2) / RATED < 1.1


def test_listening_without_following_keeps_the_correlations_whole() -> None:
    one, other = made("one channel"), made("one channel")
    one.listen(X[:5000], D[:5000])
    other.listen(X[:5000], D[:5000], adapt=np.arange(5000) % 3 > 0)
    for controller in (one, other):
        controller.control_signal(X[5000])
        controller.update(D[5000])
    for name in ("own", "across", "counts"):
        np.testing.assert_array_equal(
            getattr(one.estimator.budget.state, name), getattr(other.estimator.budget.state, name)
        )
