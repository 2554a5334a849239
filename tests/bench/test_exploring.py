"""One run per move of a slider: its numbers against the studies' own, and the files it reads."""

from __future__ import annotations

import re

import numpy as np
import pytest
import soundfile
from threadpoolctl import threadpool_limits

from kfopc_filterpy import kf_pb, output_power, simulate
from kfopc_filterpy.bench import AcousticSetup, ExploreSettings, explore, explore_setups
from kfopc_filterpy.bench.exploring import ALGORITHMS, N_TAPS
from kfopc_filterpy.metrics import power_spectrum_db
from kfopc_filterpy.paths import PathTolerance, read_path
from kfopc_filterpy.signals import band_limited_noise, read_recording

BAND_PASS = explore_setups()[0]


@pytest.fixture(autouse=True)
def one_blas_thread():
    """Solve with one thread, as the page does."""
    with threadpool_limits(1):
        yield


def test_a_linear_amplifier_at_a_quarter_of_the_power_gives_6_db_on_a_flat_path():
    # In the band, path and noise are flat: within a quarter of the power, half of the amplitude is cancelled.
    result = explore(BAND_PASS, ExploreSettings(rating_db=-6.0206, clips=False))
    assert result.rated_power == pytest.approx(0.25 * result.full_power, rel=1e-5)
    assert result.bound_db == pytest.approx(6.02, abs=0.05)
    assert result.noise_reduction_db == pytest.approx(6.02, abs=0.2)
    assert output_power(result.run.control_signal) == pytest.approx(result.rated_power, rel=0.02)
    np.testing.assert_array_equal(result.run.control_signal, result.run.amplifier_output)


def test_the_run_is_the_one_that_simulate_gives():
    settings = ExploreSettings(rating_db=-9.0, rating_is_relative=False, level_db=3.0, clips=False, state_noise=1e-6)
    result = explore(BAND_PASS, settings)
    x = band_limited_noise((200.0, 2000.0), 3.5, fs=16000, rng=0)
    d = np.convolve(x, BAND_PASS.primary)[: x.size]
    gain = np.sqrt(10**0.3 / np.mean(d[8000:] ** 2))
    x, d = gain * x, gain * d
    np.testing.assert_allclose(result.run.disturbance, d[8000:], rtol=1e-9, atol=1e-12)
    controller = kf_pb(
        N_TAPS,
        BAND_PASS.secondary,
        rated_power=10**-0.9,
        secondary_path_uncertainty=PathTolerance(delay_samples=1.0),
        fs=16000.0,
    )
    own = simulate(controller, x, disturbance=d, secondary_path=BAND_PASS.secondary, fs=16000.0, switch_on_s=0.5)
    left = np.mean((own.error[24000:] - result.run.error[24000:]) ** 2) / np.mean(own.error[24000:] ** 2)
    assert 10 * np.log10(left) < -30.0  # of the sensor noise, and of q's difference


def test_the_amplifier_clips_at_the_peak_of_a_sine_of_rated_power():
    result = explore(BAND_PASS)
    assert result.amplitude_limit == pytest.approx(np.sqrt(2 * result.rated_power))
    np.testing.assert_array_equal(
        result.run.amplifier_output, np.clip(result.run.control_signal, -result.amplitude_limit, result.amplitude_limit)
    )
    # A Gaussian signal of rated power is beyond sqrt(2) standard deviations for 15.7 % of the time.
    assert result.clipped_fraction == pytest.approx(0.157, abs=0.01)


def test_kf_pb_and_kf_opc_keep_the_rating_and_the_plain_algorithms_do_not():
    share = {}
    for name in ALGORITHMS:
        result = explore(BAND_PASS, ExploreSettings(algorithm=name, rating_db=-6.0))
        share[name] = result.output_power / result.rated_power
        is_beyond = "far beyond the rated power" in result.summary
        assert is_beyond == (share[name] > 2.0)
    assert max(share[name] for name in ("KF-PB", "KF-OPC", "MOV-FxLMS")) < 1.05
    assert min(share[name] for name in ("KF-ANC", "FxLMS")) > 3.9


def test_a_relative_rating_scales_with_the_noise_and_a_fixed_one_does_not():
    quiet, loud = (explore(BAND_PASS, ExploreSettings(level_db=level)) for level in (0.0, 12.0))
    assert loud.rated_power == pytest.approx(10**1.2 * quiet.rated_power)
    assert loud.noise_reduction_db == pytest.approx(quiet.noise_reduction_db, abs=1e-6)
    fixed = ExploreSettings(level_db=12.0, rating_is_relative=False, rating_db=float(10 * np.log10(quiet.rated_power)))
    result = explore(BAND_PASS, fixed)
    assert result.rated_power == pytest.approx(quiet.rated_power)
    assert result.noise_reduction_db < quiet.noise_reduction_db - 2.0


def test_kf_pb_learns_a_path_that_is_four_samples_late_whatever_the_tolerance():
    def run(error: float, tolerance: float) -> tuple[float, float]:
        result = explore(BAND_PASS, ExploreSettings(path_error_samples=error, path_tolerance_samples=tolerance))
        frequencies, before = power_spectrum_db(result.run.disturbance, 16000)
        near = (frequencies > 1700) & (frequencies < 1950)
        louder = np.mean((power_spectrum_db(result.run.error, 16000)[1] - before)[near])
        return result.noise_reduction_db, float(louder)

    exact, _ = run(0.0, 0.5)
    for tolerance in (0.5, 4.0):
        reduction, louder = run(4.0, tolerance)
        assert reduction > exact - 0.5
        assert louder < 0.5


def test_a_diverged_run_says_when():
    result = explore(BAND_PASS, ExploreSettings("KF-ANC", path_error_samples=4.0, clips=False))
    assert result.run.diverged_at_s is not None
    assert re.fullmatch(r"KF-ANC diverged \d\.\d{3} s after it was switched on\.", result.summary)


def test_the_measured_duct_is_there_with_its_two_recordings(shared_data, data_folder):
    data_folder(shared_data)
    setups = {setup.name: setup for setup in explore_setups()}
    assert list(setups)[1:] == ["Measured duct", "Measured duct, motor", "Measured duct, compressor"]
    motor = setups["Measured duct, motor"]
    result = explore(motor, ExploreSettings(level_db=motor.level_db, band=(50.0, 8000.0)))
    # The recording in its own units: only what lies below 50 Hz is missing.
    own = np.convolve(motor.noise, motor.primary)[: motor.noise.size][8000:]
    assert np.corrcoef(own, result.run.disturbance)[0, 1] > 0.95
    assert result.noise_reduction_db > 1.0


def test_without_data_only_the_models_are_offered(data_folder, tmp_path):
    data_folder(tmp_path)
    assert [setup.name for setup in explore_setups()] == ["Band-pass paths"]


# Files


@pytest.fixture
def files(tmp_path):
    """Write a noise and two paths at 48 kHz; return their names."""
    noise = band_limited_noise((100.0, 3000.0), 2.0, fs=48000, rng=1)
    signals = {"noise": 0.1 * noise, "P": np.eye(1, 400, 144)[0], "S": 0.5 * np.eye(1, 200, 48)[0]}
    for name, signal in signals.items():
        soundfile.write(tmp_path / f"{name}.wav", signal, 48000, subtype="FLOAT")
    return [tmp_path / f"{name}.wav" for name in signals]


def test_files_are_taken_in_their_own_units_and_at_one_rate(files):
    noise, primary, secondary = files
    paths = (read_path(primary, fs=16000), read_path(secondary, fs=16000))
    setup = AcousticSetup("own", *paths, 16000, read_recording(noise, fs=16000))
    assert setup.noise.size == 32000
    # The primary path only delays: the disturbance is the noise, 0.01 in mean square.
    assert setup.level_db == pytest.approx(-20.0, abs=0.2)
    assert np.argmax(setup.secondary) == 16
    result = explore(setup, ExploreSettings(level_db=setup.level_db, band=(50.0, 8000.0), rating_db=10.0))
    # The secondary path halves: full control takes four times the disturbance's power.
    assert result.full_power == pytest.approx(4 * 10 ** (setup.level_db / 10), rel=0.05)
    assert result.noise_reduction_db > 20.0
    with pytest.raises(ValueError, match=r"noise is sampled at 48000 Hz but fs is 16000 Hz; read it with fs=16000"):
        AcousticSetup("own", *paths, 16000, read_recording(noise))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: AcousticSetup("mine", [0, 1.0], [1.0], 8000, np.ones(7999)), "must last 1 s at least, got 1 s"),
        (lambda: AcousticSetup("mine", [0, 1.0], [1.0], 8000, np.zeros(8000)), "silent"),
        (lambda: ExploreSettings(algorithm="KF"), "algorithm must be"),
        (lambda: ExploreSettings(rating_db=np.inf), "rating_db"),
        (lambda: ExploreSettings(path_error_samples=-1.0), "path_error_samples"),
        (lambda: ExploreSettings(state_noise=0.0), "state_noise"),
        (lambda: explore(BAND_PASS, ExploreSettings(band=(200.0, 9000.0))), "band"),
        (
            lambda: explore(AcousticSetup("mean", [0, 0, 1.0], [0, 1.0], 8000, np.ones(8000))),
            "silent from 200 to 2000 Hz: choose a wider band",
        ),
    ],
)
def test_what_cannot_be_computed_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
