"""Each check of arguments, once: what it takes, what it refuses, and that the message names the argument."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from kfopc_filterpy._validate import (
    as_band,
    as_channels,
    as_choice,
    as_count,
    as_generator,
    as_nonnegative,
    as_number,
    as_positive,
    as_rate,
    as_rate_ratio,
    as_real_array,
    as_sample_count,
    as_signal,
    per_loudspeaker,
)

MASKED = np.ma.masked_array([1.0, 2.0], [False, True])
pair = partial(as_band, fs=16000.0)


def test_what_is_taken():
    assert as_signal(MASKED.data.astype(np.int8)[::-1], "x").tolist() == [2.0, 1.0]
    assert as_signal([1, 2], "x").flags.c_contiguous
    assert np.isnan(as_real_array(MASKED, "x")[1])
    assert as_channels([[1, 2], [3, 4]], "x").dtype == np.float64
    for one in (2, 2.0, np.float32(2), np.array([[2.0]]), True + True):
        assert type(as_number(one, "x")) is float
    assert (as_nonnegative(0, "x"), as_count(np.int8(3), "x"), as_choice("a", "x", "ab")) == (0.0, 3, "a")
    assert [as_rate(edge, "x") for edge in (1e-3, 1e9)] == [1e-3, 1e9]
    assert per_loudspeaker(2, 3, "x").tolist() == [2.0, 2.0, 2.0]
    assert (pair((0, 8000)), as_rate_ratio(44100, 16000)) == ((0.0, 8000.0), (160, 441))
    assert [as_sample_count(seconds, 10, "x") for seconds in (0.06, 0.14, 1.0)] == [1, 1, 10]
    assert as_generator(3).random() == as_generator(np.random.default_rng(3)).random()


@pytest.mark.parametrize(
    ("check", "value", "error", "message"),
    [
        (as_signal, [[1.0]], ValueError, r"x must be one-dimensional.*pass one channel, e.g. x\[0\] or x.ravel"),
        (as_signal, [], ValueError, "x must have at least 1 value"),
        (partial(as_signal, length=3), [1.0], ValueError, "x must have 3 values, got 1"),
        (as_signal, [0.0, np.nan], ValueError, r"x must be finite, but holds NaN or Inf \(first at index 1\)"),
        (as_signal, [10**400], ValueError, "too large for a float"),
        (as_real_array, [[1.0], [1.0, 2.0]], TypeError, "got list, whose rows differ in length"),
        (as_real_array, [1j], TypeError, "x must be a sequence of real numbers, got complex ones"),
        (as_real_array, [1.0, "a"], TypeError, "x must be a sequence of real numbers"),
        (as_real_array, "abc", TypeError, "x must be a sequence of real numbers, got str$"),
        (as_real_array, "1.5e-3", TypeError, "x must be a sequence of real numbers, got str$"),
        (
            as_real_array,
            Path("a.wav"),
            TypeError,
            "Path: read the file with paths.read_path .* or signals.read_recording",
        ),
        (as_real_array, np.array([1.0, "a"], dtype=object), TypeError, "text, dates or masked values among them"),
        (as_channels, 1.0, ValueError, r"x must be \(n_samples,\) or \(n_channels, n_samples\), got shape \(\)"),
        (as_channels, np.ones((0, 4)), ValueError, "x must have at least 1 value"),
        (as_channels, np.ones((3, 2)), ValueError, r"x must have its channels first.* transpose it, x.T"),
        (as_channels, [[0.0, 1.0], [np.inf, 0.0]], ValueError, r"first at index \(1, 0\)"),
        (as_number, None, TypeError, "x must be a single number, got None"),
        (as_number, [1.0, 2.0], TypeError, "x must be a single number"),
        (as_number, True, TypeError, "x must be a single number, got True"),
        (as_number, 1j, TypeError, "x must be a single number"),
        (as_number, np.inf, ValueError, "x must be finite, got inf"),
        (as_number, MASKED[1], ValueError, "x must be finite, got a masked value"),
        (partial(as_positive, unit="Hz"), 0.0, ValueError, "x must be greater than 0 Hz, got 0"),
        (as_nonnegative, -1e-300, ValueError, "x must not be negative"),
        (as_rate, 9e-4, ValueError, "x must be a sampling rate from 0.001"),
        (as_count, 0, ValueError, "x must be at least 1, got 0"),
        (as_count, 1.0, TypeError, "x must be a whole number"),
        (as_count, True, TypeError, "x must be a whole number, got True"),
        (partial(as_choice, choices=("a", "b")), "c", ValueError, "x must be one of 'a', 'b', got 'c'"),
        (lambda value, name: per_loudspeaker(value, 3, name), [1.0, 2.0], ValueError, "each of the 3 loudspeakers"),
        (lambda value, name: per_loudspeaker(value, 2, name), [1.0, 0.0], ValueError, "x must be greater than 0"),
        (
            lambda value, name: per_loudspeaker(value, 1, name),
            [1.0, 2.0],
            ValueError,
            r"for 1 loudspeaker, got shape \(2,\)",
        ),
        (
            lambda value, name: per_loudspeaker(value, 2, name),
            [[1.0], [1.0, 2.0]],
            TypeError,
            "x must be .* whose rows differ in length",
        ),
        (lambda value, name: per_loudspeaker(value, 2, name), "2 W", TypeError, "x must be a single number, got '2 W'"),
        (lambda value, _: pair(value), 100.0, ValueError, r"band must be a pair \(low, high\)"),
        (lambda value, _: pair(value), (-1.0, 5.0), ValueError, "band must satisfy"),
        (lambda value, _: pair(value), (5.0, 5.0), ValueError, "band must satisfy"),
        (lambda value, _: pair(value), (5.0, 8001.0), ValueError, "fs/2 = 8000 Hz, got"),
        (lambda value, _: as_rate_ratio(16000, value), 16000 * np.pi, ValueError, "in a ratio of whole numbers"),
        (lambda value, name: as_sample_count(value, 10, name), 0.05, ValueError, "x must be at least one sample, 0.1"),
        (lambda value, name: as_sample_count(1e300, value, name), 1e300, ValueError, "a finite number of samples"),
        (lambda value, name: as_sample_count(1.0, value, name), 0, ValueError, "fs must be greater than 0 Hz"),
        (lambda value, _: as_generator(value), None, TypeError, "rng must be a seed or a numpy.random.Generator"),
    ],
    ids=range(43),
)
def test_what_is_refused(check, value, error, message):
    with pytest.raises(error, match=message):
        check(value, "x")
