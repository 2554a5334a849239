"""Virtual microphones: against the controller that hears the virtual places, and dense conditional means."""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import pytest
from helpers.channels import random_paths, through
from helpers.simulation import Playing

from kfopc_filterpy import Plant, fx_lms, kf_pb, noise_reduction_db, simulate
from kfopc_filterpy.bounds import predictor_reference
from kfopc_filterpy.controllers import KalmanObserver, VirtualMicrophones, with_internal_model
from kfopc_filterpy.controllers.base import WrappedController
from kfopc_filterpy.paths import ObservationFilters

FS, TAPS, J = 4000.0, 12, 2
PHYSICAL, VIRTUAL = [3, 0], [2, 1]
SECONDARY = random_paths(4, J, 6, seed=1)
OBSERVATION = random_paths(2, 2, 4, seed=2, delay=0)
TO_PHYSICAL = random_paths(2, 1, 10, seed=3, delay=4)


def primary() -> np.ndarray:
    """Paths in which the disturbance at the virtual microphones is exactly the observation filters' output."""
    paths = np.zeros((4, 1, 13))
    paths[PHYSICAL, :, :10] = TO_PHYSICAL
    for v, row in zip(VIRTUAL, OBSERVATION, strict=True):
        paths[v, 0] = sum(np.convolve(o, p[0]) for o, p in zip(row, TO_PHYSICAL, strict=True))
    return paths


def noise(n_samples: int = 1500, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((1, n_samples))


def inner(**options: Any) -> Any:
    return fx_lms(TAPS, SECONDARY[VIRTUAL], step_size=0.003, **options)


def made(observer: Any = OBSERVATION, controller: Any = None, **options: Any) -> VirtualMicrophones:
    controller = inner() if controller is None else controller
    return VirtualMicrophones(controller, SECONDARY, observer, physical=PHYSICAL, virtual=VIRTUAL, **options)


def run(controller: Any, **options: Any) -> Any:
    return simulate(controller, noise(), Plant(SECONDARY, primary(), fs=FS), **options)


def silent() -> Playing:
    return Playing(lambda _: np.zeros(1))


# ---- The wrapper


@pytest.mark.parametrize("switch_on_s", [0.0, 50 / FS], ids=["at once", "after listening"])
@pytest.mark.parametrize("kind", ["FxLMS", "KF-PB"])
def test_with_exact_filters_it_is_the_controller_that_hears_the_virtual_places(kind: str, switch_on_s: float) -> None:
    def one() -> Any:
        return inner() if kind == "FxLMS" else kf_pb(TAPS, SECONDARY[VIRTUAL], rated_power=0.2, fs=FS)

    controller, there = made(controller=one()), one()
    got = run(controller, switch_on_s=switch_on_s)
    want = simulate(there, noise(), Plant(SECONDARY[VIRTUAL], primary()[VIRTUAL], fs=FS), switch_on_s=switch_on_s)
    scale = np.abs(want.control_signal).max()
    np.testing.assert_allclose(got.control_signal, want.control_signal, rtol=0, atol=1e-9 * scale)
    np.testing.assert_allclose(got.error[VIRTUAL], want.error, rtol=0, atol=1e-9)
    np.testing.assert_allclose(controller.weights, there.weights, rtol=0, atol=1e-9)
    np.testing.assert_allclose(controller.virtual_error, got.error[VIRTUAL, -1], atol=1e-9)
    assert noise_reduction_db(want.error, want.disturbance) > 1.0  # it did something
    assert got.algorithm == f"{there.name} with virtual microphones"


@pytest.mark.parametrize("switch_on_s", [0.0, 50 / FS], ids=["at once", "after listening"])
@pytest.mark.parametrize("n_references", [0, 1], ids=["feedback", "hybrid"])
def test_with_an_internal_model_the_noise_at_the_virtual_places_is_the_reference(
    n_references: int, switch_on_s: float
) -> None:
    """Feedforward control with what the observation filters make of d_p, a sample late; a pause at each fifth sample."""

    class Pausing(WrappedController):
        n = 0

        def control_signal(self, reference: Any) -> Any:
            return self.controller.control_signal(reference)

        def update(self, error: Any) -> None:
            self.n += 1
            (self.controller.update if self.n % 5 else self.controller.take_error)(error)

    d = through(primary(), noise())
    at_virtual = through(OBSERVATION, d[PHYSICAL])
    x = noise()[:n_references]
    fed_back, forward = (inner(n_references=n_references + len(VIRTUAL)) for _ in range(2))
    options: Any = {"plant": Plant(SECONDARY, fs=FS), "disturbance": d, "switch_on_s": switch_on_s}
    got = simulate(Pausing(made(controller=with_internal_model(fed_back)), ""), x if n_references else None, **options)
    reference = np.concatenate((x, predictor_reference(at_virtual)))
    want = simulate(Pausing(made(controller=forward), ""), reference, **options)
    np.testing.assert_allclose(got.error, want.error, rtol=0, atol=1e-9)
    assert np.abs(want.control_signal).max() > 0.01


def test_one_filter_of_one_tap_and_the_default_of_the_virtual_ones() -> None:
    """And `ObservationFilters` in place of an array."""
    filters = ObservationFilters(np.array([[[0.5]]]), np.zeros(1))
    controller = VirtualMicrophones(silent(), SECONDARY[:2, :1], filters, physical=[1])
    assert controller.virtual.tolist() == [0]
    controller.control_signal([1.0])
    controller.update([np.nan, 4.0])  # the virtual one is not read
    assert controller.virtual_error.tolist() == [2.0]
    assert repr(controller) == "<Playing with virtual microphones: 1 physical, 1 virtual>"


# ---- The Kalman form


def random_model(direct: bool) -> control.StateSpace:
    """Three states, two noise sources and two loudspeakers, two physical and two virtual microphones."""
    rng = np.random.default_rng(6)
    A = 0.8 * np.linalg.qr(rng.standard_normal((3, 3)))[0]
    D = np.zeros((4, 4))
    D[:, :2] = direct * rng.standard_normal((4, 2))
    return control.StateSpace(A, rng.standard_normal((3, 4)), rng.standard_normal((4, 3)), D, 1 / FS)


def responses(model: control.StateSpace, n_taps: int) -> np.ndarray:
    taps = [model.D] + [model.C @ np.linalg.matrix_power(model.A, n) @ model.B for n in range(n_taps - 1)]
    return np.moveaxis(taps, 0, 2)


@pytest.mark.parametrize("direct", [False, True], ids=["delayed", "direct"])
def test_the_estimate_is_the_conditional_mean_of_gaussian_signals(direct: bool) -> None:
    """Given all of 80 samples at the physical microphones, by dense covariances; the model forgets 0.8 a sample."""
    model, n = random_model(direct)[:, :2], 80
    observer = KalmanObserver(model, 2, sensor_noise_std=0.3, source_power=[1.0, 0.5])
    taps = responses(model, n + 200) * np.sqrt([1.0, 0.5])[np.newaxis, :, np.newaxis]
    lags = np.array([np.einsum("aim,bim->ab", taps[..., m:], taps[..., : taps.shape[2] - m]) for m in range(n)])
    covariance = np.block([[lags[i - j] if i >= j else lags[j - i].T for j in range(n)] for i in range(n)])
    heard = np.ravel([[4 * m, 4 * m + 1] for m in range(n)])  # block i is sample i, oldest first
    last = [4 * n - 2, 4 * n - 1]
    of_heard = covariance[np.ix_(heard, heard)] + 0.09 * np.eye(2 * n)
    gain = np.linalg.solve(of_heard, covariance[np.ix_(heard, last)]).T
    variance = covariance[np.ix_(last, last)] - gain @ covariance[np.ix_(heard, last)]
    np.testing.assert_allclose(observer.virtual_variance, np.diag(variance), rtol=1e-6)
    share = np.diag(variance) / np.diag(covariance[np.ix_(last, last)])
    np.testing.assert_allclose(observer.residual_db, 10 * np.log10(share), atol=1e-5)
    assert repr(observer).startswith("<KalmanObserver: 3 states, 2 physical and 2 virtual microphone(s), residual -")
    d = np.random.default_rng(9).standard_normal((n, 2))
    for sample in d[:-1]:
        observer.advance(sample)
    np.testing.assert_allclose(observer.estimate(d[-1]), gain @ d.ravel(), atol=1e-7)


# ---- What is refused


@pytest.mark.parametrize(
    ("changed", "error", "message"),
    [
        ({"physical": [0, 4]}, ValueError, r"physical must be different indices of the 4 microphones .* got \[0, 4\]"),
        ({"virtual": [-1]}, ValueError, "virtual must be at least 0"),
        ({"physical": [0, 1, 2, 3], "virtual": None}, ValueError, "virtual must name a microphone"),
        ({"observer": np.ones((2, 3, 4))}, ValueError, "from the 2 physical to the 2 virtual .* leads from 3 to 2"),
        ({"observer": np.ones((2, 2))}, ValueError, r"filters \(K_v, K_p, n_taps\), got shape \(2, 2\)"),
        ({"controller": fx_lms(TAPS, SECONDARY, step_size=0.1)}, ValueError, "for the 2 virtual .* n_microphones is 4"),
        ({"controller": fx_lms(TAPS, SECONDARY[:2, :1], step_size=0.1)}, ValueError, "n_loudspeakers is 1"),
        ({"controller": fx_lms}, TypeError, "controller must have control_signal"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_settings_that_do_not_fit_are_refused(changed: dict[str, Any], error: type[Exception], message: str) -> None:
    settings = {
        "controller": inner(),
        "secondary": SECONDARY,
        "observer": OBSERVATION,
        "physical": PHYSICAL,
        "virtual": VIRTUAL,
    } | changed
    with pytest.raises(error, match=message):
        VirtualMicrophones(**settings)


@pytest.mark.parametrize(
    ("model", "changed", "error", "message"),
    [
        ([[1.0]], {}, TypeError, "model must be a control.StateSpace, got list"),
        (control.StateSpace([[0.5]], [[1.0]], [[1.0], [1.0]], 0.0), {}, ValueError, r"dt = 1/fs, got dt = 0"),
        (control.StateSpace([[1.0]], [[1.0]], [[1.0], [1.0]], 0.0, 1 / FS), {}, ValueError, "pole of magnitude 1"),
        (control.StateSpace([[0.5]], [[1.0]], [[1.0]], 0.0, 1 / FS), {}, ValueError, "outputs for the 1 physical .* got 1"),
        (random_model(False)[:2, :2], {"source_power": [1.0]}, ValueError, "source_power must be one .* each of the 2 sources"),
    ],
)  # fmt: skip
def test_models_that_do_not_fit_are_refused(model: Any, changed: dict, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        KalmanObserver(model, 1, **({"sensor_noise_std": 0.1} | changed))


def test_a_block_whose_place_for_the_control_signal_does_not_fit_changes_nothing() -> None:
    x, e = noise(40), np.random.default_rng(1).standard_normal((4, 40))
    refused, usual = made(), made()
    with pytest.raises(ValueError, match="out must be"):
        refused.process(x, e, out=np.zeros((J, 39)))
    np.testing.assert_array_equal(refused.process(x, e), usual.process(x, e))


def test_a_run_at_another_rate_is_refused() -> None:
    paths = random_paths(2, 1, 6, seed=1)
    inner_one = kf_pb(TAPS, paths[1:], rated_power=1.0, fs=FS)
    controller = VirtualMicrophones(inner_one, paths, [[[1.0]]], physical=[0])
    with pytest.raises(ValueError, match="the controller is for 4000 Hz, but the run is at 8000 Hz"):
        simulate(controller, noise(), Plant(paths, fs=2 * FS), disturbance=np.zeros((2, 1500)))
    observer = KalmanObserver(random_model(False)[:2, :2], 1, sensor_noise_std=0.1)
    controller = VirtualMicrophones(silent(), paths, observer, physical=[0])
    with pytest.raises(ValueError, match="observer is for 4000 Hz"):
        simulate(controller, noise(), Plant(paths, fs=2 * FS), disturbance=np.zeros((2, 1500)))
