"""The study of KF-PB's events: its figures against a run of one's own, and what any right answer meets."""

from __future__ import annotations

import numpy as np
import pytest

from comparisons.studies import events as study
from kfopc_filterpy import Plant, kf_pb, simulate


def test_the_loop_of_the_study_is_that_of_simulate() -> None:
    event = study.scene("sign", 0.4, secondary=-study.SECONDARY)
    controllers = [kf_pb(study.N_TAPS, study.SECONDARY, rated_power=study.RATED, fs=study.FS) for _ in range(2)]
    n = round(1.0 * study.FS)
    short = study.Event(
        event.name, event.reference[:n], event.disturbance[:n], event.paths, event.begins, event.judged, event.sound[:n]
    )
    error, y = study.played(short, controllers[0])
    plant = Plant(study.SECONDARY, fs=study.FS).changed_at(0.4, secondary=-study.SECONDARY)
    result = simulate(controllers[1], short.reference, plant, disturbance=short.disturbance)
    np.testing.assert_allclose(error, result.error, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(y, result.control_signal)
    assert controllers[0].alarms == controllers[1].alarms == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["primary path's sign at 1 s", "noise 12 dB softer", "a reference sample of 1e4"])
def test_the_bound_is_reached_two_seconds_after(name: str) -> None:
    """The sign of a path, an easier noise and a click: what each cost KF-PB 5 dB and more for seconds before."""
    row = study.event_row(name)
    assert max(row.lost_db[2:6]) < 0.5
    assert row.loudest_second_db < 0.0
    assert row.loudest_tenth_db < 3.0
    assert row.power < 1.02
