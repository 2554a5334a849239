"""The multichannel study on a small scale, and its claims."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.channels import through
from helpers.studies import few_settings, plain_run, row_of, run_study, smaller

from comparisons.studies import multichannel
from comparisons.studies import multichannel_rooms as rooms
from comparisons.studies.multichannel import BOUND, KF_PB, ChannelRow, claims
from comparisons.studies.multichannel_rooms import MEASURED, Place
from kfopc_filterpy import Plant

KEPT = ("KF-PB", "FxLMS", "MOV-FxLMS", "clipping FxLMS", "leaky FxLMS")


@pytest.fixture(scope="module")
def small() -> Any:
    """The 2 x 2 room of 16 taps and two noises of two seconds, five algorithms and few settings."""
    room = rooms.built_in_room(2)
    with smaller(rooms, SIZES=(2,)):
        noises = rooms.places()["2 x 2"].noises
        rooms.places.cache_clear()
    chosen = {name: noises[name] for name in ("band noise", "compressor")}
    short = Plant(room.secondary[..., :60], room.primary[..., :100], fs=room.fs)
    place = Place("2 x 2", 16, short, chosen)
    constants = {"places": lambda: {"2 x 2": place}, "DURATION_S": 2.0, "SHOWN": ("2 x 2", "band noise")}
    with few_settings(several_channels=KEPT), smaller(multichannel, **constants):
        return run_study(multichannel), place


def test_rows_are_what_a_run_by_hand_gives(small: Any) -> None:
    """The same scene, made again from the paths; noise reduction and powers by the metrics."""
    report, place = small
    scene = rooms.make_rated_scene(place, "band noise", 2.0)
    x = scene.references[0]
    np.testing.assert_allclose(scene.disturbances[0], through(place.plant.primary, x), atol=1e-12 * np.abs(x).max())
    for name in (KF_PB, "FxLMS"):
        row = row_of(report, algorithm=name, noise="band noise", rating="a quarter each")
        result = plain_run(scene, name, row["setting"])
        assert row["noise_reduction_db"] == pytest.approx(result.noise_reduction_db, abs=1e-6)
        np.testing.assert_allclose(row["powers"], result.output_power / scene.rated_power, rtol=1e-6)


# ---- Claims


def row(algorithm: str, noise_reduction_db: float, powers: list[float], *, recorded: bool = False) -> ChannelRow:
    """Return a row of two loudspeakers; the rating of the second one does not bind."""
    place = {"path": MEASURED, "noise": "recorded motor"} if recorded else {"path": "4 x 4", "noise": "tones"}
    figures: dict[str, Any] = {"noise_reduction_db": noise_reduction_db, "powers": powers, "power": max(powers)}
    return ChannelRow(**place, algorithm=algorithm, limited=[True, False], **figures)


def test_claims_from_rows_made_by_hand() -> None:
    steady = [row(BOUND, 8.0, [1.0, 0.5]), row(KF_PB, 7.8, [0.96, 0.4]), row("MOV-FxLMS", 8.2, [1.01, 0.4])]
    recorded = [
        row(BOUND, 8.0, [1.0, 0.5], recorded=True),
        row(KF_PB, 6.9, [1.06, 0.4], recorded=True),
        row("MOV-FxLMS", 9.0, [1.1, 0.4], recorded=True),  # it does not keep its rating
    ]
    for rows in ([*steady, *recorded], [*recorded[::-1], *steady[::-1]]):
        found = claims(rows)
        assert [claim.value for claim in found] == pytest.approx([0.96, 0.2, 0.96, 1.06, 1.1, 0.4])
        assert [claim.holds for claim in found] == [True, True, False, False, False, False]
    assert len(claims(steady)) == 4


def test_the_rival_is_the_best_of_those_that_keep_every_rating() -> None:
    rival, better = (row(name, db, [1.0, 0.4]) for name, db in (("MOV-FxLMS", 5.0), ("leaky FxLMS", 8.2)))
    assert [one.algorithm for one in multichannel.rivals([rival, better])] == ["leaky FxLMS", "MOV-FxLMS"]
    assert multichannel.rivals([replace(better, power=1.1), replace(better, algorithm="FxLMS")]) == []
