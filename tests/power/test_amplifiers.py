"""Amplifier models against their closed forms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kfopc_filterpy import HardClipAmplifier, LinearAmplifier, Plant, SoftSaturationAmplifier, fx_lms, simulate
from kfopc_filterpy.power.amplifiers import compiled_model

signals = st.floats(-1e9, 1e9)
limits = st.floats(1e-3, 1e3)


def make(limit, sharpness):
    return [LinearAmplifier(), HardClipAmplifier(limit), SoftSaturationAmplifier(limit, sharpness)]


@given(signals, limits)
def test_hard_clip_is_the_nearest_value_within_the_limit(y, limit):
    assert HardClipAmplifier(limit)(y) == float(np.clip(y, -limit, limit))


@given(st.floats(-50.0, 50.0), limits, st.floats(0.1, 20.0))
def test_soft_saturation_is_rapps_formula(ratio, limit, sharpness):
    y = ratio * limit
    expected = y / (1 + abs(y / limit) ** (2 * sharpness)) ** (1 / (2 * sharpness))
    # 2p times the rounding of the ratio's logarithm: 40 * 4 * 2.2e-16
    assert SoftSaturationAmplifier(limit, sharpness)(y) == pytest.approx(expected, rel=1e-13, abs=1e-300)


@pytest.mark.parametrize("sharpness", [0.5, 2.0, 50.0, 400.0])
def test_soft_saturation_far_above_its_limit_is_the_limit(sharpness):
    # the power in Rapp's formula overflows from a ratio of 1e6 on at sharpness 26: the output must not become 0
    for y in (1e6, 1e100, 1e300):
        assert SoftSaturationAmplifier(0.5, sharpness)(y) == pytest.approx(0.5, rel=1e-5)
        assert SoftSaturationAmplifier(0.5, sharpness)(-y) == pytest.approx(-0.5, rel=1e-5)


@pytest.mark.parametrize("sharpness", [1e-7, 1e-3, 1e6, 1e9])
def test_soft_saturation_at_its_limit(sharpness):
    assert SoftSaturationAmplifier(0.5, sharpness)(0.5) == pytest.approx(0.5 * 2 ** (-0.5 / sharpness), rel=1e-12)


@pytest.mark.parametrize("amplifier", make(0.7, 2.5))
def test_numbers_and_arrays_of_any_shape(amplifier):
    values = np.linspace(-3, 3, 12)
    expected = np.array([amplifier(v) for v in values])
    np.testing.assert_array_equal(amplifier(values), expected)
    np.testing.assert_array_equal(amplifier(values.reshape(3, 4).T), expected.reshape(3, 4).T)
    np.testing.assert_array_equal(amplifier(values[::2]), expected[::2])
    np.testing.assert_array_equal(amplifier(list(values)), expected)
    assert amplifier(np.empty((0, 3))).shape == (0, 3)
    assert type(amplifier(1)) is float
    assert type(amplifier(np.float32(1))) is float


@pytest.mark.parametrize(("bad", "error"), [(0.0, ValueError), (np.inf, ValueError), ("1", TypeError)])
def test_refuses_limits_and_sharpnesses(bad, error):
    with pytest.raises(error, match="limit must be"):
        HardClipAmplifier(bad)
    with pytest.raises(error, match="limit must be"):
        SoftSaturationAmplifier(bad)
    with pytest.raises(error, match="sharpness must be"):
        SoftSaturationAmplifier(1.0, bad)


def test_models_of_the_compiled_loop():
    np.testing.assert_array_equal(compiled_model(None), LinearAmplifier().model)
    assert compiled_model(HardClipAmplifier(2.0))["limit"][0] == 2.0
    assert compiled_model(abs) is None


def test_a_subclass_is_called_not_replaced_by_its_parents_equation():
    class Weak(HardClipAmplifier):
        def __call__(self, signal):
            return 0.5 * super().__call__(signal)

    plant = Plant([1.0], [1.0], amplifier=Weak(1.0), fs=8000)
    result = simulate(fx_lms(4, plant, step_size=0.1), np.random.default_rng(0).standard_normal(50), plant)
    np.testing.assert_array_equal(result.amplifier_output, 0.5 * np.clip(result.control_signal, -1, 1))


def test_a_class_is_no_amplifier() -> None:
    with pytest.raises(
        TypeError, match=r"amplifier must be an object, such as HardClipAmplifier\(limit=1\.0\), got <cl"
    ):
        compiled_model(HardClipAmplifier)
