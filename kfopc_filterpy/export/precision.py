"""A controller's block as an export begins with it, in the precision of the export."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.block import Algorithm, Block
from ..power.limiter import NUMBERS

REALS = {np.dtype(np.float64): "double", np.dtype(np.float32): "float"}  # C's names
LARGEST_MARGIN = 0.01  # of the rated power, which the limiter keeps free for rounding


def in_precision(block: Block, precision: np.dtype) -> Block:
    """Return a block that goes on from `block` in another precision.

    Its delay lines are moved to their ends, and what no step reads of them is cleared.

    Raises
    ------
    ValueError
        If the precision cannot hold a value, or a limiter's margin for rounding would take too much of the rated power.
    """
    own = [one.name for one in block.algorithm.settings]
    fields = {name: block.fields[name].copy() for name in ("secondary_path", "guard", *own, *block.states, "amplifier")}
    for name in [name.removesuffix("_at") for name in fields if name.endswith("_at")]:
        line, newest = np.zeros_like(fields[name]), block.latest(name)
        line[..., line.shape[-1] - newest.shape[-1] :] = newest
        fields |= {name: line, f"{name}_at": np.full_like(fields[f"{name}_at"], line.shape[-1] - newest.shape[-1])}
    for limiter in fields["limiter"].reshape(-1, NUMBERS.itemsize // 8):
        _convert_limiter(limiter.view(NUMBERS), precision)
    fields = {name: _converted(field, name, precision) for name, field in fields.items()}
    algorithm = Algorithm(block.algorithm.name, real=REALS[precision])
    other = Block(
        algorithm,
        block.shape,
        path=fields["secondary_path"][0],
        settings={name: fields[name].ravel()[slice(None) if each else 0] for name, each in algorithm.settings},
        guard=fields["guard"].ravel() if fields["guard"].size else None,
    )
    for name in (*block.states, "amplifier"):
        other.fields[name][:] = fields[name]
    return other


def _converted(field: NDArray[Any], name: str, precision: np.dtype) -> NDArray[Any]:
    if field.dtype == np.int32:
        return field
    with np.errstate(over="ignore", under="ignore"):
        converted = field.astype(precision)
    lost = np.isfinite(field) & ~np.isfinite(converted)  # NaN and infinity stand for settings that were not given
    if lost.any():
        raise ValueError(f"{name} must be finite in {precision}, got {field[lost][0]:g}: scale the signals")
    return converted


def _convert_limiter(numbers: np.ndarray, precision: np.dtype) -> None:
    """Change a limiter's record of numbers to those of a precision."""
    if precision == np.float64:
        return
    epsilon, window = float(np.finfo(precision).eps), int(numbers["size"][0])
    margin = (1.0 - float(numbers["budget"][0])) * epsilon / float(np.finfo(np.float64).eps)
    if margin > LARGEST_MARGIN:
        longest = int(window * LARGEST_MARGIN / margin)
        raise ValueError(
            f"the limiter's window of {window} samples is too long for {precision}, whose rounding errors would take "
            f"{100 * margin:.1f} % of the rated power: at most {longest} samples, or dtype='float64'"
        )
    numbers["peak"] = (1.0 - 4.0 * epsilon) / numbers["scale"]
    numbers["budget"] = 1.0 - margin
