"""A run on one's own files: recordings are taken as they were read, and their rates are checked."""

from __future__ import annotations

import numpy as np
import pytest

from kfopc_filterpy import kf_opc, kf_pb, simulate
from kfopc_filterpy.signals import Recording

FS = 8000
NOISE = np.random.default_rng(0).standard_normal(8000)
PRIMARY, SECONDARY = np.eye(2, 64, 20)[[0, 1, 0]] * [[1.0], [0.8], [0.6]], np.eye(1, 32, 8)[0]


def recorded(samples) -> Recording:
    return Recording(samples, FS)


def test_a_run_takes_recordings():
    errors = []
    for kind in (np.asarray, recorded):
        x, primary, secondary = kind(NOISE), kind(PRIMARY[0]), kind(SECONDARY)
        controller = kf_pb(32, secondary, rated_power=0.5, fs=FS)
        errors.append(simulate(controller, x, primary_path=primary, secondary_path=secondary, fs=FS).error)
    np.testing.assert_array_equal(*errors)


@pytest.mark.parametrize("kind", [np.asarray, recorded])
def test_a_run_takes_the_primary_paths_of_one_reference_to_several_microphones(kind):
    secondary = np.stack([SECONDARY, 0.5 * SECONDARY, 0.3 * SECONDARY])[:, np.newaxis]
    errors = [
        simulate(
            kf_pb(32, secondary, rated_power=0.5, fs=FS), NOISE, primary_path=primary, secondary_path=secondary, fs=FS
        ).error
        for primary in (kind(PRIMARY), PRIMARY[:, np.newaxis])
    ]
    np.testing.assert_array_equal(*errors)


def test_paths_of_different_lengths_are_rows_of_recordings():
    rows = [[recorded(SECONDARY)], [recorded(SECONDARY[:16])]]
    controller = kf_pb(32, rows, rated_power=0.5, fs=FS)
    np.testing.assert_array_equal(controller.secondary_path, np.stack([SECONDARY, SECONDARY])[:, np.newaxis])
    with pytest.raises(ValueError, match=r"fs is 16000 Hz but the controller's secondary path is for 8000 Hz"):
        controller.require_sample_rate(16000)


@pytest.mark.parametrize("name", ["reference", "disturbance", "primary_path", "secondary_path"])
def test_a_recording_of_another_rate_is_refused(name):
    run = {"reference": NOISE, "secondary_path": SECONDARY}
    run |= {"disturbance": NOISE} if name == "disturbance" else {"primary_path": PRIMARY[0]}
    controller = kf_pb(32, SECONDARY, rated_power=0.5)
    with pytest.raises(ValueError, match=rf"{name} is sampled at 8000 Hz but fs is 16000 Hz; read it with fs=16000"):
        simulate(controller, **run | {name: recorded(run[name])}, fs=16000)


def test_kf_opc_has_the_sample_rate_that_it_is_given():
    settings = {"state_noise": 1e-6, "measurement_noise": 0.1}
    controller = kf_opc(8, SECONDARY, rated_power=0.5, fs=FS, **settings)
    assert controller.constraint.fs == FS
    simulate(controller, NOISE[:100], primary_path=PRIMARY[0], secondary_path=SECONDARY, fs=FS)
    with pytest.raises(ValueError, match=r"fs belongs to rated_power: a constraint has its own"):
        kf_opc(8, SECONDARY, constraint=controller.constraint, fs=FS, **settings)
