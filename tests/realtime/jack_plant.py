"""A duct behind JACK: a client whose outputs are reference and error, and whose input is the control signal."""

from __future__ import annotations

import sys

import numpy as np
from scipy.signal import lfilter

PRIMARY = np.zeros(320)
PRIMARY[[310, 314]] = 1.0, 0.4  # longer than the round trip through JACK's buffers
SECONDARY = np.array([0.0, 0.9, 0.3])


def main() -> None:
    """Play until the standard input is closed."""
    import jack

    client = jack.Client("plant")
    rng = np.random.default_rng(0)
    states = {"primary": np.zeros(PRIMARY.size - 1), "secondary": np.zeros(SECONDARY.size - 1)}
    outputs = [client.outports.register(name) for name in ("reference", "error")]
    control = client.inports.register("control")

    @client.set_process_callback
    def process(frames: int) -> None:
        x = 0.1 * rng.standard_normal(frames)
        d, states["primary"] = lfilter(PRIMARY, 1.0, x, zi=states["primary"])
        a, states["secondary"] = lfilter(SECONDARY, 1.0, control.get_array(), zi=states["secondary"])
        for port, signal in zip(outputs, (x, d - a), strict=True):
            port.get_array()[:] = signal

    with client:
        print("ready", flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main()
