"""A sound card as an interface, through PortAudio."""

from __future__ import annotations

from collections.abc import Sequence
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

from .._validate import as_count, as_positive, optional_module
from .interfaces import Block
from .running import FaultError


class SoundDevice:
    """A sound card: microphones at some of its inputs, loudspeakers at some of its outputs.

    It needs the extra ``realtime`` (sounddevice, and the PortAudio library, which its wheels bring on Windows and
    macOS). It has been tested with JACK's dummy driver and a simulated plant, not on hardware.

    Parameters
    ----------
    reference_channels, error_channels : sequence of int
        Inputs of the reference and error microphones, counted from 0; ``[]`` stands for no reference microphone.
    output_channels : sequence of int, default (0,)
        Outputs of the loudspeakers. The other outputs up to the largest of them stay silent.
    fs : float
        Sample rate in Hz, one that the card has.
    block : int, default 64
        Samples of a block.
    device : int, str or pair of them, optional
        Device, or input and output device, as sounddevice names them (``python -m sounddevice`` lists them); by default
        the system's.
    latency : float or {"low", "high"}, default "low"
        What sounddevice is asked for. A run's `round_trip_samples` are what came of it.
    ahead : int, default 2
        Blocks of silence that are played first. The control signal is late by so many blocks, besides the delay of the
        device.

    Attributes
    ----------
    full_scale : float
        1, the largest value of a sample.
    patience_s : float
        Seconds without a block after which `read` gives the device up, 5 unless another is assigned.
    dry : int
        Blocks that came too late for the output: silence was played in their place.

    Raises
    ------
    ImportError
        sounddevice or the PortAudio library is missing.
    ValueError
        No error microphone or loudspeaker, a negative channel, or one that is both a reference and an error; at the
        start, a card that cannot be opened or started.

    Examples
    --------
    >>> from kfopc_filterpy.realtime import SoundDevice, run
    >>> card = SoundDevice([0], [1], fs=16000, block=32)  # doctest: +SKIP
    >>> run(lambda path: kf_pb(256, path.taps, rated_power=0.01), card, amplitude_limit=0.5, seconds=60)  # doctest: +SKIP
    """

    full_scale = 1.0
    patience_s = 5.0

    def __init__(
        self,
        reference_channels: Sequence[int],
        error_channels: Sequence[int],
        output_channels: Sequence[int] = (0,),
        *,
        fs: float,
        block: int = 64,
        device: int | str | tuple[int | str | None, int | str | None] | None = None,
        latency: float | str = "low",
        ahead: int = 2,
    ) -> None:
        self._references = _indices(reference_channels, "reference_channels") if len(reference_channels) else []
        self._errors = _indices(error_channels, "error_channels")
        self._outputs = _indices(output_channels, "output_channels")
        if set(self._references) & set(self._errors):
            raise ValueError("references and errors must be different inputs of the sound card")
        self.fs = as_positive(fs, "fs", unit="Hz")
        self.block = as_count(block, "block")
        self.device, self.latency = device, latency
        self.ahead = as_count(ahead, "ahead")
        self.n_references, self.n_microphones = len(self._references), len(self._errors)
        self.n_loudspeakers = len(self._outputs)
        self.dry = 0
        self._stream: Any = None

    def start(self) -> None:
        """Open the stream, with the silence that goes ahead."""
        try:
            sounddevice = optional_module("sounddevice", "realtime", "SoundDevice")
        except OSError as error:
            raise ImportError(
                f"sounddevice did not find the PortAudio library ({error}): install it, for example with "
                "'apt install libportaudio2'"
            ) from error
        self._heard: SimpleQueue[tuple[np.ndarray, bool]] = SimpleQueue()
        self._played: SimpleQueue[np.ndarray] = SimpleQueue()
        self._late = 0  # blocks that silence has replaced
        for _ in range(self.ahead):
            self._played.put(np.zeros((self.block, max(self._outputs) + 1), dtype=np.float32))
        # not `read` and `write` of PortAudio, which crash with JACK
        try:
            self._stream = sounddevice.Stream(
                samplerate=self.fs,
                blocksize=self.block,
                device=self.device,
                channels=(max(self._references + self._errors) + 1, max(self._outputs) + 1),
                dtype="float32",
                latency=self.latency,
                callback=self._exchange,
            )
            self._stream.start()
        except sounddevice.PortAudioError as error:
            raise ValueError(
                f"the sound card cannot be opened at {self.fs:g} Hz: {error}.{self._own_rate(sounddevice)} `python -m "
                "sounddevice` lists the devices and their channels"
            ) from error

    def _own_rate(self, sounddevice: Any) -> str:
        """Return the card's own sample rate as a sentence, nothing if it does not say."""
        device = self.device[0] if isinstance(self.device, tuple) else self.device
        try:
            rate = sounddevice.query_devices(device, "input")["default_samplerate"]
        except Exception:  # noqa: BLE001 - it has failed already, and the first error counts
            return ""
        return f" Its own rate is {rate:g} Hz."

    def _exchange(self, heard: np.ndarray, played: np.ndarray, frames: int, times: Any, status: Any) -> None:
        """Take a block and give one, on PortAudio's thread; where none is ready, silence."""
        self._heard.put((heard.copy(), bool(status.input_overflow)))
        try:
            played[:] = self._played.get_nowait()
            self.dry += bool(status.output_underflow)
        except Empty:
            played.fill(0.0)
            self._late += 1
            self.dry += 1

    def read(self) -> Block | None:
        """Return the next block; a block is counted as lost if the driver reports that the input overflowed."""
        try:
            heard, overflowed = self._heard.get(timeout=self.patience_s)
        except Empty:
            raise FaultError(
                f"no block came from the sound card for {self.patience_s:g} s: was it unplugged, or its server stopped?"
            ) from None
        signals = heard.T.astype(np.float64)
        return Block(signals[self._references], signals[self._errors], self.block if overflowed else 0)

    def write(self, control_signals: np.ndarray) -> None:
        """Play `control_signals`, (J, n_samples), those of a block; not if silence was played in its place already."""
        if self._late:
            self._late -= 1  # or all that follows would be late
            return
        frames = np.zeros((control_signals.shape[1], max(self._outputs) + 1), dtype=np.float32)
        frames[:, self._outputs] = control_signals.T
        self._played.put(frames)

    def stop(self) -> None:
        """Close the stream."""
        stream, self._stream = self._stream, None
        if stream is None:
            return
        try:
            stream.stop()
            stream.close()
        except Exception as error:
            raise FaultError(f"the sound card did not stop as it should: {error}; was it unplugged?") from error


def _indices(channels: Sequence[int], name: str) -> list[int]:
    """Return different channel numbers from 0."""
    numbers = list(channels)
    wanted = all(isinstance(n, int | np.integer) and n >= 0 for n in numbers)
    if not numbers or not wanted or len(set(numbers)) != len(numbers):
        raise ValueError(f"{name} must be one or more different channel numbers from 0, got {channels!r}")
    return [int(n) for n in numbers]
