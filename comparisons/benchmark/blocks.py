"""Entries that process whole blocks: the base class, and commands that exchange blocks on stdin and stdout."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import tempfile
import time
from abc import ABC, abstractmethod
from contextlib import suppress
from threading import Timer
from typing import IO, Any, Self

import numpy as np

from .tasks import Task

TIMEOUT_S = 120.0  # of a run
MOST_SAID = 10_000  # bytes of complaints that are read
FLOAT = np.dtype("<f8")


class PlaysBlocks(ABC):
    """A controller that hears a block and then computes the control signals that are played during the next one.

    That is the delay with which a task's secondary path begins; see `Task.run`.
    """

    plays_blocks = True

    def __init__(self, task: Task) -> None:
        self._several = task.secondary.ndim == 3
        s = task.secondary if self._several else task.secondary.reshape(1, 1, -1)
        self.n_microphones, self.n_loudspeakers, _ = s.shape
        self.n_references = len(task.references[0]) if self._several else 1
        self._heard = np.zeros((self.n_references + self.n_microphones, task.block))
        self._playing = np.zeros((self.n_loudspeakers, task.block))
        self._n = 0

    @abstractmethod
    def exchange(self, references: np.ndarray, errors: np.ndarray) -> np.ndarray:
        """Return the control signals (J, block) for the references (I, block), and adapt to the errors (K, block)."""

    def control_signal(self, reference: Any) -> Any:
        """Return the current sample of the block that is being played, and store the reference."""
        self._heard[: self.n_references, self._n] = reference
        y = self._playing[:, self._n]
        return y.copy() if self._several else float(y[0])

    def update(self, error: Any) -> None:
        """Store the error, and exchange the block if it is full."""
        self._heard[self.n_references :, self._n] = error
        self._n += 1
        if self._n == self._heard.shape[1]:
            self._n = 0
            self._playing = self.exchange(self._heard[: self.n_references], self._heard[self.n_references :])


class EntryFailed(RuntimeError):
    """A command ended early, took too long, or gave an answer that is no block of finite numbers."""


class CommandController(PlaysBlocks):
    """A command that computes the control signals: a line of JSON to its stdin, then blocks both ways.

    Use it in a ``with`` statement, which ends the command.
    """

    def __init__(self, task: Task, command: str, timeout_s: float = TIMEOUT_S) -> None:
        super().__init__(task)
        s = task.known_secondary
        header = {
            "fs": task.fs,
            "block": task.block,
            "n_taps": task.n_taps,
            "references": self.n_references,
            "loudspeakers": self.n_loudspeakers,
            "microphones": self.n_microphones,
            "rated_power": np.broadcast_to(task.rated_power, self.n_loudspeakers).tolist(),
            "secondary_path": (s if self._several else s.reshape(1, 1, -1)).tolist(),
        }
        self._blocks, self._timed_out, self._timeout_s = 0, False, timeout_s
        self._began, self.first_answer_s = time.perf_counter(), 0.0
        self._complaints = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the command
        try:
            self._process = subprocess.Popen(
                shlex.split(command),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._complaints,
                start_new_session=True,  # what it starts ends with it
            )
        except OSError as error:
            self._complaints.close()
            raise EntryFailed(f"cannot be started: {error}") from None
        self._timer = Timer(timeout_s, self._give_up)
        self._timer.start()
        # Written before the first block: a failure there ends the command and its timer.
        self._unsent = json.dumps(header).encode() + b"\n"

    def exchange(self, references: np.ndarray, errors: np.ndarray) -> np.ndarray:
        """Return the command's answer to a block."""
        taken = self._write(self._unsent + np.concatenate((references, errors)).astype(FLOAT).tobytes())
        self._unsent = b""
        asked = FLOAT.itemsize * self._playing.size
        answer = self._stdout.read(asked)
        if len(answer) < asked:
            raise self._failure(f"answered {len(answer)} of {asked} bytes")
        if not taken:
            raise self._failure("took no input")
        y = np.frombuffer(answer, FLOAT).reshape(self._playing.shape)
        if not np.isfinite(y).all():
            raise EntryFailed(f"answered NaN or Inf in block {self._blocks}")
        self._blocks += 1
        if self._blocks == 1:
            self.first_answer_s = time.perf_counter() - self._began
        return y

    def __enter__(self) -> Self:
        """Return the controller."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """End the command, by the end of its input or, after a failure, by force."""
        try:
            if kind is None:
                with suppress(OSError):
                    self._stdin.close()
                if self._stdout.read(1):
                    raise EntryFailed("answered more than it was asked for")
        finally:
            self._timer.cancel()
            self._kill()
            self._process.wait()
            for file in (self._stdin, self._stdout, self._complaints):
                with suppress(OSError):
                    file.close()

    @property
    def _stdin(self) -> IO[bytes]:
        assert self._process.stdin is not None
        return self._process.stdin

    @property
    def _stdout(self) -> IO[bytes]:
        assert self._process.stdout is not None
        return self._process.stdout

    def _give_up(self) -> None:
        self._timed_out = True
        self._kill()

    def _kill(self) -> None:
        """End the command and what it has started."""
        if os.name == "nt":
            self._process.kill()
            return
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)

    def _write(self, content: bytes) -> bool:
        """Return whether the command takes input; one that has ended tells more by what it answered."""
        try:
            self._stdin.write(content)
            self._stdin.flush()
        except OSError:
            return False
        return True

    def _failure(self, what: str) -> EntryFailed:
        """Return why the command failed. Its output has ended; it ends too, or is ended when its time is over."""
        status = self._process.wait()
        if self._timed_out:
            return EntryFailed(f"took longer than {self._timeout_s:g} s for a run")
        self._complaints.seek(max(self._complaints.seek(0, os.SEEK_END) - MOST_SAID, 0))
        lines = self._complaints.read().decode(errors="replace").strip().splitlines()
        return EntryFailed(
            f"{what} in block {self._blocks} and ended with status {status}" + (f": {lines[-1]}" if lines else "")
        )
