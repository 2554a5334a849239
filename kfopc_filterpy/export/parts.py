"""What an exported controller consists of: its settings, its present state and the C fragments of its algorithm."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ..controllers.compiled_controller import CompiledController
from ..controllers.kalman import KalmanState
from ..controllers.step import Lines
from ..core.running import LINEAR
from ..kernels.covariance import CANCELLATION, covariance_matrix
from ..kernels.delay_lines import newest
from ..power.constraint import ConstraintState
from ..power.limiter import RESERVE, LimiterState, spans_of
from .precision import in_precision

EXPORTED = (
    "export_c takes the FxLMS family, DiagonalKalman and FastArrayKalman, whatever they have, and kf_anc and "
    "kf_opc: one channel, exponential power estimates, with or without a limiter; no amplifier model, no "
    "secondary_path_uncertainty, no fading memory. It takes no wrapper and no subclass with calls of its own"
)
OVERSHOOT = 1.1  # of limiter.c


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
    parts = [_signals(state.lines, state.weights)]
    if "POWERS" in algorithm.flags:
        parts.append(_powers(state.constraint, dtype))
    if state.lines.limiter is not None:
        parts.append(_limiter(state.lines.limiter, dtype))
    return [*parts, algorithm]


def named(controller: Any) -> str:
    """Return the name and the class of a controller for a message."""
    return f"{getattr(controller, 'name', type(controller).__name__)} ({type(controller).__name__})"


def _exportable_state(controller: Any) -> Any:
    """Return a copy of a controller's state, or raise an error if it has parts that are not exported."""
    if not isinstance(controller, CompiledController):
        raise TypeError(f"{named(controller)} cannot be exported: {EXPORTED}")
    if controller.multichannel:
        raise ValueError(f"{named(controller)} has several channels and cannot be exported: {EXPORTED}")
    state = deepcopy(controller).compiled_state()
    if type(state) not in ALGORITHMS:
        raise TypeError(f"{named(controller)} cannot be exported: {EXPORTED}")
    obstacles = {
        "an amplifier model": state.lines.amplifier["kind"][0] != LINEAR,
        "a secondary_path_uncertainty": state.lines.guard is not None,
        "power estimates over a sliding window": state.constraint.window.shape[1] > 0,
        "a fading memory": isinstance(state, KalmanState) and state.numbers["alpha_sq"][0] != 1.0,
    }
    found = [what for what, there in obstacles.items() if there]
    if found:
        raise ValueError(f"{named(controller)} has {' and '.join(found)} and cannot be exported: {EXPORTED}")
    return state


def _delay_line(line: np.ndarray, taps: int) -> np.ndarray:
    """Return the newest samples of a delay line, twice, as the C code keeps them."""
    return np.tile(newest(line, taps), 2)


def _signals(lines: Lines, weights: np.ndarray) -> Part:
    n_taps, n_path = weights.size, lines.secondary_estimate.size
    longest = max(n_taps, n_path)
    fields = {
        "weights": Value(weights, "control filter w, newest-sample tap first", "ANC_TAPS"),
        "reference": Value(_delay_line(lines.reference, longest), "delay line of x", "2 * ANC_REFERENCE_TAPS"),
        "filtered": Value(_delay_line(lines.filtered, n_taps), "delay line of x' = s^ * x", "2 * ANC_TAPS"),
        "output": Value(_delay_line(lines.output, n_path), "delay line of y", "2 * ANC_PATH_TAPS"),
    }
    starts = {
        "reference_start": Value(0, "where the delay lines begin"),
        "filtered_start": Value(0),
        "output_start": Value(0),
    }
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
    numbers, (disturbance, filtered, reference) = constraint.numbers, map(float, constraint.powers["mean_square"])
    power, gain = float(numbers["supplied_power"][0]), float(numbers["supplied_gain"][0])
    estimated_power, estimated_gain = math.isnan(power), math.isnan(gain)
    rate, last_gain = float(numbers["rate"][0]), float(numbers["gain"][0])
    memory = math.ceil(1.0 / rate)
    fields = {
        "disturbance": Value(disturbance if estimated_power else power, "delta_d^2 = E[d^2], eq. 10"),
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
        fields["filtered"] = Value(filtered, "E[x'^2]")
        fields["reference"] = Value(reference, "E[x^2]")
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
    numbers, (laps_out, laps_in, squares) = limiter.numbers.copy(), limiter.laps
    floor = in_precision(numbers, dtype)
    window, spans = laps_out.size - 1, int(numbers["spans"][0])
    horizon, held, room = spans_of(numbers)[:, :spans]

    def number(name: str) -> float:
        return float(numbers[name][0])

    settings = {
        "scale": Value(number("scale"), "1 / root of the energy that a window may have"),
        "peak": Value(number("peak"), "that root, less a margin for rounding"),
        "budget": Value(number("budget"), "share of that energy, less a margin for rounding"),
        "limit": Value(number("limit"), "largest amplitude"),
        "planned": Value(number("planned"), "louder inputs are planned for as if they were this loud"),
        "attack": Value(number("attack"), "of the running mean of the input energies"),
        "calm": Value(number("calm"), "per sample, of the loudness"),
        "fade": Value(number("fade"), "per sample, of the energies held"),
        "release": Value(number("release"), "of the gain"),
        "overshoot": Value(OVERSHOOT, "of the gain over its aim"),
        "reserve": Value(RESERVE, "of the power"),
        "floor": Value(floor, "keeps energies above denormal numbers"),
        "horizons": Value(horizon.astype(np.int32), "spans that the gain is planned for", "ANC_HORIZONS"),
        "room": Value(room, "largest output energy in such a span", "ANC_HORIZONS"),
    }
    fields = {
        "gain": Value(number("gain"), "last used, before any clipping"),
        "spent": Value(number("spent"), "output energy of this lap"),
        "arrived": Value(number("arrived"), "input energy of this lap"),
        "average": Value(number("average"), "running mean of the input energies"),
        "loud": Value(number("loud"), "slowly falling maximum of it"),
        "known": Value(number("known"), "largest recent energy of a window"),
        "held": Value(held, "largest recent input energy in such a span", "ANC_HORIZONS"),
        "laps_out": Value(laps_out, "output energies of this lap and the last", "ANC_WINDOW + 1"),
        "laps_in": Value(laps_in, "input energies", "ANC_WINDOW + 1"),
        "squares": Value(squares[:window], "output energies of this lap's samples", "ANC_WINDOW"),
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


def _constrained(state: KalmanState) -> tuple[Values, set[str]]:
    """Return the settings and flags of a Kalman filter's measurement alpha d^."""
    fixed = float(state.constraint.numbers["supplied_factor"][0])
    if math.isnan(fixed):
        return {}, {"POWERS"}
    return {"constraint_factor": Value(fixed, "alpha, fixed")}, set()


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
    KalmanState: _kalman,
}
