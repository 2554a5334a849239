"""A comparison on one's own recordings: what it says about the amplifier, the units and the settings."""

import numpy as np
import pytest

from kfopc_filterpy.bench import compare_recordings
from kfopc_filterpy.power import AmplifierRating
from kfopc_filterpy.signals import tone

FS = 8000.0


@pytest.fixture(scope="module")
def compared():
    """Return a comparison with a rating of 10 W into 8 ohm, 4 V per unit."""
    rating = AmplifierRating(8.0, sine_watt=10.0, volts_per_unit=4.0)
    x = tone(400.0, 1.0, fs=FS)
    return compare_recordings(x, np.eye(32)[20], [0, 1.0], rating=rating, fs=FS, names=["FxLMS"], n_taps=8)


def test_powers_are_in_watts_if_the_rating_is(compared):
    assert compared.watt_per_power == pytest.approx(4.0**2 / 8)
    assert compared.rating == "10 W"
    power = next(item.figure.axes[0] for item in compared.figures if item.stem == "power")
    assert power.get_ylabel() == "Output power (W)\nover 250 ms"
    assert power.get_legend_handles_labels()[1] == ["FxLMS", "Rated power 10 W"]


def test_the_summary_says_whether_the_amplifier_clips(compared):
    assert compared.summary.endswith(f"The amplifier clips beyond ±{np.sqrt(2 * 10 * 8) / 4:.3g}.")

    def summary(primary, secondary, rating):
        options = {"rating": rating, "fs": FS, "names": ["FxLMS"], "n_taps": 8}
        return compare_recordings(tone(400.0, 1.0, fs=FS), primary, secondary, **options).summary

    assert " The amplifier does not clip." in summary(np.eye(32)[20], [0, 1.0], 1.0)
    several = np.eye(32)[[20, 22]][:, np.newaxis], np.eye(2)[..., np.newaxis] * [0, 1.0]
    assert " The amplifiers do not clip." in summary(*several, 1.0)
    clips = AmplifierRating(8.0, sine_watt=9.0, volts_per_unit=8.0)  # beyond 12 V
    assert " The amplifiers clip beyond: never, ±1.5." in summary(*several, [1.0, clips])
