"""Checks of recordings and impulse responses, with messages that name the files or arguments."""

from __future__ import annotations

import numpy as np


def require_different(disturbance: str, heard: np.ndarray, noise: str, reference: np.ndarray) -> None:
    """Raise ValueError if a channel of the disturbance, (n_channels, n_samples), is one of the noise."""
    for k, i in np.ndindex(len(heard), len(reference)):
        if np.array_equal(heard[k], reference[i]):
            if len(heard) == len(reference) == 1:
                raise ValueError(
                    f"{noise} and {disturbance} are the same signal: give the error microphone's recording"
                )
            raise ValueError(
                f"channel {k} of {disturbance} is channel {i} of {noise}, sample for sample: is it the error microphone? "
                "Name its channel, as in recording.wav:1"
            )


def require_each_microphone(name: str, heard: np.ndarray, n_microphones: int, secondary: str) -> None:
    """Raise ValueError unless a recording, (n_channels, n_samples), has a channel for each microphone of the paths."""
    if len(heard) != n_microphones:
        raise ValueError(
            f"{name} must have a channel for each of the {n_microphones} microphone(s) of {secondary}, got {len(heard)}: "
            "record all microphones together, or choose one, as in recording.wav:0"
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
