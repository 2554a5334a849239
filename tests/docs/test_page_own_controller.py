"""What the tutorial on a controller of one's own says of its figures."""

from __future__ import annotations

from helpers.pages import Page

from kfopc_filterpy import noise_reduction_db, output_power


def test_the_figures_say_what_the_page_says():
    v = Page("own_controller").run()
    lead = noise_reduction_db(v.result.error, v.result.disturbance)
    lead -= noise_reduction_db(v.rival.error, v.rival.disturbance)
    assert lead > 9
    assert output_power(v.result.control_signal) > 2.5 * v.scene.rated_power
    assert v.best == v.steps[2]
    mine, others = v.figures["integrating LMS"], [v.figures[name] for name in v.names]
    assert mine[0] < min(other[0] for other in others)
    assert mine[1] < min(other[1] for other in others)
    assert mine[3] > 2
    assert abs(mine[2] - 1) < 0.02
    assert max(other[3] for other in others) < 1.5
