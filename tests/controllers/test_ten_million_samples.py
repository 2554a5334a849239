"""Controllers over ten million samples of each of five noises, without state noise: arithmetic alone keeps P in order.

`KFOPC_TABLES=docs pytest -m slow tests/controllers/test_ten_million_samples.py` writes the table of docs/limits.md.
"""

from __future__ import annotations

from functools import partial
from itertools import cycle

import numpy as np
import pytest
from helpers.tables import stored_table, write_table
from scipy.signal import butter, lfilter, sosfilt, unit_impulse

from kfopc_filterpy import (
    OutputLimiter,
    Plant,
    clipping_fx_lms,
    diagonal_kf,
    fx_lms,
    fx_nlms,
    fx_rls,
    kf_anc,
    kf_opc,
    kf_pb,
    leaky_fx_lms,
    mov_fx_lms,
    noise_reduction_db,
    optimal_leaky_fx_lms,
    rescaling_fx_lms,
    simulate,
    two_gradient_fx_lms,
)
from kfopc_filterpy.verdict.items import aligned

SAMPLES, CHECKS = 10_000_000, 20
FEWER = 10  # as many times fewer samples with several channels, which take longer
FS, TAPS, TURN_S = 16000.0, 32, 1.0
SENSOR_NOISE = 1e-2
Q = SENSOR_NOISE**2
RATED_POWER = 0.5  # a quarter of what full control of white noise needs
LEAST_EIGENVALUE = -1e-12  # of P, over its largest: what rounding of its elements may do
LOUDER_DB = 1.0
PRIMARY, S = np.array([0.0, 0.0, 1.0, 0.5]), np.array([0.0, 0.8, -0.3])
TWO = np.array([[S, 0.3 * S[::-1]], [0.2 * S[::-1], S]])


# Noises: functions of a generator that return a function of the first sample and how many; they go on from call to call.


def tone(rng):
    return lambda start, n: np.sqrt(2.0) * np.sin(2 * np.pi * (300.0 / FS * np.arange(start, start + n) % 1.0))


def white(rng):
    return lambda start, n: rng.standard_normal(n)


def silence(rng):
    return lambda start, n: np.zeros(n)


def narrow_band(rng):
    """Begin softly and without jumps, so that most directions of P are never excited: the hardest of the noises."""
    sos = butter(4, (250.0, 350.0), "bandpass", fs=FS, output="sos")
    gain = 1.0 / np.linalg.norm(sosfilt(sos, unit_impulse(int(FS))))  # of power 1
    memory = np.zeros((len(sos), 2))

    def take(start, n):
        nonlocal memory
        x, memory = sosfilt(sos, gain * rng.standard_normal(n), zi=memory)
        return x

    return take


def alternating(rng):
    turns, turn = cycle([source(rng) for source in (white, silence, narrow_band, tone)]), int(TURN_S * FS)
    return lambda start, n: np.concatenate([next(turns)(0, turn) for _ in range(0, n, turn)])[:n]


NOISES = {"tone": tone, "silence": silence, "white": white, "narrow band": narrow_band, "alternating": alternating}


def kalman(make, ratio, taps=TAPS, secondary=S, **settings):
    return partial(make, taps, secondary, state_noise=0.0, measurement_noise=Q, initial_variance=ratio * Q, **settings)


def lms(make, **settings):
    return partial(make, TAPS, S, step_size=1e-3, **settings)


def limited():
    return kalman(kf_opc, 1e12, **RATED, limiter=OutputLimiter(**RATED))()


RATED, LIMIT = {"rated_power": RATED_POWER, "fs": FS}, {"amplitude_limit": 1.0}
CASES = {
    "KF-ANC, P0/q = 1e4": kalman(kf_anc, 1e4),
    "KF-ANC, P0/q = 1e12": kalman(kf_anc, 1e12),
    "KF-OPC, P0/q = 1e4": kalman(kf_opc, 1e4, **RATED),
    "KF-OPC, P0/q = 1e12": kalman(kf_opc, 1e12, **RATED),
    "KF-OPC, P0/q = 1e12, limiter": limited,
    "KF-ANC, P0/q = 1e12, 2 x 2": kalman(kf_anc, 1e12, TAPS // 2, TWO),
    "diagonal KF, P0/q = 1e12": kalman(diagonal_kf, 1e12),
    "KF-PB": partial(kf_pb, TAPS, S, **RATED),
    "FxRLS": partial(fx_rls, TAPS, S),
    "FxLMS": lms(fx_lms),
    "FxNLMS": lms(fx_nlms),
    "leaky FxLMS": lms(leaky_fx_lms, leak=0.1),
    "optimal leaky FxLMS": lms(optimal_leaky_fx_lms, **RATED),
    "MOV-FxLMS": lms(mov_fx_lms, **RATED),
    "two-gradient FxLMS": lms(two_gradient_fx_lms, **LIMIT),
    "re-scaling FxLMS": lms(rescaling_fx_lms, **LIMIT),
    "clipping FxLMS": lms(clipping_fx_lms, **LIMIT),
}
LOUD = ("clipping FxLMS",)  # its weights grow, so it is loud when the noise changes
HEAD = ["10,000,000 samples", *(f"{noise}, dB" for noise in NOISES if noise != "silence"), "least/largest of P"]


def parts(controller, noise, samples):
    """Run a controller over a noise, one part after another, and yield each part's result.

    `simulate` begins with silent paths, so the anti-noise that is still under way is taken off the next disturbance.
    """
    rng, size = np.random.default_rng(1), samples // CHECKS
    source, memory = NOISES[noise](rng), np.zeros(PRIMARY.size - 1)
    secondary = controller.secondary
    rest, under_way = secondary.shape[-1] - 1, 0.0
    for start in range(0, samples, size):
        x = source(start, size)
        d, memory = lfilter(PRIMARY, 1.0, x, zi=memory)
        d = d + SENSOR_NOISE * rng.standard_normal((2, size) if controller.multichannel else size)
        d[..., :rest] -= under_way
        result = simulate(controller, x, Plant(secondary, fs=FS), disturbance=d)
        last = np.atleast_2d(result.control_signal)[:, -rest:]
        rings = (
            sum(np.convolve(s, y)[rest:] for s, y in zip(row, last, strict=True))
            for row in secondary.reshape(-1, len(last), rest + 1)
        )
        under_way = np.reshape([*rings], (*d.shape[:-1], rest))
        yield result


def least_eigenvalue(controller):
    """Return the least eigenvalue of P over the largest, after a check of its symmetry; None if there is no P."""
    P = np.diag(controller.variances) if hasattr(controller, "variances") else getattr(controller, "covariance", None)
    if P is None:
        return None
    np.testing.assert_array_equal(P, P.T)
    values = np.linalg.eigvalsh(P)  # refuses what is not finite
    return values[0] / values[-1]


def largest_window_power(y, window):
    """Return the largest mean square of a window of a control signal."""
    sums = np.cumsum(np.concatenate(([0.0], y**2)))
    return np.max(sums[window:] - sums[:-window]) / window


@pytest.fixture(scope="module")
def rows():
    """Rows of the table, which is written when all cases have one."""
    found = {}
    yield found
    if list(found) == list(CASES):
        write_table("soak.txt", "\n".join(aligned([HEAD, *found.values()], left={0})))


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_ten_million_samples(name, rows):
    row, least = [name], []
    for noise in NOISES:
        controller = CASES[name]()
        samples = SAMPLES // (FEWER if controller.multichannel else 1)
        for k, result in enumerate(parts(controller, noise, samples)):
            assert result.diverged_at_s is None
            assert np.isfinite(result.error).all()
            assert np.isfinite(controller.weights).all()
            if (value := least_eigenvalue(controller)) is not None:
                assert value >= LEAST_EIGENVALUE
                least.append(value)
            if controller.limiter is not None:
                window = round(controller.limiter.window_s * FS)
                assert largest_window_power(result.control_signal, window) <= RATED_POWER * (1 + 1e-9)
            reduction = 0.0 if noise == "silence" else noise_reduction_db(result.error, result.disturbance)
            assert k == 0 or name in LOUD or reduction > -LOUDER_DB  # a start from a large P(0|0) may be loud
        row += [] if noise == "silence" else [f"{reduction:.1f}"]
    rows[name] = [*row, f"{min(least):.1e}" if least else "-"]


def test_the_page_shows_the_cases_of_today():
    assert [line.split("  ")[0] for line in stored_table("soak.txt")] == [HEAD[0], *CASES]


@pytest.mark.parametrize("name", ["FxNLMS", "KF-ANC, P0/q = 1e12, 2 x 2"])
def test_the_parts_are_one_run(name, monkeypatch):
    monkeypatch.setattr(f"{__name__}.SENSOR_NOISE", 0.0)  # drawn for each part
    errors = []
    for checks in (1, 20):
        monkeypatch.setattr(f"{__name__}.CHECKS", checks)
        errors.append(np.concatenate([result.error for result in parts(CASES[name](), "tone", 4000)], axis=-1))
    np.testing.assert_allclose(errors[1], errors[0], rtol=0, atol=1e-12)  # of errors up to 140
