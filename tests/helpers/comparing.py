"""Comparisons of runs, estimators and controllers: equal, or equal to rounding."""

import copy
import dataclasses

import numpy as np

SIGNALS = (
    *("error", "control_signal", "amplifier_output", "anti_noise"),
    *("constraint_factor", "disturbance_power", "secondary_path_gain", "weights"),
)


def assert_same_run(one, two):
    """Every field of two results, to the bit."""
    for field in dataclasses.fields(one):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(two, field.name), err_msg=field.name)


def assert_goes_on_as(made, other):
    """Two controllers in the same state: they play and learn the same from here on, to the bit. Both stay as they are."""
    one, two = copy.deepcopy(made), copy.deepcopy(other)
    rng = np.random.default_rng(7)
    several = getattr(made, "multichannel", False)
    shapes = ((made.n_references,), (made.n_microphones,)) if several else ((), ())
    for n in range(50):
        x, e = (rng.standard_normal(shape) for shape in shapes)
        np.testing.assert_array_equal(one.control_signal(x), two.control_signal(x), err_msg=f"sample {n}")
        one.update(e), two.update(e)
        for name in ("weights", "covariance", "constraint_factor", "disturbance_power", "secondary_path_gain"):
            if hasattr(one, name):
                np.testing.assert_array_equal(getattr(one, name), getattr(two, name), err_msg=f"{name}, sample {n}")
