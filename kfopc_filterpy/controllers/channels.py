"""The channels of a built-in controller: what its signals and paths must be, numbers with one channel, arrays with several."""

from __future__ import annotations

from typing import Any

import numpy as np

from .._validate import as_count, as_number
from ..paths.path_matrix import is_path_matrix, secondary_paths, single_path
from .base import require_rates
from .channel_samples import channel_sample
from .processing import takes_none


class Channels:
    """Checks of samples, blocks and paths by the numbers of channels, which `_read_paths` sets."""

    n_references: int
    n_microphones: int
    n_loudspeakers: int
    multichannel: bool
    _path_fs: float | None

    def _read_paths(self, paths: Any, n_references: int | None, multichannel: bool | None) -> np.ndarray:
        """Set the numbers of channels and return the taps of the secondary path."""
        several = is_path_matrix(paths)
        if several and n_references is None:
            raise ValueError(
                f"{type(self).__name__} takes one channel: secondary_path must be one-dimensional, (taps,), or a system "
                "of one input and one output. Controllers with the setting n_references take several channels, for "
                "example kf_anc, kf_opc, kf_pb and FxLMS"
            )
        self.n_references = 1 if n_references is None else as_count(n_references, "n_references")
        self.multichannel = several or self.n_references > 1 if multichannel is None else multichannel
        self.n_microphones, self.n_loudspeakers = 1, 1
        secondary, self._path_fs = self._taps_and_rate(paths)
        if self.multichannel:
            self.n_microphones, self.n_loudspeakers, _ = secondary.shape
        return secondary

    def _taps_and_rate(self, paths: Any) -> tuple[np.ndarray, float | None]:
        """Return secondary paths as taps, (K, J, taps) or (taps,), and their sampling rate in Hz if systems tell it."""
        taps, rate = secondary_paths(paths) if self.multichannel else single_path(paths, "secondary_path")
        if not taps.any():
            raise ValueError(
                "secondary_path must not be all zeros: nothing that the loudspeaker plays would be heard, so there is "
                "nothing to adapt to; identify the path, see paths.identify_secondary_path"
            )
        return taps, rate

    def _sample(self, value: Any, name: str, what: str) -> Any:
        """Return a checked sample: a number, or with several channels an array of them; `what` names the channels."""
        if what == "references" and takes_none(self, value):
            return np.empty(0)
        if self.multichannel:
            return channel_sample(value, getattr(self, f"n_{what}"), name, what)
        return as_number(value, name)

    def _checked_estimate(self, path: Any, present: tuple[int, ...]) -> np.ndarray:
        """Return the taps of a new secondary path, filled with zeros to the shape of the present one."""
        taps, rate = self._taps_and_rate(path)
        if taps.shape[:-1] != present[:-1]:
            raise ValueError(
                f"secondary_path must have the channels (microphones, loudspeakers) = {present[:-1]} of the present "
                f"estimate, got {taps.shape[:-1]}: make a new controller for other channels"
            )
        if taps.shape[-1] > present[-1]:
            raise ValueError(
                f"secondary_path must have at most the {present[-1]} taps of the present estimate, got "
                f"{taps.shape[-1]}: make the controller with an estimate filled with zeros to the longest path"
            )
        if self._path_fs is not None:
            require_rates(self._path_fs, {"new secondary path": rate})
        return np.pad(taps, [(0, 0)] * (taps.ndim - 1) + [(0, present[-1] - taps.shape[-1])])
