"""What the forms of KF-PB for several channels share: powers against the bound, one definition of the step, refusals."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import numpy as np
import pytest
from helpers.channels import constrained_filters, dense_systems, random_paths, through

from kfopc_filterpy import HardClipAmplifier, OutputLimiter, kf_pb, noise_reduction_db, output_power, simulate

FS = 4000.0
K, J, TAPS, PRIMARY = 3, 2, 24, 30
SECONDARY = random_paths(K, J, 12, seed=1)
PRIMARY_PATHS = random_paths(K, 2, PRIMARY, seed=2, delay=6)
FORMS = ("shared gain", "frequency domain")
EXACT: dict[str, Any] = {"secondary_path_uncertainty": None}

pytestmark = pytest.mark.parametrize("form", FORMS)


def references(n_samples: int, count: int = 2, seed: int = 0) -> np.ndarray:
    x = np.random.default_rng(seed).standard_normal((count, n_samples))
    return np.array([np.convolve(row, [1.0, 0.6], "same") for row in x])


def made(form: str, secondary: np.ndarray = SECONDARY, **changed: Any) -> Any:
    settings: dict[str, Any] = (
        {"rated_power": None, "n_references": 2, "n_primary": PRIMARY, "fs": FS} | EXACT | changed
    )
    return kf_pb(TAPS, secondary, form=form, **settings)


# ---- The powers


def test_samples_that_it_does_not_adapt_to_are_accounted_for_with_their_duration(
    form: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second without adaptation counts as a second, and not as one loud block."""
    controller = made(form, rated_power=[0.1, 0.2])
    spent, blocks = np.zeros(J), []

    def spend(level: float, power: np.ndarray | None, n_blocks: int = 1) -> None:
        if power is not None:
            spent[:] += power * n_blocks * controller.block
            blocks.append(n_blocks)

    monkeypatch.setattr(controller._budget, "spend", spend)
    silence = references(1000)
    controller.listen(silence, through(PRIMARY_PATHS, silence), adapt=False)  # not counted: the control was off
    n_samples = 9 * 50 * controller.block
    x, adapt = references(n_samples), np.ones(n_samples, bool)
    adapt[n_samples // 3 : 2 * n_samples // 3] = False
    y = controller.process(x, through(PRIMARY_PATHS, x), adapt=adapt)
    np.testing.assert_allclose(spent, np.sum(y**2, axis=1), rtol=1e-9)
    assert np.sum(blocks) == n_samples // controller.block
    assert np.max(blocks) > 150


@pytest.mark.parametrize("share", [0.25, 0.5])
@pytest.mark.parametrize("noise", ["white", "coloured"])
def test_each_loudspeaker_keeps_its_power_and_the_error_is_close_to_the_bound(
    noise: str, share: float, form: str
) -> None:
    """Steady noise: powers within 0.97 to 1.02 of the ratings where they bind, noise reduction within 0.5 dB."""
    n_samples = 24000
    x = references(n_samples, count=1) if noise == "coloured" else references(n_samples, 1)[:, ::-1]
    primary = PRIMARY_PATHS[:, :1]
    d = through(primary, x)
    half = n_samples // 2
    R, of_x, r = dense_systems(x, d, SECONDARY, TAPS, half)
    free = np.linalg.solve(R, r).reshape(J, -1)
    rated = share * np.einsum("ja,ab,jb->j", free, of_x, free)
    w, _, power = constrained_filters(R, of_x, r, rated)
    energy = np.mean(d[:, half:] ** 2, axis=1).sum()
    bound = -10 * np.log10((energy - 2 * r @ w.ravel() + w.ravel() @ R @ w.ravel()) / energy)
    controller = kf_pb(TAPS, SECONDARY, rated_power=rated, fs=FS, n_primary=PRIMARY, form=form, **EXACT)
    result = simulate(controller, x, primary_path=primary, secondary_path=SECONDARY, fs=FS)
    spent = output_power(result.control_signal) / rated
    binding = power > 0.999 * rated
    assert binding.any()
    assert np.all((spent[binding] > 0.97) & (spent[binding] < 1.02)), spent
    assert np.all(spent < 1.02)
    assert bound - noise_reduction_db(result.error, result.disturbance) < 0.5


@pytest.mark.parametrize("switch_on_s", [0.0, 0.5])
def test_the_powers_are_kept_from_the_first_block_on(switch_on_s: float, form: str) -> None:
    """In no block of the first second more than 1.5 times the rated power, which noise in 32 ms can reach by chance."""
    primary, x = PRIMARY_PATHS[:, :1], references(8000, 1)
    rated = np.array([0.02, 0.01])
    controller = kf_pb(TAPS, SECONDARY, rated_power=rated, fs=FS, n_primary=PRIMARY, form=form, **EXACT)
    options: dict[str, Any] = {"secondary_path": SECONDARY, "fs": FS, "switch_on_s": switch_on_s}
    y = simulate(controller, x, primary_path=primary, **options).control_signal[:, : int(FS)]
    blocks = y[:, : y.shape[1] // 128 * 128].reshape(2, -1, 128)
    powers = np.mean(blocks**2, axis=-1) / rated[:, np.newaxis]
    assert powers.max() < 1.5, powers.max(axis=0)
    assert powers[:, -10:].mean() > 0.9  # and they are used


@pytest.mark.parametrize("course", ["jump", "swell"])
def test_the_mean_over_the_averaging_time_is_kept_if_the_level_changes(course: str, form: str) -> None:
    """Swelling by 18 dB within half an averaging time: in every averaging time. A jump of 20 dB: in every one after it.

    The block in which the noise jumps is played with a hundred times the power, before anything can be known of it.
    """
    averaging_s, n_samples = 8.0, 100000
    t = np.arange(n_samples) / FS
    level = np.where(t < 5.0, 0.1, 1.0) if course == "jump" else 10 ** (9 * np.sin(np.pi * t / 2) / 20)
    x, rated = level * references(n_samples, 1), np.array([0.02, 0.01])
    controller = kf_pb(
        TAPS, SECONDARY, rated_power=rated, fs=FS, n_primary=PRIMARY, form=form, averaging_s=averaging_s, **EXACT
    )
    y = simulate(controller, x, primary_path=PRIMARY_PATHS[:, :1], secondary_path=SECONDARY, fs=FS).control_signal
    total = np.cumsum(np.pad(y**2, ((0, 0), (1, 0))), axis=1)
    size = round(averaging_s * FS)
    means = (total[:, size:] - total[:, :-size]) / size / rated[:, np.newaxis]
    assert means[:, round(5.0 * FS) if course == "jump" else 0 :].max() < 1.06
    assert means[:, -size:].min() > 0.85


def test_in_a_silent_pause_power_is_saved(form: str) -> None:
    """As in a pause that is almost silent."""
    t = np.arange(40000) / FS
    powers = []
    for quiet in (1e-4, 0.0):
        x = np.where(t % 1.0 < 0.7, 1.0, quiet) * references(t.size, 1)
        controller = kf_pb(
            TAPS, SECONDARY, rated_power=[0.02, 0.01], fs=FS, n_primary=PRIMARY, form=form, averaging_s=3.0, **EXACT
        )
        y = simulate(controller, x, primary_path=PRIMARY_PATHS[:, :1], secondary_path=SECONDARY, fs=FS).control_signal
        powers.append(np.mean(y[:, 20000:] ** 2, axis=1))
    np.testing.assert_allclose(powers[1], powers[0], rtol=0.02)
    assert np.all(powers[1] > 0.85 * np.array([0.02, 0.01]))


# ---- One definition of the step


def test_python_steps_and_the_compiled_loop_agree_to_the_bit(form: str) -> None:
    """With feedback, amplifiers, limiters, sensor noise and a controller that first listens."""
    feedback = 0.02 * random_paths(2, J, 5, seed=4)
    results = []
    for compiled in (True, False):
        limiters = [OutputLimiter(power, fs=FS, window_s=0.02) for power in (0.4, 0.2)]
        results.append(
            simulate(
                made(form, rated_power=[0.3, 0.1], limiter=limiters),
                references(1500),
                primary_path=PRIMARY_PATHS,
                secondary_path=SECONDARY,
                fs=FS,
                amplifier=[HardClipAmplifier(1.0), None],
                feedback_path=feedback,
                sensor_noise_std=0.01,
                rng=1,
                switch_on_s=0.05,
                record_weights_every=100,
                compiled=compiled,
            )
        )
    for name in ("error", "control_signal", "amplifier_output", "anti_noise", "weights"):
        np.testing.assert_array_equal(getattr(results[0], name), getattr(results[1], name), err_msg=name)


def test_a_limiter_holds_each_loudspeaker(form: str) -> None:
    limiters = [OutputLimiter(p, fs=FS, window_s=0.05) for p in (0.02, 0.01)]
    result = simulate(
        made(form, limiter=limiters), references(4000), primary_path=PRIMARY_PATHS, secondary_path=SECONDARY, fs=FS
    )
    for y, limiter in zip(result.control_signal, limiters, strict=True):
        energy = np.convolve(y**2, np.ones(200), "valid") / 200
        assert 0.5 * limiter.rated_power < energy.max() <= limiter.rated_power


def test_a_run_goes_on_where_it_stopped_and_a_copy_stands_alone(form: str) -> None:
    x, d = references(3000), through(PRIMARY_PATHS, references(3000))
    options: dict[str, Any] = {"secondary_path": np.zeros_like(SECONDARY), "fs": FS}  # no plant to restart
    whole, parts = made(form, rated_power=0.2), made(form, rated_power=0.2)
    simulate(whole, x, disturbance=d, **options)
    simulate(parts, x[:, :1111], disturbance=d[:, :1111], **options)
    copy = deepcopy(parts)
    simulate(parts, x[:, 1111:], disturbance=d[:, 1111:], **options)
    np.testing.assert_array_equal(parts.primary_path, whole.primary_path)
    np.testing.assert_array_equal(parts.weights, whole.weights)
    assert not np.array_equal(copy.weights, parts.weights)
    simulate(copy, x[:, 1111:], disturbance=d[:, 1111:], **options)
    np.testing.assert_array_equal(copy.weights, whole.weights)


# ---- What goes wrong


def test_an_unplugged_loudspeaker_stays_silent(form: str) -> None:
    secondary = SECONDARY.copy()
    secondary[:, 1] = 0.0
    controller = made(form, secondary, rated_power=0.5)
    result = simulate(controller, references(3000), primary_path=PRIMARY_PATHS, secondary_path=secondary, fs=FS)
    np.testing.assert_allclose(result.control_signal[1], 0.0, atol=1e-9)
    assert noise_reduction_db(result.error, result.disturbance) > 0.5


def test_identical_loudspeakers_share_the_work(form: str) -> None:
    secondary = np.repeat(SECONDARY[:, :1], 2, axis=1)
    controller = made(form, secondary, rated_power=0.5)
    result = simulate(controller, references(4000), primary_path=PRIMARY_PATHS, secondary_path=secondary, fs=FS)
    np.testing.assert_allclose(result.control_signal[0], result.control_signal[1], rtol=1e-6, atol=1e-9)


def test_a_microphone_that_is_dead_for_a_moment_is_refused_by_name_and_nothing_is_lost(form: str) -> None:
    """In the middle of a block, when the paths have been found: what is found stays as it was."""
    x = references(4000)
    d = through(PRIMARY_PATHS, x)
    controller = made(form)
    simulate(controller, x[:, :3001], disturbance=d[:, :3001], secondary_path=np.zeros_like(SECONDARY), fs=FS)
    before = controller.primary_path
    first = before[..., :PRIMARY]
    assert np.linalg.norm(first - PRIMARY_PATHS) > 0.0  # the plant had no loudspeakers: it found d + s^ * y
    for n in range(3001, 4000):
        y = controller.control_signal(x[:, n])
        if n in (3005, 3006, 3300):
            with pytest.raises(ValueError, match="that of microphone 1 is nan"):
                controller.update([0.1, np.nan, 0.2])
        else:
            controller.update(d[:, n])
        assert np.all(np.isfinite(y))
    uninterrupted = made(form)
    simulate(uninterrupted, x, disturbance=d, secondary_path=np.zeros_like(SECONDARY), fs=FS)
    lost = np.linalg.norm(controller.primary_path - uninterrupted.primary_path)
    assert lost < 0.1 * np.linalg.norm(uninterrupted.primary_path)


def test_a_reference_that_overflows_is_refused_until_it_has_passed_and_leaves_no_trace(form: str) -> None:
    """Before anything is known, and later. The longest filter that it passes has 36 taps."""
    x = references(6000)
    d, refused = through(PRIMARY_PATHS, x), []
    controller = made(form, rated_power=0.3)
    for n in range(600):
        controller.control_signal([1e200, 0.0] if n in (5, 400) else x[:, n])
        try:
            controller.update(d[:, n])
        except ValueError:
            refused.append(n)
    assert {5, 400} <= set(refused) <= {*range(5, 100), *range(400, 500)}
    result = simulate(controller, x, disturbance=d, secondary_path=SECONDARY, fs=FS)
    clean = simulate(made(form, rated_power=0.3), x, disturbance=d, secondary_path=SECONDARY, fs=FS)
    assert noise_reduction_db(result.error, result.disturbance) == pytest.approx(
        noise_reduction_db(clean.error, clean.disturbance), abs=0.05
    )


def test_a_dead_microphone_can_be_left_out(form: str) -> None:
    x, d = references(4000), through(PRIMARY_PATHS, references(4000))
    strange = d.copy()
    strange[1] = 100.0 * np.random.default_rng(9).standard_normal(4000)
    left_out = made(form, microphone_weights=[1.0, 0.0, 1.0])
    quiet = made(form, microphone_weights=[1.0, 0.0, 1.0])
    for one, disturbance in ((left_out, strange), (quiet, d)):
        simulate(one, x, disturbance=disturbance, secondary_path=SECONDARY, fs=FS)
    np.testing.assert_allclose(left_out.weights, quiet.weights, rtol=1e-12)


def test_silence_is_waited_for(form: str) -> None:
    controller = made(form, rated_power=0.2)
    quiet = np.zeros((2, 1000))
    result = simulate(controller, quiet, disturbance=np.zeros((K, 1000)), secondary_path=SECONDARY, fs=FS)
    np.testing.assert_array_equal(result.control_signal, 0.0)
    result = simulate(controller, references(4000), primary_path=PRIMARY_PATHS, secondary_path=SECONDARY, fs=FS)
    assert noise_reduction_db(result.error, result.disturbance) > 1.0


N_QUIET = 4000  # the first second
BEGINNINGS = {"silent": 0.0, "silent but for a sample of a block": 0.0, "soft": 1e-3, "very soft": 1e-6}


@pytest.mark.parametrize("beginning", BEGINNINGS)
def test_a_noise_that_begins_silent_or_soft_is_then_reduced_as_well_as_one_that_was_always_loud(
    beginning: str, form: str
) -> None:
    """The first second, with noise at the microphones: it must not decide for how long the paths are averaged."""
    n_samples, until = 3 * N_QUIET, N_QUIET
    if "block" in beginning:
        until = N_QUIET // made(form).block * made(form).block - 1
    level = np.where(np.arange(n_samples) < until, BEGINNINGS[beginning], 1.0)
    reductions = []
    for gain in (level, np.ones(n_samples)):
        result = simulate(
            made(form),  # without a rated power: what is spent when the noise sets in would have to be repaid
            gain * references(n_samples),
            primary_path=PRIMARY_PATHS,
            secondary_path=SECONDARY,
            fs=FS,
            sensor_noise_std=1.0,
            rng=1,
        )
        assert np.isfinite(result.error).all()
        reductions.append(noise_reduction_db(result.error, result.disturbance, steady=1 / 3))
        quiet = result.control_signal[:, :until]
        assert np.all(np.abs(quiet[:, gain[:until] == 0.0]) == 0.0)
    assert reductions[0] == pytest.approx(reductions[1], abs=0.15)


@pytest.mark.parametrize("coupling", [0.99, 0.99999], ids=["strong", "nearly singular"])
def test_strong_mutual_coupling_leaves_finite_filters_within_the_powers(coupling: float, form: str) -> None:
    """Two loudspeakers that all microphones hear nearly alike: they do what one does that stands for both."""
    secondary = np.stack([SECONDARY[:, 0], coupling * SECONDARY[:, 0] + (1 - coupling) * SECONDARY[:, 1]], axis=1)
    x, reductions = references(12000), []
    for paths, rated in ((secondary, 0.05), (SECONDARY[:, :1], 0.2)):  # half the amplitude each, a quarter of the power
        controller = made(form, paths, rated_power=rated)
        result = simulate(controller, x, primary_path=PRIMARY_PATHS, secondary_path=paths, fs=FS)
        assert np.isfinite(controller.weights).all()
        spent = output_power(result.control_signal) / rated
        np.testing.assert_allclose(spent, 1.0, atol=0.03)
        reductions.append(noise_reduction_db(result.error, result.disturbance))
    assert reductions[0] == pytest.approx(reductions[1], abs=0.2)
    free = made(form, secondary)
    result = simulate(free, x, primary_path=PRIMARY_PATHS, secondary_path=secondary, fs=FS)
    assert np.isfinite(free.weights).all()
    assert noise_reduction_db(result.error, result.disturbance) > reductions[0]


def test_a_microphone_that_no_loudspeaker_reaches_does_not_change_the_control(form: str) -> None:
    secondary = np.concatenate([SECONDARY, np.zeros((1, J, SECONDARY.shape[2]))])
    x = references(4000)
    d = through(PRIMARY_PATHS, x)
    with_it = np.concatenate([d, 5.0 * np.random.default_rng(3).standard_normal((1, 4000))])
    results = []
    for paths, disturbance in ((secondary, with_it), (SECONDARY, d)):
        controller = made(form, paths, rated_power=0.3)
        results.append(simulate(controller, x, disturbance=disturbance, secondary_path=paths, fs=FS))
    scale = np.abs(results[1].control_signal).max()
    np.testing.assert_allclose(results[0].control_signal, results[1].control_signal, rtol=0, atol=1e-9 * scale)
    np.testing.assert_array_equal(results[0].error[3], with_it[3])


@pytest.mark.parametrize(
    ("changed", "error", "match"),
    [
        ({"rated_power": [1.0, 2.0, 3.0]}, ValueError, "one for each of the 2 loudspeakers"),
        ({"rated_power": [1.0, -2.0]}, ValueError, "greater than 0"),
        ({"microphone_weights": [0.0, 0.0, 0.0]}, ValueError, "one above 0"),
        ({"microphone_weights": [1.0, 1.0]}, ValueError, "each of the 3 microphones"),
        ({"microphone_weights": [1.0, -1.0, 1.0]}, ValueError, "negative"),
        ({"path_memory_s": 0.0}, ValueError, "path_memory_s"),
        ({"n_references": 0}, ValueError, "n_references"),
        ({"n_references": -1}, ValueError, "n_references must be at least 1"),
        ({"limiter": [OutputLimiter(1.0)]}, TypeError, "one for each loudspeaker"),
        ({"amplifier": [HardClipAmplifier(1.0)]}, TypeError, "each of the 2 loudspeakers"),
    ],
    ids=lambda value: (
        str(value) if isinstance(value, dict) and "limiter" not in value and "amplifier" not in value else ""
    ),
)
def test_settings_that_do_not_fit_are_refused(form: str, changed: dict, error: type[Exception], match: str) -> None:
    with pytest.raises(error, match=match):
        made(form, **changed)
