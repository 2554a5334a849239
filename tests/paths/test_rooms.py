"""Rooms against closed forms, Allen and Berkley's sum over images, and pyroomacoustics' own impulse responses."""

import itertools

import numpy as np
import pytest

from kfopc_filterpy.paths import group_delay, horizontal_plane, room_paths

SIZE = np.array([5.0, 4.0, 2.5])
FS, C = 16000.0, 343.0
SOURCE = [0.6, 1.9, 1.1]
LOUDSPEAKERS = [[3.1, 1.2, 1.3], [3.0, 2.7, 1.0]]
MICROPHONES = [[4.1, 1.5, 1.2], [4.3, 2.4, 1.15], [3.9, 2.0, 1.4]]
PLACES = {"loudspeakers_m": LOUDSPEAKERS, "sources_m": SOURCE, "microphones_m": MICROPHONES}
WALLS = ("west", "east", "south", "north", "floor", "ceiling")
UNEVEN = dict(zip(WALLS, (0.9, 0.5, 0.3, 0.7, 0.2, 0.6), strict=True))


@pytest.fixture(scope="module")
def pra():
    return pytest.importorskip("pyroomacoustics", reason="needs pyroomacoustics (the extra `rooms`)")


needs_rooms = pytest.mark.usefixtures("pra")


def response(taps, frequencies):
    return np.exp(-2j * np.pi * np.outer(frequencies, np.arange(taps.size)) / FS) @ taps


def error_db(found, expected):
    return 20 * np.log10(np.abs(found - expected).max() / np.abs(expected).max())


@needs_rooms
@pytest.mark.parametrize(("share_of_fs", "limit_db"), [(0.3, -55), (0.4, -37)])
def test_free_field_is_the_closed_form(share_of_fs, limit_db):
    paths = room_paths(SIZE, **PLACES, absorption=1.0)
    emitters = np.array([SOURCE, *LOUDSPEAKERS])
    frequencies = np.linspace(0, share_of_fs * FS, 100)
    for k, microphone in enumerate(MICROPHONES):
        for i, taps in enumerate((*paths.primary[k], *paths.secondary[k])):
            r = np.linalg.norm(emitters[i] - microphone)
            expected = np.exp(-2j * np.pi * frequencies * r / C) / (4 * np.pi * r)
            assert error_db(response(taps, frequencies), expected) < limit_db


@needs_rooms
@pytest.mark.parametrize(
    ("distance_m", "share_of_fs", "limit_db"), [(0.03, 0.1, -35), (0.1, 0.3, -40), (0.2, 0.4, -30)]
)
def test_a_near_loudspeaker_is_causal_and_on_time(distance_m, share_of_fs, limit_db):
    # The fractional delays of pyroomacoustics would begin 40 samples before the sound.
    places = {**PLACES, "loudspeakers_m": np.add(MICROPHONES[0], [distance_m, 0, 0])}
    taps = room_paths(SIZE, **places, absorption=1.0).secondary[0, 0]
    frequencies = np.linspace(0, share_of_fs * FS, 50)
    expected = np.exp(-2j * np.pi * frequencies * distance_m / C) / (4 * np.pi * distance_m)
    assert error_db(response(taps, frequencies), expected) < limit_db
    assert np.argmax(np.abs(taps)) in (int(distance_m / C * FS), int(distance_m / C * FS) + 1)


def images_of(source, walls, highest):
    """Return positions (n, 3) and gains (n,) of all images by Allen and Berkley's formula."""
    beta = np.sqrt([1 - walls[name] for name in WALLS])
    positions, gains = [], []
    for order in itertools.product(range(-highest, highest + 1), repeat=3):
        for p in itertools.product((0, 1), repeat=3):
            rooms, mirrored = np.array(order), np.array(p)
            positions.append((1 - 2 * mirrored) * source + 2 * rooms * SIZE)
            gains.append(np.prod(beta[::2] ** np.abs(rooms - mirrored) * beta[1::2] ** np.abs(rooms)))
    return np.array(positions), np.array(gains)


@needs_rooms
def test_every_reflection_is_there_with_the_absorption_of_its_walls():
    n_taps = 600  # 12.9 m: within 4 pairs of reflections along the height of 2.5 m
    paths = room_paths(SIZE, **PLACES, absorption=UNEVEN, n_taps=n_taps)
    t = np.arange(n_taps)
    for emitter, column in ((SOURCE, paths.primary[:, 0]), (LOUDSPEAKERS[1], paths.secondary[:, 1])):
        positions, gains = images_of(np.array(emitter), UNEVEN, 4)
        for microphone, taps in zip(MICROPHONES, column, strict=True):
            r = np.linalg.norm(positions - microphone, axis=1)
            late = t - (r / C * FS)[:, np.newaxis]
            pulses = np.sinc(late) * np.cos(np.pi * late / 20) ** 2 * (np.abs(late) < 10)
            expected = gains / (4 * np.pi * r) @ pulses
            # pyroomacoustics holds positions and gains in single precision.
            np.testing.assert_allclose(taps, expected, atol=3e-5 * np.abs(expected).max())


@needs_rooms
@pytest.mark.parametrize("reverberation_time_s", [0.15, 0.25])
def test_the_decay_is_sabines_within_what_the_docstring_says(pra, reverberation_time_s):
    n_taps = int(1.3 * reverberation_time_s * 8000)
    paths = room_paths(SIZE, **PLACES, reverberation_time_s=reverberation_time_s, fs=8000.0, n_taps=n_taps)
    found = [pra.experimental.measure_rt60(taps, fs=8000, decay_db=30) for taps in paths.secondary.reshape(6, -1)]
    assert 0.8 < np.median(found) / reverberation_time_s < 1.5
    assert paths.reverberation_time_s == pytest.approx(reverberation_time_s)
    assert paths.decay_db == pytest.approx(-60 * 1.3, abs=0.1)


@needs_rooms
def test_speed_of_sound_and_sampling_rate_scale_the_arrivals():
    places = {**PLACES, "loudspeakers_m": LOUDSPEAKERS[0], "microphones_m": MICROPHONES[0]}
    r = np.linalg.norm(np.subtract(LOUDSPEAKERS[0], MICROPHONES[0]))
    for fs, c in ((2000.0, 343.0), (48000.0, 343.0), (16000.0, 331.3), (22050.5, 343.0)):
        taps = room_paths(SIZE, **places, absorption=1.0, fs=fs, n_taps=700, speed_of_sound=c).secondary[0, 0]
        np.testing.assert_allclose(group_delay(taps, [0.1 * fs, 0.3 * fs], fs=fs), r / c, atol=0.02 / fs)


@needs_rooms
def test_other_microphones_of_the_same_room():
    paths = room_paths(SIZE, **PLACES, absorption=UNEVEN, fs=8000.0, n_taps=200, speed_of_sound=340.0)
    again = paths.at(MICROPHONES[::-1])
    np.testing.assert_array_equal(again.primary, paths.primary[::-1])
    np.testing.assert_array_equal(again.secondary, paths.secondary[::-1])
    plane = horizontal_plane(SIZE, 1.25, spacing_m=1.0)
    mapped = paths.at(plane)
    assert mapped.secondary.shape == (20, 2, 200)
    np.testing.assert_array_equal(mapped.microphones_m.reshape(plane.shape), plane)


def test_horizontal_plane_fills_the_room():
    plane = horizontal_plane(SIZE, 1.2, spacing_m=0.3)
    assert plane.shape == (14, 17, 3)
    assert np.all(plane[..., 2] == 1.2)
    np.testing.assert_allclose(np.diff(plane[0, :, 0]), 5.0 / 17)
    np.testing.assert_allclose(plane[:, 0, 1].min(), 4.0 - plane[:, 0, 1].max())
    assert horizontal_plane([0.3, 0.3, 1.0], 0.5, spacing_m=0.1).shape == (3, 3, 3)
    for arguments, message in (
        (((0.0, 1.0, 1.0), 0.5), "size_m must be greater than 0"),
        ((SIZE, 2.5), "height_m must be below the ceiling at 2.5 m, got 2.5"),
        ((SIZE, 0.0), "height_m must be greater than 0"),
    ):
        with pytest.raises(ValueError, match=message):
            horizontal_plane(*arguments)
    with pytest.raises(ValueError, match="spacing_m must be greater than 0"):
        horizontal_plane(SIZE, 1.0, spacing_m=0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"size_m": [5.0, 4.0]}, r"size_m must be \(length, width, height\) in m, got shape \(2,\)"),
        ({"sources_m": [[1.0, 2.0]]}, r"sources_m must be x, y, z in m for each, shape \(n, 3\), got \(1, 2\)"),
        ({"loudspeakers_m": [[1, 1, 1], [5.5, 1, 1]]}, r"loudspeakers_m\[1\] = \[5.5, 1.0, 1.0\] m must lie inside"),
        ({"loudspeakers_m": [[1, 1, 1], [2, 1, 1], [1, 1, 1]]}, r"loudspeakers_m\[2\] .* same position as .*\[0\]"),
        ({"microphones_m": SOURCE}, r"microphones_m\[0\] must not be nearer to sources_m\[0\] than 0.0214 m"),
        (
            {"microphones_m": np.add(LOUDSPEAKERS[1], 0.01)},
            r"must not be nearer to loudspeakers_m\[1\] than .*0.0173 m",
        ),
        ({"n_taps": 100}, r"n_taps must be at least 185, .* from sources_m\[0\] to microphones_m\[1\] takes, got 100"),
        ({"absorption": None}, "give either reverberation_time_s or absorption"),
        ({"reverberation_time_s": 0.2}, "give either reverberation_time_s or absorption"),
        ({"absorption": None, "reverberation_time_s": 0.05}, "reverberation_time_s must be at least 0.0948 s"),
        ({"absorption": 0.0}, "absorption must be above 0 and at most 1, got 0 for the wall west"),
        ({"absorption": {**UNEVEN, "floor": 1.5}}, "got 1.5 for the wall floor"),
        ({"absorption": {"west": 0.5}}, "absorption must name the walls west, east, .*, got west"),
    ],
)
def test_rooms_refuse(changes, message):
    with pytest.raises(ValueError, match=message):
        room_paths(**{"size_m": SIZE, **PLACES, "absorption": 0.5, **changes})


def test_without_pyroomacoustics_the_error_says_what_to_install(uninstall):
    uninstall("pyroomacoustics")
    with pytest.raises(ImportError, match=r"pip install -e .\.\[rooms\]."):
        room_paths(SIZE, **PLACES, absorption=0.5)
