"""Four controllers with a short scene for each, and a user's own controller."""

import numpy as np

from kfopc_filterpy import OutputPowerConstraint, Plant, fx_lms, kf_anc, kf_opc, mov_fx_lms

FS = 16000
S = np.array([0.0, 0.9, -0.4])
PLANT = Plant(S, fs=FS)  # without a primary path: the disturbance is given
MAKERS = {
    "KF-ANC": lambda s=S, **options: kf_anc(6, s, **{"state_noise": 1e-6, "measurement_noise": 0.01} | options),
    "KF-OPC": lambda s=S, **options: kf_opc(
        6, s, **rated(options) | {"state_noise": 1e-6, "measurement_noise": 0.01} | options
    ),
    "FxLMS": lambda s=S, **options: fx_lms(6, s, **{"step_size": 0.01} | options),
    "MOV-FxLMS": lambda s=S, **options: mov_fx_lms(6, s, **rated(options) | {"step_size": 0.01} | options),
}


def rated(options):
    """The rated power, unless the options have a constraint."""
    return {} if "constraint" in options else {"rated_power": 0.2, "fs": FS}


def constraint(**settings):
    """A constraint of the same rated power with settings of its own."""
    return OutputPowerConstraint(0.2, **{"fs": FS} | settings)


def noises(n=300, seed=0):
    """Reference, and a disturbance that a control filter explains in part."""
    x, other = np.random.default_rng(seed).standard_normal((2, n))
    return x, np.convolve(x, [0.0, 0.0, 1.0, 0.5])[:n] + 0.1 * other


X, D = noises()


class Integrator:
    """A user's own controller: two methods, nothing else."""

    def __init__(self):
        self.gain, self.x = 0.0, 0.0

    def control_signal(self, reference):
        self.x = reference
        return self.gain * reference

    def update(self, error):
        self.gain += 0.05 * error * self.x


class Playing:
    """A user's own controller that plays what a function makes of the reference, and does not adapt."""

    def __init__(self, play):
        self.control_signal = play

    def update(self, error):
        pass


class Stepwise:
    """A controller whose two methods Python calls for each sample: the loop cannot see that it is one of the core."""

    def __init__(self, controller):
        self.controller = controller

    def __getattr__(self, name):
        if name.startswith("__") or name == "controller":
            raise AttributeError(name)
        return getattr(self.controller, name)

    def control_signal(self, reference):
        return self.controller.control_signal(reference)

    def update(self, error):
        self.controller.update(error)
