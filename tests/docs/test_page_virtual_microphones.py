"""What the tutorial on virtual microphones says of its figures."""

from __future__ import annotations

import numpy as np
from helpers.pages import Page


def test_the_figures_say_what_the_page_says():
    v = Page("virtual_microphones").run()
    reduction = {name: v.at(v.virtual, run) for name, run in v.runs.items()}
    headrest, ears = reduction["Headrest microphones"], reduction["Microphones at the ears"]
    there = v.at(v.physical, v.runs["Headrest microphones"])
    assert 0.25 < headrest / there < 0.4  # a third of the decibels is left
    assert ears > headrest + 20
    for observed in ("Remote microphones", "Kalman observer"):  # close to microphones at the ears
        assert abs(reduction[observed] - ears) < 0.5
    assert np.all(v.observation.residual_db < -30)
    assert np.all(v.kalman().observer.residual_db < -30)
    assert np.all(v.model.residual_db < -60)

    assert v.believed > 30 > 0 > v.at(v.virtual, v.after)  # the headrest does not notice
    kalman = v.run(v.kalman(), v.moved)
    ears_only = v.run(v.only(v.virtual), v.moved)
    assert v.at(v.virtual, kalman) < 0 < 30 < v.at(v.virtual, ears_only)

    here, front = v.residual_db(v.physical, v.primary), v.residual_db(v.physical, v.moved)
    assert np.all(front < -15)  # works, though less well
    assert np.all(front > here + 1)
    assert np.all(v.residual_db(v.physical, v.primary, v.moved) > -6)  # does not work
    assert np.all(v.residual_db([0, 1, 4], *v.with_third) < -18)  # tells the two apart


def test_the_observers_leave_the_noise_of_the_microphones_and_the_headrest_leaves_more():
    """As the figure's caption says; and why: the loudspeakers' sound falls off over the 15 cm."""
    v = Page("virtual_microphones").run(until="The noise field changes")
    powers = {name: np.mean(run.error[2, 8000:] ** 2) for name, run in v.runs.items()}
    own = v.sensor_noise_std**2
    assert powers.pop("Headrest microphones") > 100 * own
    np.testing.assert_allclose(list(powers.values()), own, rtol=0.1)
    loudspeakers, noise = (np.sum(paths**2, axis=-1) for paths in (v.secondary, v.primary))
    assert 10 * np.log10(loudspeakers[0, 0] / loudspeakers[2, 0]) > 3
    assert abs(10 * np.log10(noise[0, 0] / noise[2, 0])) < 1
