"""Compile what the studies run before the first of them, on two cores: in one process numba compiles one function at a
time. Only where nothing is on disk yet.
"""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
from filterpy.kalman import KalmanFilter

from kfopc_filterpy import HardClipAmplifier, KalmanController, kf_opc, simulate, simulate_scenarios
from kfopc_filterpy.kernels.block import STEPS, Block
from kfopc_filterpy.kernels.compiling import on_disk
from kfopc_filterpy.kernels.covariance import new_covariance
from kfopc_filterpy.loop.lockstep import run_block

REFERENCE = np.ones(100)
PATH = [0.0, 1.0]
IN_ANOTHER = f"from {__name__} import stepped, together; together('block'); stepped()"


def _controller() -> KalmanController:
    return kf_opc(8, PATH, rated_power=1.0, state_noise=1e-8, measurement_noise=1e-2)


def alone() -> None:
    """One run of one controller: of any that the paper compares, they are one type to the compiler."""
    simulate(_controller(), REFERENCE, disturbance=REFERENCE, secondary_path=PATH)


def together(kernel: str = "pairs") -> None:
    """One run of controllers that share their gains."""
    simulate_scenarios([_controller()], REFERENCE, disturbance=REFERENCE, secondary_path=PATH, kernel=kernel)


def shared_gains() -> None:
    """The gains of `together` alone."""
    Block(8, STEPS).advance_in_pairs(new_covariance(np.eye(8)), 1e-8, 1e-2)


def stepped() -> None:
    """One run of a controller whose filter is filterpy's own, step by step, through an amplifier."""
    estimator = KalmanFilter(dim_x=8, dim_z=1)
    clipped = HardClipAmplifier(1.0)
    simulate(
        KalmanController(estimator, PATH), REFERENCE, disturbance=REFERENCE, secondary_path=PATH, amplifier=clipped
    )


def compile_ahead() -> None:
    """Have all compiled, part of it in another process, which is over before this one looks for that on disk.

    The gains by BLAS have next to nothing to compile. Where the other process fails, this one compiles all.
    """
    if on_disk(run_block):
        return
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(entry or os.getcwd() for entry in sys.path)}
    with subprocess.Popen([sys.executable, "-c", IN_ANOTHER], env=environment, stderr=subprocess.DEVNULL):
        alone()
        shared_gains()
    together()
    stepped()
