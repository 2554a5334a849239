"""Rated power that KF-OPC needs for a given noise reduction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .._validate import as_choice, as_positive, require_finite


@dataclass(frozen=True)
class RatedPower:
    """Rated power needed for given noise reductions.

    Attributes
    ----------
    noise_reduction_db : numpy.ndarray
        Noise reductions wanted, in dB.
    constraint_factor : numpy.ndarray
        Scaling α of the Wiener filter that reaches each; 1 if it is out of reach.
    rated_power : numpy.ndarray
        Rated power (mean square) that it takes; infinite if it is out of reach.
    """

    noise_reduction_db: np.ndarray
    constraint_factor: np.ndarray
    rated_power: np.ndarray


def required_rated_power(
    noise_reduction_db: Any,
    *,
    disturbance_power: float,
    antinoise_power: float,
    control_power: float,
    beyond: str = "raise",
) -> RatedPower:
    r"""Return the rated power that KF-OPC needs to reach a noise reduction.

    KF-OPC scales the measurement by α (eq. 9), and so in the steady state scales the Wiener filter by α. With control
    power :math:`P_w` and anti-noise power A of the Wiener filter, and disturbance power D,

    .. math:: J(α) = D - (2α - α^2) A, \qquad ρ_o = α^2 P_w.

    Parameters
    ----------
    noise_reduction_db : float or array_like
        Noise reductions wanted in dB, zero or above.
    disturbance_power, antinoise_power, control_power : float
        D, A and P_w: the attributes of a `WienerSolution` computed without a penalty.
    beyond : {"raise", "inf"}, default "raise"
        Whether noise reductions that the Wiener filter itself does not attain raise an error or need infinite power.

    Returns
    -------
    RatedPower
        Rated power and constraint factor, of the shape of `noise_reduction_db`.

    Raises
    ------
    TypeError, ValueError
        If a noise reduction is negative or out of reach, or a power is not positive.

    Examples
    --------
    >>> needed = required_rated_power(
    ...     [6.0, 20.0], disturbance_power=1.0, antinoise_power=0.99, control_power=2.0
    ... )
    >>> needed.rated_power.round(3)
    array([0.513, 2.   ])
    """
    disturbance = as_positive(disturbance_power, "disturbance_power")
    antinoise = as_positive(antinoise_power, "antinoise_power")
    control = as_positive(control_power, "control_power")
    as_choice(beyond, "beyond", ("raise", "inf"))
    if antinoise > disturbance * (1 + 1e-9):
        raise ValueError(
            f"antinoise_power must not exceed disturbance_power, got {antinoise:g} and {disturbance:g}: "
            "these are not the powers of a Wiener filter computed without a penalty"
        )
    wanted = np.asarray(noise_reduction_db, dtype=np.float64)
    require_finite(wanted, "noise_reduction_db")
    if np.any(wanted < 0):
        raise ValueError(f"noise_reduction_db must not be negative, got {wanted.min():g} dB")

    # 2α - α² = (D - J)/A has the smaller root α = 1 - sqrt(1 - (D - J)/A).
    share = disturbance * (1 - 10 ** (-wanted / 10)) / antinoise
    # The Wiener filter's own noise reduction is in reach, whichever way its last digit was rounded.
    attainable = share <= 1 + 1e-9
    if beyond == "raise" and not np.all(attainable):
        remaining = max(1 - antinoise / disturbance, 1e-30)
        raise ValueError(
            f"noise_reduction_db must not exceed what the Wiener filter attains, "
            f"{-10 * np.log10(remaining):.2f} dB, got {wanted.max():g} dB; "
            "use a longer control filter, or beyond='inf' to mark such values"
        )
    factor = 1 - np.sqrt(np.clip(1 - share, 0, 1))
    return RatedPower(wanted, factor, np.where(attainable, factor**2 * control, np.inf))
