"""The loudspeaker with a limited excursion against closed forms of a clipped sine and the analogue low-pass."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.signal import lsim

from kfopc_filterpy import FxLMS, SoftSaturationAmplifier, kf_anc, simulate
from kfopc_filterpy.controllers import VerifiedController
from kfopc_filterpy.paths import identify_secondary_path
from kfopc_filterpy.power import ExcursionLimitedLoudspeaker
from kfopc_filterpy.realtime import SimulatedInterface

FS, RESONANCE_HZ, Q, X_MAX_MM, MM_PER_VOLT = 16000.0, 80.0, 0.6, 2.0, 0.25
ANALOGUE = ([MM_PER_VOLT], [(2 * np.pi * RESONANCE_HZ) ** -2.0, 1 / (Q * 2 * np.pi * RESONANCE_HZ), 1.0])
T = np.arange(16000) / FS
NOISE = np.random.default_rng(0).standard_normal(16000)


def woofer(**changed: Any) -> ExcursionLimitedLoudspeaker:
    sheet = {"resonance_hz": RESONANCE_HZ, "q_ts": Q, "x_max_mm": X_MAX_MM, "mm_per_volt": MM_PER_VOLT}
    return ExcursionLimitedLoudspeaker(**{"fs": FS} | sheet | changed)


def excursion_per_volt(hz: float) -> complex:
    """Return the response of the analogue low-pass."""
    s = 2j * np.pi * hz
    return complex(MM_PER_VOLT / np.polyval(ANALOGUE[1], s))


def test_within_the_limit_it_is_a_wire() -> None:
    made = woofer()
    assert 0.5 * X_MAX_MM < np.abs(made.excursion_mm(20 * NOISE)).max() < X_MAX_MM
    np.testing.assert_array_equal(made(20 * NOISE), 20 * NOISE)


@pytest.mark.parametrize("hz", [20.0, 80.0, 300.0])
def test_the_excursion_of_a_soft_tone_is_that_of_the_analogue_low_pass(hz: float) -> None:
    y = np.sin(2 * np.pi * hz * T)
    found = woofer(volts_per_unit=2.0).excursion_mm(y)[8000:]  # whole periods
    amplitude = abs(2 / found.size * np.sum(found * np.exp(-2j * np.pi * hz * T[8000:])))
    assert amplitude == pytest.approx(2.0 * abs(excursion_per_volt(hz)), rel=0.002)  # 0.02 dB below fs/50


@pytest.mark.parametrize("over", [1.2, 3.0])
def test_harmonics_are_those_of_a_clipped_sine_through_the_inverse(over: float) -> None:
    """The excursion is a clipped sine, whose Fourier series is known; each harmonic is divided by the low-pass."""
    hz, order = 20.0, np.array([1, 3, 5])
    volts = over * X_MAX_MM / abs(excursion_per_volt(hz))
    played = woofer()(volts * np.sin(2 * np.pi * hz * T))[8000:]
    found = [abs(2 / played.size * np.sum(played * np.exp(-2j * np.pi * n * hz * T[8000:]))) for n in order]
    angle = 2 * np.pi * (np.arange(100_000) + 0.5) / 100_000
    clipped = np.clip(over * np.sin(angle), -1, 1)
    series = [abs(2 * np.mean(clipped * np.sin(n * angle))) * X_MAX_MM for n in order]
    # Of 800 samples a period, the corners of the clipping fall between two: a share of 1/800 of the fundamental.
    expected = np.divide(series, [abs(excursion_per_volt(n * hz)) for n in order])
    np.testing.assert_allclose(found, expected, rtol=0.01)
    fundamental = 2 / np.pi * (np.arcsin(1 / over) + np.sqrt(1 - over**-2.0) / over)  # the describing function
    assert found[0] == pytest.approx(volts * fundamental, rel=1e-3)


def test_what_is_played_moves_a_cone_without_limit_as_far_as_the_limit() -> None:
    y = 25.0 * np.sin(2 * np.pi * 30.0 * T)
    made = woofer()
    moved = lsim(ANALOGUE, made(y), T)[1]
    free = lsim(ANALOGUE, y, T)[1]
    assert np.abs(free).max() > 2 * X_MAX_MM
    # The model's excursion is a sample early. What is left is less than a sample, 1/533 of a period of 2 * X_MAX_MM.
    np.testing.assert_allclose(moved[1:], made.excursion_mm(y)[:-1], rtol=0, atol=2 * np.pi / 533 * 2 * X_MAX_MM)
    assert np.abs(made.excursion_mm(y)).max() == X_MAX_MM


def test_a_soft_limit_is_that_of_the_amplifier_model() -> None:
    y = 400.0 * NOISE
    free = woofer(x_max_mm=1e6).excursion_mm(y)
    expected = SoftSaturationAmplifier(X_MAX_MM, 3.0)(free)
    np.testing.assert_array_equal(woofer(sharpness=3.0).excursion_mm(y), expected)
    assert np.abs(free).max() > 3 * X_MAX_MM


def test_each_run_and_each_loudspeaker_begins_at_rest() -> None:
    made, x = woofer(), 500.0 * NOISE[:2000]
    plant: dict[str, Any] = {"disturbance": x, "amplifier": made, "fs": FS}

    class Wire:
        def control_signal(self, reference: Any) -> Any:
            return reference

        def update(self, error: Any) -> None:
            pass

    one, again = (simulate(Wire(), x, secondary_path=[0.0, 1.0], **plant).amplifier_output for _ in range(2))
    np.testing.assert_array_equal(one, again)
    np.testing.assert_array_equal(one, made.at_rest()(x))  # sample by sample, and at once
    assert np.abs(one - x).max() > 100.0
    two = simulate(
        Wire(), [x, 0 * x], disturbance=[x], secondary_path=np.ones((1, 2, 2)), amplifier=[made, made], fs=FS
    )
    np.testing.assert_array_equal(two.amplifier_output, [one, 0 * x])
    interface = SimulatedInterface(x, [1.0], disturbance=0 * x, fs=FS, amplifier=made, latency=64)
    heard = []
    while (block := interface.read()) is not None:
        heard.append(-block.errors[0])
        interface.write(x[np.newaxis, 64 * len(heard) - 64 : 64 * len(heard)])
    np.testing.assert_allclose(np.concatenate(heard)[64:], one[: 64 * len(heard) - 64], rtol=1e-12)


def test_a_path_is_identified_within_the_limit_only() -> None:
    def misalignment_db(level: float) -> float:
        found = identify_secondary_path(
            [0.0, 1.0, 0.5], n_taps=3, duration_s=1.0, rng=1, fs=FS, amplifier=woofer(), level=level
        )
        return float(found.misalignment_db)

    assert misalignment_db(1.0) < -90.0  # the regularisation of the fit
    assert misalignment_db(400.0) > -30.0


@pytest.mark.parametrize(
    ("changed", "error", "match"),
    [
        *(
            ({name: 0.0}, ValueError, f"{name} must be greater than 0")
            for name in ("fs", "resonance_hz", "q_ts", "x_max_mm", "mm_per_volt", "volts_per_unit", "sharpness")
        ),
        ({"q_ts": "0.5"}, TypeError, "q_ts must be a single number"),
        ({"resonance_hz": 8000.0}, ValueError, "resonance_hz must be below fs/2 = 8000 Hz, got 8000 Hz"),
    ],
)
def test_refuses_what_no_data_sheet_has(changed: dict[str, Any], error: type[Exception], match: str) -> None:
    with pytest.raises(error, match=match):
        woofer(**changed)


def test_controllers_know_amplifiers_without_memory_only() -> None:
    known: dict[str, Any] = {"amplifier": woofer()}
    for make in (
        lambda: kf_anc(4, [0.0, 1.0], state_noise=0.0, measurement_noise=1.0, **known),
        lambda: VerifiedController(FxLMS(4, [0.0, 1.0], step_size=0.1), fs=FS, **known),
    ):
        with pytest.raises(TypeError, match=r"amplifier must be (None, one of|without memory)"):
            make()
