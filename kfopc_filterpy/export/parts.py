"""What an exported controller consists of: its settings, its present state and the C fragments of its algorithm."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ..controllers.base import FilteredReferenceController
from ..controllers.diagonal import DiagonalState
from ..controllers.fxlms import FxLMSState
from ..controllers.kalman import KalmanState
from ..controllers.mov import MOVState
from ..controllers.step import Lines
from ..kernels.covariance import CANCELLATION, covariance_matrix
from ..kernels.delay_lines import newest
from ..power.amplifiers import LINEAR
from ..power.constraint import DISTURBANCE, FILTERED_REFERENCE, REFERENCE, ConstraintState
from ..power.limiter import FLOOR, OVERSHOOT, RESERVE, LimiterState

EXPORTED = (
    "export_c takes FxLMS, MOVFxLMS, DiagonalKalman, kf_anc and kf_opc: one channel, exponential power estimates, with or "
    "without a limiter; no amplifier model, no secondary_path_uncertainty, no fading memory, no wrapper"
)
LARGEST_MARGIN = 0.01  # of the rated power, which the limiter keeps free for rounding


class Value(NamedTuple):
    """A number (an int is stored as int32_t), an array, or a dict of values, which becomes a struct of its own."""

    value: Any
    comment: str = ""
    size: str = ""  # of an array, as the C code writes it


Values = dict[str, Value]


@dataclass
class Part:
    """A part of a controller: a fragment of C, and what it needs."""

    fragment: str
    sizes: Values = field(default_factory=dict)  # macros of the header
    settings: Values = field(default_factory=dict)  # constants of the source
    fields: Values = field(default_factory=dict)  # of the state
    flags: set[str] = field(default_factory=set)  # what `#if` in the fragments asks for
    operations: int = 0  # floating-point additions, multiplications, divisions and roots of a sample
    rare_operations: int = 0  # those that some samples have in addition


def parts_of(controller: Any, dtype: np.dtype) -> list[Part]:
    """Return the parts of a controller, or raise an error that says why it cannot be exported."""
    state = _exportable_state(controller)
    algorithm = ALGORITHMS[type(state)](state, dtype)
    parts = [_signals(state.lines, state.weights, "OUTPUT" in algorithm.flags)]
    if "POWERS" in algorithm.flags:
        parts.append(_powers(state.constraint, dtype))
    if state.lines.limiter is not None:
        parts.append(_limiter(state.lines.limiter, dtype))
    return [*parts, algorithm]


def _exportable_state(controller: Any) -> Any:
    """Return a copy of a controller's state, or raise an error if it has parts that are not exported."""
    name = getattr(controller, "name", type(controller).__name__)
    if not isinstance(controller, FilteredReferenceController):
        raise TypeError(f"{name} ({type(controller).__name__}) cannot be exported: {EXPORTED}")
    if controller.multichannel:
        raise ValueError(f"{name} has several channels and cannot be exported: {EXPORTED}")
    state = deepcopy(controller).compiled_state()
    if type(state) not in ALGORITHMS:
        raise TypeError(f"{name} ({type(controller).__name__}) cannot be exported: {EXPORTED}")
    factor_is_fixed = not math.isnan(state.constraint.numbers["supplied_factor"][0])
    obstacles = {
        "an amplifier model": state.lines.amplifier["kind"][0] != LINEAR,
        "a secondary_path_uncertainty": state.lines.guard is not None,
        "power estimates over a sliding window": state.constraint.window.shape[1] > 0,
        "a fading memory": isinstance(state, KalmanState) and state.numbers["alpha_sq"][0] != 1.0,
        "a penalty from a fixed constraint factor": isinstance(state, MOVState)
        and math.isnan(state.penalty)
        and factor_is_fixed,
    }
    found = [what for what, there in obstacles.items() if there]
    if found:
        raise ValueError(f"{name} has {' and '.join(found)} and cannot be exported: {EXPORTED}")
    return state


def _delay_line(line: np.ndarray, taps: int) -> np.ndarray:
    """Return the newest samples of a delay line, twice, as the C code keeps them."""
    return np.tile(newest(line, taps), 2)


def _signals(lines: Lines, weights: np.ndarray, output: bool) -> Part:
    n_taps, n_path = weights.size, lines.secondary_estimate.size
    longest = max(n_taps, n_path)
    fields = {
        "weights": Value(weights, "control filter w, newest-sample tap first", "ANC_TAPS"),
        "reference": Value(_delay_line(lines.reference, longest), "delay line of x", "2 * ANC_REFERENCE_TAPS"),
        "filtered": Value(_delay_line(lines.filtered, n_taps), "delay line of x' = s^ * x", "2 * ANC_TAPS"),
    }
    starts = {"reference_start": Value(0, "where the delay lines begin"), "filtered_start": Value(0)}
    if output:
        fields["output"] = Value(_delay_line(lines.output, n_path), "delay line of y", "2 * ANC_PATH_TAPS")
        starts["output_start"] = Value(0)
    return Part(
        "signals",
        sizes={
            "TAPS": Value(n_taps, "of the control filter"),
            "PATH_TAPS": Value(n_path, "of the secondary path"),
            "REFERENCE_TAPS": Value(longest, "samples of the reference that are stored"),
        },
        settings={"secondary_path": Value(lines.secondary_estimate, "s^, estimated", "ANC_PATH_TAPS")},
        fields=fields | starts | {"fault": Value(0, "of this sample's reference, or of the control signal")},
        operations=2 * n_taps + 2 * n_path + 3,
    )


def _powers(constraint: ConstraintState, dtype: np.dtype) -> Part:
    """Return the running powers and the constraint factor."""
    numbers, means = constraint.numbers, constraint.powers["mean_square"]
    power, gain = float(numbers["supplied_power"][0]), float(numbers["supplied_gain"][0])
    estimated_power, estimated_gain = math.isnan(power), math.isnan(gain)
    rate, last_gain = float(numbers["rate"][0]), float(numbers["gain"][0])
    memory = math.ceil(1.0 / rate)
    fields = {
        "disturbance": Value(float(means[DISTURBANCE]) if estimated_power else power, "delta_d^2 = E[d^2], eq. 10"),
        "gain": Value((-1.0 if math.isnan(last_gain) else last_gain) if estimated_gain else gain, "G_s of eq. 11"),
        "factor": Value(float(numbers["factor"][0]), "alpha of eq. 13"),
    }
    settings = {
        "rated_power": Value(float(numbers["rated_power"][0]), "rho_o"),
        "silence": Value(float(np.finfo(dtype).tiny), "a power below it has no digits left"),
    }
    flags, sizes, operations = set(), {}, 3
    if estimated_gain:
        flags.add("GAIN_ESTIMATED")
        fields["filtered"] = Value(float(means[FILTERED_REFERENCE]), "E[x'^2]")
        fields["reference"] = Value(float(means[REFERENCE]), "E[x^2]")
        operations += 9
    if estimated_power:
        flags.add("POWER_ESTIMATED")
        operations += 4
    if flags:
        flags.add("MEANS")
        settings["forgetting"] = Value(rate, "weight of a new square once the memory is full")
        sizes["MEMORY"] = Value(memory, "samples of the memory of the powers")
        samples = int(min(constraint.powers["taken"].max(), memory))
        fields["samples"] = Value(samples, "number so far, at most the memory")
        operations += 1
    return Part("powers", sizes, settings, {"powers": Value(fields, "running powers")}, flags, operations)


def _limiter(limiter: LimiterState, dtype: np.dtype) -> Part:
    """Return the limiter; its margin for rounding is that of the precision."""
    numbers, window, spans = limiter.numbers, limiter.laps_out.size - 1, limiter.horizons.size
    epsilon = float(np.finfo(dtype).eps)
    margin = (1.0 - float(numbers["budget"][0])) * epsilon / float(np.finfo(np.float64).eps)
    if margin > LARGEST_MARGIN:
        longest = int(window * LARGEST_MARGIN / margin)
        raise ValueError(
            f"the limiter's window of {window} samples is too long for {dtype}, whose rounding errors would take "
            f"{100 * margin:.1f} % of the rated power: at most {longest} samples, or dtype='float64'"
        )
    floor = FLOOR if dtype == np.float64 else 1e-30

    def number(name: str) -> float:
        return float(numbers[name][0])

    settings = {
        "scale": Value(number("scale"), "1 / root of the energy that a window may have"),
        "peak": Value((1.0 - 4.0 * epsilon) / number("scale"), "that root, less a margin for rounding"),
        "budget": Value(1.0 - margin, "share of that energy, less a margin for rounding"),
        "limit": Value(number("limit"), "largest amplitude"),
        "planned": Value(number("planned"), "louder inputs are planned for as if they were this loud"),
        "attack": Value(number("attack"), "of the running mean of the input energies"),
        "calm": Value(number("calm"), "per sample, of the loudness"),
        "fade": Value(number("fade"), "per sample, of the energies held"),
        "release": Value(number("release"), "of the gain"),
        "overshoot": Value(OVERSHOOT, "of the gain over its aim"),
        "reserve": Value(RESERVE, "of the power"),
        "floor": Value(floor, "keeps energies above denormal numbers"),
        "horizons": Value(limiter.horizons.astype(np.int32), "spans that the gain is planned for", "ANC_HORIZONS"),
        "room": Value(limiter.room, "largest output energy in such a span", "ANC_HORIZONS"),
    }
    fields = {
        "gain": Value(number("gain"), "last used, before any clipping"),
        "spent": Value(number("spent"), "output energy of this lap"),
        "arrived": Value(number("arrived"), "input energy of this lap"),
        "average": Value(max(number("average"), floor), "running mean of the input energies"),
        "loud": Value(max(number("loud"), floor), "slowly falling maximum of it"),
        "known": Value(number("known"), "largest recent energy of a window"),
        "held": Value(np.maximum(limiter.held, floor), "largest recent input energy in such a span", "ANC_HORIZONS"),
        "laps_out": Value(limiter.laps_out, "output energies of this lap and the last", "ANC_WINDOW + 1"),
        "laps_in": Value(limiter.laps_in, "input energies", "ANC_WINDOW + 1"),
        "squares": Value(limiter.squares[:window], "output energies of this lap's samples", "ANC_WINDOW"),
        "position": Value(int(numbers["position"][0]), "in the lap"),
        "clipped": Value(min(int(numbers["clipped"][0]), 2**31 - 1), "number of samples clipped"),
    }
    return Part(
        "limiter",
        sizes={"WINDOW": Value(window, "samples of the limiter's window"), "HORIZONS": Value(spans, "of the limiter")},
        settings={f"limiter_{name}": setting for name, setting in settings.items()},
        fields={"limiter": Value(fields, "the output limiter")},
        flags={"LIMITER"},
        operations=8 * spans + 22,
        rare_operations=2 * (window - 1) + 5,  # the start of a lap, and a sample that is clipped
    )


def _fxlms(state: FxLMSState, dtype: np.dtype) -> Part:
    n = state.weights.size
    return Part("fxlms", settings={"step_size": Value(state.step_size, "mu")}, operations=2 * n + 1)


def _mov(state: MOVState, dtype: np.dtype) -> Part:
    n, n_path = state.weights.size, state.lines.secondary_estimate.size
    settings, flags = {"step_size": Value(state.step_size, "mu")}, {"OUTPUT"}
    operations = 4 * n + 2 * n_path + 5
    if math.isnan(state.penalty):
        flags.add("POWERS")
        operations += 3
    else:
        settings["penalty_factor"] = Value(float(state.penalty), "gamma")
    if state.modified:
        flags.add("MODIFIED")
        operations += 2 * n + 1
    return Part("mov", settings=settings, flags=flags, operations=operations)


def _constrained(state: DiagonalState | KalmanState) -> tuple[Values, set[str]]:
    """Return the settings and flags of a Kalman filter's measurement alpha d^."""
    fixed = float(state.constraint.numbers["supplied_factor"][0])
    if math.isnan(fixed):
        return {}, {"OUTPUT", "POWERS"}
    return {"constraint_factor": Value(fixed, "alpha, fixed")}, {"OUTPUT"}


def _diagonal(state: DiagonalState, dtype: np.dtype) -> Part:
    n, n_path = state.weights.size, state.lines.secondary_estimate.size
    settings, flags = _constrained(state)
    noises = {
        "state_noise": Value(state.state_noise, "r"),
        "measurement_noise": Value(state.measurement_noise, "q"),
    }
    return Part(
        "diagonal",
        settings=settings | noises,
        fields={"variances": Value(state.variances, "p, the diagonal of P", "ANC_TAPS")},
        flags=flags,
        operations=14 * n + 2 * n_path + 3,
    )


def _kalman(state: KalmanState, dtype: np.dtype) -> Part:
    n, n_path = state.weights.size, state.lines.secondary_estimate.size
    settings, flags = _constrained(state)
    r, q = float(state.numbers["state_noise"][0]), float(state.numbers["measurement_noise"][0])
    settings |= {
        "state_noise": Value(r, "r"),
        "measurement_noise": Value(q, "q"),
        "cancellation": Value(CANCELLATION, "times q: where S is larger, P is updated in twice the precision"),
        "largest_size": Value(1e100 if dtype == np.float64 else 1e12, "that such an update takes"),
    }
    prior = covariance_matrix(state.gains) + r * np.eye(n)
    scratch = np.zeros(n)
    fields = {
        "covariance": Value(prior[np.tril_indices(n)], "P(n|n-1), the lower triangle row by row", "ANC_TRIANGLE"),
        "gain_direction": Value(scratch, "g = P x', and what else an update computes on its way", "ANC_TAPS"),
        "gain_direction_low": Value(scratch, "", "ANC_TAPS"),
        "gain": Value(scratch, "", "ANC_TAPS"),
        "gain_low": Value(scratch, "", "ANC_TAPS"),
    }
    triangle = n * (n + 1) // 2
    return Part(
        "kalman",
        sizes={"TRIANGLE": Value(triangle, "elements of the covariance stored")},
        settings=settings,
        fields=fields,
        flags=flags,
        operations=2 * n * n + 2 * triangle + 10 * n + 2 * n_path + 8,
        rare_operations=11 * n * n + 7 * triangle + 26 * n + 2,  # an update in twice the precision
    )


ALGORITHMS: dict[type, Callable[..., Part]] = {
    FxLMSState: _fxlms,
    MOVState: _mov,
    DiagonalState: _diagonal,
    KalmanState: _kalman,
}
