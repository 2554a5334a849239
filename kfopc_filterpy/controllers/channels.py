"""The channels of a built-in controller: numbers with one channel, arrays with several."""

from __future__ import annotations

from typing import Any

import numpy as np

from .._taps import lengthened
from .._validate import as_count, as_number, same_rate
from ..plant import estimated_secondary
from .channel_samples import channel_sample
from .processing import takes_none


class Channels:
    """Checks of samples, blocks and paths by the numbers of channels, which `_read_paths` sets."""

    n_references: int
    n_microphones: int
    n_loudspeakers: int
    _path_fs: float | None  # sample rate in Hz of the secondary path; None for taps

    @property
    def multichannel(self) -> bool:
        """Whether signals have a channel axis: there are several references, microphones or loudspeakers."""
        return max(self.n_references, self.n_microphones, self.n_loudspeakers) > 1

    def _read_paths(self, secondary: Any, n_references: int | None) -> np.ndarray:
        """Set the numbers of channels and return the taps of the secondary paths, (K, J, n_taps)."""
        taps, self._path_fs = self._taps_and_rate(secondary)
        self.n_microphones, self.n_loudspeakers, _ = taps.shape
        self.n_references = 1 if n_references is None else as_count(n_references, "n_references")
        if n_references is None and self.multichannel:
            raise ValueError(
                f"this controller takes one channel: secondary must be one path, (n_taps,), got {taps.shape}. Controllers "
                "with the setting n_references take several channels, for example kf_anc, kf_opc, kf_pb and fx_lms"
            )
        return taps

    def _taps_and_rate(self, secondary: Any) -> tuple[np.ndarray, float | None]:
        """Return secondary paths as taps, (K, J, n_taps), and their sample rate in Hz if they tell it."""
        taps, rate = estimated_secondary(secondary)
        if not taps.any():
            raise ValueError(
                "secondary must not be all zeros: nothing that the loudspeaker plays would be heard, so there is "
                "nothing to adapt to; identify the path, see paths.identify_secondary_path"
            )
        return taps, rate

    def _sample(self, value: Any, name: str, what: str) -> Any:
        """Return a checked sample: a number, or with several channels an array of them; `what` names the channels."""
        if what == "references" and takes_none(self, value):
            return np.empty(0)
        if self.multichannel:
            return channel_sample(value, getattr(self, f"n_{what}"), name, what)
        return as_number(value[0] if np.shape(value) == (1,) else value, name)

    def _checked_estimate(self, secondary: Any, present: tuple[int, ...]) -> np.ndarray:
        """Return the taps of a new secondary path, filled with zeros to the shape of the present one."""
        taps, rate = self._taps_and_rate(secondary)
        channels = (self.n_microphones, self.n_loudspeakers)
        if taps.shape[:-1] != channels:
            raise ValueError(
                f"secondary must have the channels (microphones, loudspeakers) = {channels} of the present estimate, got "
                f"{taps.shape[:-1]}: make a new controller for other channels"
            )
        if taps.shape[-1] > present[-1]:
            raise ValueError(
                f"secondary must have at most the {present[-1]} taps of the present estimate, got {taps.shape[-1]}: make "
                "the controller with an estimate filled with zeros to the longest path"
            )
        if self._path_fs is not None and rate is not None and not same_rate(rate, self._path_fs):
            raise ValueError(
                f"the new secondary path is for {rate:g} Hz, but the controller for {self._path_fs:g} Hz; resample it "
                "(resample_path)"
            )
        return lengthened(taps, present[-1]).reshape(present)
