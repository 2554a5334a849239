"""What the tutorial on learning noises says of its figures."""

from __future__ import annotations

import numpy as np
from helpers.pages import Page


def test_the_figures_say_what_the_page_says():
    page = Page("learning_noise")

    v = page.run(until="Noises from the record")
    assert 0.15 < np.mean(v.z.mask) < 0.25
    guessed = v.consistency(v.guessed)
    assert guessed.nis_mean > 2 * guessed.nis_mean_bounds[1]
    assert np.all(guessed.autocorrelation[:5] > guessed.autocorrelation_bounds[:5])
    assert "Q is too small beside R" in str(guessed)
    factor = v.consistency(v.run(v.tracker(0.04, 0.9)))  # both wrong by one factor
    assert "S is too small" in str(factor)
    assert abs(factor.autocorrelation[0]) < 2 * factor.autocorrelation_bounds[0]

    v = page.run(until="Is P right? Many runs with a known truth")
    for values, errors, true in (
        (v.fit.state_noise, v.fit.state_noise_errors, 0.4),
        (v.fit.measurement_noise, v.fit.measurement_noise_errors, 9.0),
    ):
        assert abs(values[0] - true) < 2 * errors[0]
    assert "too" not in str(v.consistency(v.learned))
    assert v.errors["guessed"] > 3 * v.errors["learned"]
    assert v.errors["learned"] < 1.02 * v.errors["true"]

    v = page.run()
    right, wrong = v.tested[0.0], v.tested[0.2]

    def inside(result):
        return np.mean((result.nees_bounds[0] <= result.nees) & (result.nees <= result.nees_bounds[1]))

    assert abs(right.nees_mean - 1) < 0.15
    assert wrong.nees_mean > 1.5
    assert inside(right) > 0.85 > 0.7 > inside(wrong)
