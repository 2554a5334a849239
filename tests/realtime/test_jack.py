"""`kfopc run` through PortAudio and JACK's dummy driver, in real time."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

FS, BLOCK, SECONDS, STALLED_S, TRIES = 16000, 64, 12, 0.2, 3
RUN = (
    *("-m", "kfopc_filterpy", "run", "--device", "plant", "--references", "0", "--errors", "1", "--outputs", "0"),
    *("--rated-power", "0.02", "--amplitude-limit", "0.6", "--taps", "128", "--fs", str(FS), "--block", str(BLOCK)),
    *("--seconds", str(SECONDS)),
)


@pytest.fixture
def plant() -> Iterator[None]:
    """JACK with its dummy driver, and a duct behind it."""
    if shutil.which("jackd") is None:
        pytest.skip("needs JACK: apt-get install jackd2 libportaudio2")
    for package in ("sounddevice", "jack"):
        pytest.importorskip(package, reason="needs sounddevice and JACK-Client", exc_type=ImportError)
    command = ["jackd", "-R", "-d", "dummy", "-r", str(FS), "-p", str(BLOCK)]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(command, **quiet) as server:
        time.sleep(2.0)
        duct = [sys.executable, str(Path(__file__).with_name("jack_plant.py"))]
        with subprocess.Popen(duct, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as client:
            if client.stdout.readline() != "ready\n":
                server.terminate()
                pytest.skip("JACK does not start on this machine")
            yield
            client.stdin.close()
        server.terminate()


@pytest.mark.slow
def test_control_goes_on_after_blocks_were_lost(plant: None) -> None:
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "env": environment}
    for _ in range(TRIES):
        with subprocess.Popen([sys.executable, *RUN], **pipes) as run:
            said = run.stdout.readline()
            if "reduction" in said:  # the first report, after 5 s of control
                run.send_signal(signal.SIGSTOP)
                time.sleep(STALLED_S)
                run.send_signal(signal.SIGCONT)
            said += run.stdout.read()
        if run.wait() == 0:
            break
    else:
        assert re.search(r"(lost|ran dry).* while the path was identified", said), said
        pytest.skip(f"this machine is too busy: {said.strip()}")
    print(said)
    lost, late = map(int, re.search(r"(\d+) samples lost, (\d+) blocks too late", said).groups())
    assert lost + late * BLOCK >= 0.5 * STALLED_S * FS  # they are counted
    assert float(re.search(r"noise reduction (-?[\d.]+) dB over the second half", said)[1]) > 3.0
    assert f"{SECONDS}" in re.search(r"([\d.]+) s under control, as asked for", said)[1]
