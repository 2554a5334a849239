"""What holds for every controller of the package: the compiled loop and the steps from Python are one algorithm."""

from __future__ import annotations

import inspect
import pickle
from typing import Any

import numpy as np
import pytest
from helpers.comparing import assert_same_run, numbers_of
from helpers.loop import AMPLIFIERS, FEEDBACK, FS, MEMORY_S, MU, N_TAPS, P0, S_HAT, Q, R, run

import kfopc_filterpy
from kfopc_filterpy import (
    ClippingFxLMS,
    DiagonalKalman,
    FastArrayKalman,
    FxLMS,
    FxNLMS,
    LeakyFxLMS,
    MOVFxLMS,
    OptimalLeakyFxLMS,
    OutputLimiter,
    OutputPowerConstraint,
    RescalingFxLMS,
    TwoGradientFxLMS,
    fx_rls,
    kf_anc,
    kf_opc,
    kf_opc_repaired,
    kf_pb,
)

KALMAN: dict[str, Any] = {"state_noise": R, "measurement_noise": Q, "initial_variance": P0}


def constraint(**settings: Any) -> OutputPowerConstraint:
    return OutputPowerConstraint(0.3, **{"fs": FS, "memory_s": MEMORY_S} | settings)


MAKERS: dict[str, Any] = {
    "KF-ANC": lambda **o: kf_anc(N_TAPS, S_HAT, **KALMAN, **o),
    "KF-ANC, float32": lambda **o: kf_anc(N_TAPS, S_HAT, dtype=np.float32, **KALMAN, **o),
    "KF-OPC": lambda **o: kf_opc(N_TAPS, S_HAT, constraint=constraint(), **KALMAN, **o),
    "KF-OPC, sliding": lambda **o: kf_opc(N_TAPS, S_HAT, constraint=constraint(window="sliding"), **KALMAN, **o),
    "KF-OPC repaired": lambda **o: kf_opc_repaired(N_TAPS, S_HAT, constraint=constraint(), **KALMAN, **o),
    "KF-PB": lambda **o: kf_pb(N_TAPS, S_HAT, rated_power=0.3, fs=FS, memory_s=0.05, **KALMAN, **o),
    "fxRLS": lambda **o: fx_rls(N_TAPS, S_HAT, forgetting=0.999, **o),
    "diagonal KF": lambda **o: DiagonalKalman(N_TAPS, S_HAT, **KALMAN, **o),
    "diagonal KF-OPC": lambda **o: DiagonalKalman(N_TAPS, S_HAT, constraint=constraint(), **KALMAN, **o),
    "fast-array KF": lambda **o: FastArrayKalman(N_TAPS, S_HAT, measurement_noise=Q, **o),
    "fast-array KF-OPC": lambda **o: FastArrayKalman(N_TAPS, S_HAT, measurement_noise=Q, constraint=constraint(), **o),
    "finite-memory fast array": lambda **o: FastArrayKalman(N_TAPS, S_HAT, measurement_noise=Q, memory=2 * N_TAPS, **o),
    "FxLMS": lambda **o: FxLMS(N_TAPS, S_HAT, step_size=MU, **o),
    "FxNLMS": lambda **o: FxNLMS(N_TAPS, S_HAT, step_size=0.1, **o),
    "leaky": lambda **o: LeakyFxLMS(N_TAPS, S_HAT, step_size=MU, leak=0.3, **o),
    "optimal leaky": lambda **o: OptimalLeakyFxLMS(N_TAPS, S_HAT, step_size=MU, constraint=constraint(), **o),
    "MOV": lambda **o: MOVFxLMS(N_TAPS, S_HAT, step_size=MU, constraint=constraint(), **o),
    "MOV, modified": lambda **o: MOVFxLMS(N_TAPS, S_HAT, step_size=MU, constraint=constraint(), modified=True, **o),
    "two-gradient": lambda **o: TwoGradientFxLMS(N_TAPS, S_HAT, step_size=MU, amplitude_limit=0.5, **o),
    "re-scaling": lambda **o: RescalingFxLMS(N_TAPS, S_HAT, step_size=MU, amplitude_limit=0.5, **o),
    "clipping": lambda **o: ClippingFxLMS(N_TAPS, S_HAT, step_size=MU, amplitude_limit=0.5, **o),
}
KNOWS_AN_AMPLIFIER = [
    name
    for name in MAKERS
    if not name.startswith(("FxLMS", "FxNLMS", "leaky", "two-gradient", "re-scaling", "clipping"))
]
VARIANTS = [(name, "plain") for name in MAKERS]
# The limiter acts on what they emit, alike for all; these adapt to it in different ways. Each is compiled anew for it.
LIMITED = ("KF-ANC", "KF-OPC", "KF-OPC repaired", "KF-PB", "FxLMS", "MOV", "two-gradient", "re-scaling", "clipping")
VARIANTS += [(name, "limiter") for name in LIMITED]
VARIANTS += [(name, "known amplifier") for name in KNOWS_AN_AMPLIFIER]


def made(name: str, variant: str) -> Any:
    options: dict[str, Any] = {}
    if variant == "limiter":
        options["limiter"] = OutputLimiter(0.05, fs=FS, window_s=0.01)
    if variant == "known amplifier":
        options["amplifier"] = AMPLIFIERS["soft"][0]
    return MAKERS[name](**options)


@pytest.mark.parametrize(("name", "variant"), VARIANTS)
def test_compiled_run_is_the_steps_bit_for_bit(name: str, variant: str) -> None:
    fast, slow = made(name, variant), made(name, variant)
    scene = {"amplifier": AMPLIFIERS["soft"][0], "feedback": FEEDBACK, "on": 17, "n": 300}
    result = run(fast, **scene)
    assert_same_run(result, run(slow, compiled=False, **scene))
    np.testing.assert_array_equal(fast.weights, slow.weights)
    for mine, theirs in zip(numbers_of(fast.constraint.state), numbers_of(slow.constraint.state), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    if variant == "limiter":
        assert pickle.dumps(fast.limiter) == pickle.dumps(slow.limiter)
        assert fast.limiter.gain < 1.0  # it did act
    assert np.any(np.abs(np.diff(result.weights, axis=0)) > 0)
    assert_same_run(run(fast, n=50), run(slow, n=50, compiled=False))  # and they go on alike
    assert_same_run(run(fast, n=50, compiled=False), run(slow, n=50))


@pytest.mark.parametrize("name", MAKERS)
def test_repr_names_the_algorithm_and_its_settings(name: str) -> None:
    controller, limited = made(name, "plain"), made(name, "limiter")
    run(controller, n=50)
    rated = "" if controller.rated_power is None else ", rated power 0.3"
    expected = f"<{controller.name}: {N_TAPS} taps{rated}, constraint factor {controller.constraint_factor:.3g}"
    assert repr(controller) == f"{expected}>"
    assert repr(limited).endswith(", limiter of rated power 0.05>")


def test_repr_of_kf_opc() -> None:
    controller = kf_opc(128, S_HAT, rated_power=1.0, **KALMAN)
    controller.estimator.constraint_factor = 0.70711
    assert repr(controller) == "<KF-OPC: 128 taps, rated power 1, constraint factor 0.707>"
    controller.limiter = OutputLimiter(2.5)
    controller.estimator.rated_power = None
    assert repr(controller) == "<KF-OPC: 128 taps, constraint factor 1, limiter of rated power 2.5>"


def test_no_controller_is_left_out() -> None:
    """Whatever the package offers with n_taps and a secondary path is made above."""
    source = inspect.getsource(inspect.getmodule(made))
    for name in kfopc_filterpy.__all__:
        offered = getattr(kfopc_filterpy, name)
        if inspect.ismodule(offered) or not callable(offered):
            continue
        if list(inspect.signature(offered).parameters)[:2] == ["n_taps", "secondary_path"]:
            assert f"{name}(" in source, name
