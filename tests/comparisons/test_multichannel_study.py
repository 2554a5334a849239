"""The multichannel study on a small scale, and its claims."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.channels import through
from helpers.studies import few_settings, plain_run, run_study, smaller

from comparisons.studies import multichannel
from comparisons.studies import multichannel_rooms as rooms
from comparisons.studies.multichannel import BOUND, KF_PB, SCALED, ChannelRow, claims
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
    rows = {(row["algorithm"], row["noise"], row["rating"]): row for row in report.extra["rows"]}
    scene = rooms.make_rated_scene(place, "band noise", 2.0)
    x = scene.references[0]
    np.testing.assert_allclose(scene.disturbances[0], through(place.plant.primary, x), atol=1e-12 * np.abs(x).max())
    for name in (KF_PB, "FxLMS"):
        row = rows[name, "band noise", "a quarter each"]
        result = plain_run(scene, name, row["setting"])
        assert row["noise_reduction_db"] == pytest.approx(result.noise_reduction_db, abs=1e-6)
        np.testing.assert_allclose(row["powers"], result.output_power / scene.rated_power, rtol=1e-6)


# ---- Claims


def rows_of(
    loss_db: float = 0.2, power: float = 1.0, rival_db: float = 5.0, rival_power: float = 1.0
) -> list[ChannelRow]:
    """Rows of a steady noise and of a recording; the second loudspeaker's rating does not bind."""
    rows = []
    for path, noise in (("4 x 4", "tones"), (MEASURED, "recorded motor")):
        place: dict[str, Any] = {"path": path, "noise": noise}
        limits = {"power": 1.0, "powers": [1.0, 0.5], "limited": [True, False]}
        rows += [
            ChannelRow(**place, algorithm=name, noise_reduction_db=db, **limits)  # type: ignore[arg-type]
            for name, db in ((BOUND, 8.0), (SCALED, 4.0))
        ]
        for name, db, own in ((KF_PB, 8.0 - loss_db, power), ("MOV-FxLMS", rival_db, rival_power)):
            rows.append(ChannelRow(**place, algorithm=name, noise_reduction_db=db, powers=[own, 0.4], power=own))
    return rows


@pytest.mark.parametrize(
    ("changes", "failing"),
    [
        ({}, []),
        ({"power": 0.96}, [2]),  # of the loudspeaker whose rating limits
        ({"power": 1.06}, [0, 3]),
        ({"loss_db": 0.6}, [1]),
        ({"loss_db": 1.1}, [1, 4]),
        ({"rival_db": 8.2}, [5]),
        ({"rival_db": 8.2, "rival_power": 1.1}, [5]),  # nothing to compare with
    ],
)
def test_claims_from_rows_made_by_hand(changes: dict[str, float], failing: list[int]) -> None:
    for rows in (rows_of(**changes), rows_of(**changes)[::-1]):
        assert [k for k, claim in enumerate(claims(rows)) if not claim.holds] == failing


def test_the_rival_is_the_best_of_those_that_keep_every_rating() -> None:
    rows = rows_of()
    rival = next(row for row in rows if row.algorithm == "MOV-FxLMS")
    better = replace(rival, algorithm="leaky FxLMS", noise_reduction_db=8.2)
    assert [row.algorithm for row in multichannel.rivals([rival, better])] == ["leaky FxLMS", "MOV-FxLMS"]
    assert multichannel.rivals([replace(better, power=1.1), replace(better, algorithm="FxLMS")]) == []


def test_without_recordings_there_is_no_claim_on_them() -> None:
    assert len(claims([row for row in rows_of() if row.path != MEASURED])) == 4
