"""Comparisons of runs, estimators and controllers: equal, or equal to rounding."""

import copy
import dataclasses

import numpy as np

SIGNALS = (
    "error",
    "control_signal",
    "amplifier_output",
    "anti_noise",
    "constraint_factor",
    "disturbance_power",
    "secondary_path_gain",
    "weights",
)


def assert_same_run(one, two):
    """Every field of two results, to the bit."""
    for field in dataclasses.fields(one):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(two, field.name), err_msg=field.name)


def assert_same_estimator(one, two):
    """All that two random-walk filters show, to the bit; `x_prior`, which the compiled loop does not keep, to rounding."""
    for name in ("x", "x_post", "P", "P_prior", "P_post", "K", "S", "SI", "y", "z"):
        a, b = getattr(one, name), getattr(two, name)
        np.testing.assert_array_equal(a, b, err_msg=name)
        assert (type(a), a.dtype) == (type(b), b.dtype), name
    for name in ("log_likelihood", "likelihood", "mahalanobis"):
        assert getattr(one, name) == getattr(two, name), name
    assert one.constraint_factor == two.constraint_factor
    assert one.disturbance_power == two.disturbance_power
    assert one.secondary_path_gain == two.secondary_path_gain
    # the compiled loop keeps x only: x_prior = x - K y to rounding
    np.testing.assert_allclose(one.x_prior, two.x_prior, rtol=0, atol=1e-14 * np.max(np.abs(two.x)))


def assert_close(got, want, tolerance=1e-10, scale=None, name=""):
    """To a tolerance relative to the largest value, or to `scale`; NaN where NaN is wanted."""
    scale = np.nanmax(np.abs(want)) if scale is None else scale
    np.testing.assert_allclose(got, want, rtol=0, atol=tolerance * scale, err_msg=name)


def assert_run_close(got, want):
    """Two runs of the same equations with sums in another order.

    The loop contracts, so that rounding does not grow: errors were 1e-13 of the largest value.
    """
    for name in (*SIGNALS, "weights_time_s"):
        if getattr(want, name) is not None:
            assert_close(getattr(got, name), getattr(want, name), name=name)
    for name in ("algorithm", "fs", "rated_power", "diverged_at_s"):
        assert getattr(got, name) == getattr(want, name), name


def numbers_of(value):
    """Copies of all arrays in a tuple of tuples, records as plain arrays."""
    if isinstance(value, np.ndarray):
        names = value.dtype.names
        return [value.copy()] if names is None else [np.array(value[name], dtype=float) for name in names]
    return [leaf for item in value for leaf in numbers_of(item)] if isinstance(value, tuple) else []


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
