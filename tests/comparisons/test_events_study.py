"""The study of KF-PB's events: its figures against a run of one's own, and what any right answer meets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from comparisons.bench.changes import CHANGES
from comparisons.studies import events as study
from kfopc_filterpy import kf_pb


def short(name: str, duration_s: float) -> study.Event:
    event = study.event(name)
    n = round(duration_s * study.FS)
    return replace(event, reference=event.reference[:n], disturbance=event.disturbance[:n], sound=event.sound[:n])


def test_the_secondary_path_changes_its_sign_at_the_event() -> None:
    event = short("secondary path's sign at 0.4 s", 1.0)
    controller = kf_pb(study.N_TAPS, study.SECONDARY, rated_power=study.RATED, fs=study.FS)
    error, y = study.played(event, controller)
    heard = np.convolve(y, study.SECONDARY)[: y.size]
    heard[event.begins :] *= -1.0
    np.testing.assert_allclose(error, event.disturbance - heard, rtol=0, atol=1e-9)
    assert controller.alarms == 1


CONVERTED = {
    "none": lambda x: x,
    "clips at 0.5": lambda x: np.clip(x, -0.5, 0.5),
    "12 bits, full scale 4": lambda x: np.round(x / 4 * 2**11) / 2**11 * 4,
    "offset of 0.1": lambda x: x + 0.1,
    "one block of 32 in 100 is lost": lambda x: np.where(np.arange(x.size) // 32 == 99, 0.0, x),
}


@pytest.mark.parametrize("name", CONVERTED)
def test_a_converter_delivers_both_signals_changed(name: str) -> None:
    heard, delivered = [], []

    class Silent:
        def control_signal(self, reference: float) -> float:
            heard.append(reference)
            return 0.0

        def update(self, error: float) -> None:
            delivered.append(error)

    event = short("nothing", 0.25)
    error, _ = study.played(event, study.Converted(Silent(), study.CONVERTERS[name], both=True))
    np.testing.assert_array_equal(error, event.disturbance)
    np.testing.assert_array_equal(heard, CONVERTED[name](event.reference))
    np.testing.assert_array_equal(delivered, CONVERTED[name](error))
    if "clips" in name:
        study.played(replace(event, limit=0.5), Silent())
        np.testing.assert_array_equal(delivered[error.size :], np.clip(error, -0.5, 0.5))


AT, FS = 400, 1000.0
T = np.arange(1000)
TONE = np.sin(2 * np.pi * 0.03 * T)


@pytest.mark.parametrize(
    ("what", "signal", "later"),
    [
        ("primary path's sign", "disturbance", -TONE),
        ("primary path 5 samples late", "disturbance", np.sin(2 * np.pi * 0.03 * (T - 5))),
        ("noise 12 dB softer", "noise", TONE / 3.98107),
        ("reference dead for 10 s", "reference", 0.0 * TONE),
        ("a reference sample of 1e4", "reference", np.where(T == AT, 1e4 / np.sqrt(2.0), TONE)),
        (
            "another noise, 30 dB louder, for 1 s",
            "disturbance",
            TONE + 10**1.5 / np.sqrt(2.0) * np.r_[np.zeros(AT), np.random.default_rng(AT).standard_normal(T.size - AT)],
        ),
        ("soft past, 1e-3", "noise", TONE),
        ("drift of 20 % of a sample a second", "disturbance", np.sin(2 * np.pi * 0.03 * (T - 0.2 * (T - AT) / FS))),
    ],
)
def test_a_change_is_what_its_name_says(what: str, signal: str, later: np.ndarray) -> None:
    """A tone of 33 samples a period, between whose samples a cubic spline is right to 1e-4."""
    changed = getattr(CHANGES[what], signal)(TONE, AT, FS)
    before = 1e-3 * TONE if "past" in what else TONE
    np.testing.assert_allclose(changed[:AT], before[:AT], atol=1e-4)
    np.testing.assert_allclose(changed[AT:], later[AT:], atol=1e-4, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "loudest_db"),
    [
        ("primary path's sign at 1 s", 0.0),
        ("secondary path's sign at 0.4 s", 0.0),
        ("secondary path late at 0.4 s", 0.0),
        ("noise 12 dB softer", 0.0),
        ("a reference sample of 1e4", 0.0),
        ("another noise, 30 dB louder, for 1 s", 0.01),  # nothing cancels it
    ],
)
def test_the_bound_is_reached_two_seconds_after(name: str, loudest_db: float) -> None:
    """Each of these once cost KF-PB 3 dB or more for seconds, or for good, in some part of a block at least."""
    row = study.event_row(name)
    assert max(row.lost_db[2:6]) < 0.5
    assert row.loudest_second_db < loudest_db
    assert row.loudest_tenth_db < 3.0
    assert row.power < 1.02


def test_an_event_can_be_delayed_by_a_part_of_a_block() -> None:
    early, late = (study.event("primary path's sign at 1 s", delay) for delay in (0.0, 0.75))
    assert late.begins - early.begins == 0.75 * 512
    assert (
        early.disturbance[16000] * early.reference[16000 - 40]
        < 0.0
        < late.disturbance[16000] * late.reference[16000 - 40]
    )


def test_what_a_silence_has_left_is_spent_evenly() -> None:
    """It was spent at once: seconds 2 to 4 were 1.5 dB beyond the bound, and the tenth 3.7 dB short of it."""
    row = study.event_row("soft past, 1e-3")
    assert max(row.lost_db) < 2.0
    assert np.mean(row.lost_db[5:]) < 1.0
    assert row.power < 1.03
