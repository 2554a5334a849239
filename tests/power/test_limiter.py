"""The limiter: its bound in exact arithmetic, what passes unchanged, and what overload comes out like.

The bound has no tolerance: the oracle adds squares as whole numbers, of which every float is one times 2**-1074. The
other tolerances stand, with their reason, where they are used.
"""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from kfopc_filterpy import OutputLimiter
from kfopc_filterpy.signals import band_limited_noise, tone

FS = 16000.0
UNIT = 2**1074  # a float times this is a whole number


def limiter(samples: int, rated_power: float = 1.0, amplitude_limit: float | None = None) -> OutputLimiter:
    """A limiter whose windows have `samples` samples."""
    return OutputLimiter(rated_power, fs=1.0, window_s=float(samples), amplitude_limit=amplitude_limit)


def whole(x: float) -> int:
    """x in units of 2**-1074, exactly."""
    numerator, denominator = float(x).as_integer_ratio()
    return numerator * (UNIT // denominator)


def first_window_over(y: np.ndarray, samples: int, rated_power: float) -> int | None:
    """Where a window with more than `samples` times `rated_power` ends, by exact sums; zeros before the first."""
    budget = samples * whole(rated_power) * UNIT
    squares = [whole(v) ** 2 for v in y]
    energy = 0
    for n, square in enumerate(squares):
        energy += square - (squares[n - samples] if n >= samples else 0)
        if energy > budget:
            return n
    return None


def power_after(y: np.ndarray, seconds: float) -> float:
    return float(np.mean(y[round(seconds * FS) :] ** 2))


def distortion_db(y: np.ndarray, frequency: float) -> float:
    """All but the tone, harmonics and modulation alike, over the tone."""
    phase = 2 * np.pi * frequency / FS * np.arange(y.size)
    basis = np.stack([np.cos(phase), np.sin(phase)], axis=1)
    fitted = basis @ np.linalg.lstsq(basis, y, rcond=None)[0]
    return 10 * math.log10(np.mean((y - fitted) ** 2) / np.mean(fitted**2) + 1e-30)


def of_kind(kind: str, n: int, level: float, rng: np.random.Generator) -> np.ndarray:
    """A piece of n samples; `level` is an amplitude."""
    if kind == "silence":
        return np.zeros(n)
    if kind == "spike":
        return np.where(np.arange(n) == n // 2, level, 0.0)
    if kind == "constant":
        return np.full(n, level)
    if kind == "square":
        return level * np.where(np.arange(n) // max(n // 7, 1) % 2, -1.0, 1.0)
    if kind == "alternating":
        return level * (-1.0) ** np.arange(n)
    if kind == "tone":
        return level * np.sin(rng.uniform(0.01, 3.0) * np.arange(n))
    return np.clip(level * np.clip(rng.normal(size=n), -3.0, 3.0), -1e308, 1e308)


KINDS = ["silence", "spike", "constant", "square", "alternating", "tone", "noise"]
# Decades of the amplitude over the rated one: mostly near it, else anything down to denormals and up to 1e150.
decades = st.one_of(st.floats(-2.0, 3.0), st.floats(-300.0, 150.0))
pieces = st.lists(st.tuples(st.sampled_from(KINDS), st.integers(1, 120), decades), min_size=1, max_size=12)
windows = st.one_of(st.sampled_from([1, 2, 3, 7, 15, 16, 17, 64]), st.integers(1, 200))
powers = st.one_of(st.floats(0.01, 100.0), st.integers(-306, 300).map(lambda k: 10.0**k), st.just(5e-324))


def adversary(parts: list, rated_power: float, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rated = math.sqrt(rated_power)
    signal = [of_kind(kind, n, min(rated * 10.0**decade, 1e307), rng) for kind, n, decade in parts]
    return np.concatenate(signal)


@given(pieces, windows, powers, st.none() | st.floats(-3.0, 3.0), st.integers(0, 10**6))
@example([("constant", 120, 0.0)] * 5, 64, 1.0, None, 0)
@example([("alternating", 120, 0.0), ("spike", 3, 150.0), ("constant", 120, 0.001)] * 3, 7, 1e-300, None, 0)
def test_no_window_is_ever_above_the_rated_power_and_no_sample_above_the_amplitude_limit(
    parts: list, samples: int, rated_power: float, decade: float | None, seed: int
) -> None:
    u = adversary(parts, rated_power, seed)
    limit = None if decade is None else math.sqrt(rated_power) * 10.0**decade
    y = limiter(samples, rated_power, limit).process(u)
    assert np.all(np.isfinite(y))
    assert first_window_over(y, samples, rated_power) is None
    assert np.all(y * np.sign(u) >= 0)  # scaled, never turned or amplified
    assert np.all(np.abs(y) <= np.minimum(np.abs(u), np.inf if limit is None else limit))


@given(pieces, windows, st.integers(0, 10**6))
def test_what_stays_below_half_of_the_rated_power_passes_bit_for_bit(parts: list, samples: int, seed: int) -> None:
    """Whatever its shape: no horizon can then be short of room. 0.499: sums here have roundings of their own."""
    u = adversary([(kind, n, min(decade, 20.0)) for kind, n, decade in parts], 1.0, seed)
    u /= np.max(np.abs(u)) or 1.0
    u *= math.sqrt(0.499 * samples / max(np.max(np.convolve(u**2, np.ones(samples))), 1.0))
    ours, with_limit = limiter(samples), limiter(samples, amplitude_limit=max(np.max(np.abs(u)), 4.0))
    assert ours.process(u).tobytes() == with_limit.process(u).tobytes() == u.tobytes()
    assert (ours.gain, ours.clipped) == (1.0, 0)


@pytest.mark.parametrize("frequency", [50.0, 57.0, 1000.0])
def test_a_steady_tone_passes_bit_for_bit_up_to_09_of_the_rated_power(frequency: float) -> None:
    """From silence on; five periods a window or more, with fewer its power within a window swings too far."""
    u = tone(frequency, 1.0, fs=FS, amplitude=math.sqrt(2 * 0.9))
    assert OutputLimiter(1.0, fs=FS).process(u).tobytes() == u.tobytes()


@pytest.mark.parametrize(("frequency", "over"), [(50.0, 4.0), (300.0, 1.2), (1000.0, 400.0)])
def test_a_tone_in_overload_is_scaled_not_clipped(frequency: float, over: float) -> None:
    """0.98 of the rated power is aimed at. After 1 s: the memory of the start fades over the 2 s that MEMORY is.

    -60 dB: measured below -200 dB for these; tones whose periods do not fill the window are in the next test.
    """
    limiter = OutputLimiter(1.0, fs=FS)
    y = limiter.process(tone(frequency, 3.0, fs=FS, amplitude=math.sqrt(2 * over)))
    assert first_window_over(y, 1600, 1.0) is None
    assert 0.97 <= power_after(y, 1.0) <= 1.0
    assert distortion_db(y[16000:], frequency) < -60
    assert limiter.clipped < 0.02 * y.size  # at the onset, before the gain has fallen
    before = limiter.clipped
    limiter.process(tone(frequency, 1.0, fs=FS, amplitude=math.sqrt(2 * over)))
    assert limiter.clipped == before
    assert limiter.gain == pytest.approx(math.sqrt(0.98 / over), rel=0.01)


@pytest.mark.parametrize("over", [2.0, 10.0])
def test_noise_in_overload_is_scaled_not_clipped(over: float) -> None:
    """Measured: 0.17 % clipped, 0.886 of the rated power, and an error 0.02 (2 x) and 0.03 (10 x) of the input's power
    above the least that any limiter could have, one that knows the future included (0.093 and 0.473, by solving the
    convex problem of all windows at once)."""
    u = band_limited_noise((200.0, 2000.0), 2.0, fs=FS, power=over, rng=5)
    limiter = OutputLimiter(1.0, fs=FS)
    y = limiter.process(u)
    assert limiter.clipped < 0.002 * u.size
    assert power_after(y, 1.0) > 0.85
    assert np.mean((u - y) ** 2) / over < {2.0: 0.093, 10.0: 0.473}[over] + 0.04


def test_a_tone_over_the_amplitude_limit_is_scaled_to_it() -> None:
    """Not clipped to it, but in the first windows: -60 dB as above, where a clipped tone has -11 dB."""
    limiter = OutputLimiter(100.0, fs=FS, amplitude_limit=1.0)
    y = limiter.process(tone(300.0, 3.0, fs=FS, amplitude=4.0))
    assert np.max(np.abs(y)) <= 1.0
    assert power_after(y, 1.0) == pytest.approx(0.5, rel=0.01)
    assert distortion_db(y[16000:], 300.0) < -60
    assert limiter.clipped < 0.02 * y.size


@pytest.mark.parametrize("rated_power", [1.0, 4.0])
def test_a_quiet_past_of_another_limiter_takes_no_more_than_its_power(rated_power: float) -> None:
    quiet = np.full(64, 0.5)
    before, after = limiter(64, rated_power=0.64), limiter(64, rated_power=rated_power)
    played = before.process(quiet)
    after.follow(before)
    out = after.process(quiet)
    np.testing.assert_array_equal(out, quiet)  # a quarter of the rated power at most, so it passes bit for bit
    assert first_window_over(np.concatenate([played, out]), 64, rated_power) is None


@given(pieces, windows, st.integers(0, 10**6), st.lists(st.integers(0, 200), max_size=4))
def test_a_stream_is_the_whole_signal_bit_for_bit(parts: list, samples: int, seed: int, cuts: list[int]) -> None:
    u = adversary(parts, 1.0, seed)
    expected = limiter(samples).process(u)
    ours, in_pieces = limiter(samples), limiter(samples)
    assert np.array([ours(v) for v in u]).tobytes() == expected.tobytes()
    joined = [in_pieces.process(piece) for piece in np.split(u, sorted(min(c, u.size) for c in cuts))]
    assert np.concatenate(joined).tobytes() == expected.tobytes()
    assert pickle.dumps(ours) == pickle.dumps(in_pieces)


def test_nothing_accumulates_in_a_long_run() -> None:
    """400 000 samples of noise over the rated power, with 1e150 and denormals in between; every window exactly."""
    rng = np.random.default_rng(0)
    u = 3.0 * rng.normal(size=400_000)
    u[40_000::90_000] = 1e150
    u[140_000:190_000] = 5e-324 * rng.integers(-3, 4, size=50_000)
    u[390_000:] *= 0.1
    ours = limiter(1600)
    y = ours.process(u)
    assert first_window_over(y, 1600, 1.0) is None
    assert np.mean(y[240_000:300_000] ** 2) > 0.8  # nor does what it lets through dwindle
    assert y[-1600:].tobytes() == u[-1600:].tobytes()
    for laps in ours.state.laps:
        assert np.all(np.isfinite(laps))


def test_the_rating_scales_everything() -> None:
    """The same signal at another rating, by powers of 4 to the bit: from 1e-300 to 1e300."""
    u = 3.0 * np.random.default_rng(3).normal(size=1000)
    u[500] = 1e5  # more than is planned for
    expected = limiter(100).process(u)
    for exponent in (-500, -40, 10, 500):
        factor = 2.0**exponent
        assert (limiter(100, factor**2).process(factor * u) / factor).tobytes() == expected.tobytes()


def test_reset_is_a_new_one() -> None:
    u = 3.0 * np.random.default_rng(5).normal(size=700)
    ours = limiter(100, amplitude_limit=5.0)
    state = ours.state
    expected = ours.process(u)
    ours.reset()
    assert ours.state is state  # a loop that holds the arrays goes on with them
    assert pickle.dumps(ours) == pickle.dumps(limiter(100, amplitude_limit=5.0))
    assert ours.process(u).tobytes() == expected.tobytes()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, "loud", [1.0, 2.0], None])
def test_a_bad_sample_changes_nothing(bad: object) -> None:
    ours = limiter(4)
    ours.process([1.0, -2.0, 3.0])
    before = pickle.dumps(ours)
    with pytest.raises((ValueError, TypeError), match=r"^u must be"):
        ours(bad)  # type: ignore[arg-type]
    with pytest.raises((ValueError, TypeError), match=r"^signal must"):
        ours.process([1.0, bad])
    assert pickle.dumps(ours) == before


@pytest.mark.parametrize(
    "kwargs",
    [
        {"rated_power": 0.0},
        {"rated_power": "1 W"},
        {"window_s": 1e-5},
        {"window_s": 1e4},
        {"amplitude_limit": math.inf},
    ],
)
def test_settings_out_of_range(kwargs: dict) -> None:
    with pytest.raises((ValueError, TypeError), match=next(iter(kwargs))):
        OutputLimiter(**{"rated_power": 1.0, "fs": FS} | kwargs)
