"""Checks of files that are to go together: impulse responses with a noise, recordings with each other."""

from __future__ import annotations

import numpy as np

LONG_PATH_S = 5.0  # hardly any impulse response is longer
LONGEST_PATH_S, MOST_TAPS = 10.0, 65536  # of an impulse response


def require_shorter(path: str, n_taps: int, noise: str, n_samples: int, fs: float) -> None:
    """Raise ValueError if an impulse response is not shorter than the noise, or too long for any.

    `path` and `noise` are the names of the files.
    """
    if n_taps < n_samples and n_taps <= min(LONGEST_PATH_S * fs, MOST_TAPS):
        return
    raise ValueError(
        f"{path} has {n_taps} samples ({n_taps / fs:.3g} s), {noise} {n_samples} ({n_samples / fs:.3g} s): an impulse "
        f"response must be shorter than the noise, and at most {LONGEST_PATH_S:g} s and {MOST_TAPS} taps long; cut the "
        "impulse response, or are the files swapped?"
    )


def require_same_length(disturbance: str, n_samples: int, noise: str, expected: int) -> None:
    """Raise ValueError if two recordings that were made together differ in length; they are named by their files."""
    if n_samples != expected:
        raise ValueError(
            f"{disturbance} has {n_samples} samples, {noise} {expected}: they must be recorded together and be equally "
            f"long; cut both to the same start and the same end"
        )


def require_different(disturbance: str, heard: np.ndarray, noise: str, reference: np.ndarray) -> None:
    """Raise ValueError if a channel of the disturbance, (n_channels, n_samples), is one of the noise, sample for sample."""
    for k, i in np.ndindex(len(heard), len(reference)):
        if np.array_equal(heard[k], reference[i]):
            raise ValueError(
                f"channel {k} of {disturbance} is channel {i} of {noise}, sample for sample: is it the error microphone? "
                "Name its channel, as in recording.wav:1"
            )


def require_heard(name: str, channels: np.ndarray) -> None:
    """Raise ValueError if a channel of a recording, (n_channels, n_samples), is constant."""
    for number, channel in enumerate(channels):
        if np.all(channel == channel[0]):
            which = name if len(channels) == 1 else f"{name}[{number}]"
            raise ValueError(f"{which} must not be silent: every value is the same")


def require_sound(name: str, paths: np.ndarray) -> None:
    """Raise ValueError if paths, (microphones, sources, taps), leave a microphone silent."""
    for k in np.flatnonzero(~np.any(paths, axis=(1, 2))):
        which, mend = name, "record it again"
        if len(paths) > 1:
            which, mend = f"{name}[{k}]", "leave out a microphone that is not reached"
        raise ValueError(f"{which} must not be silent: every value is 0; {mend}")
