"""Every algorithm of the package by name, with what makes its controllers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from .clipping import ClippingFxLMS
from .diagonal import DiagonalKalman
from .frequency_domain import FrequencyDomainFxLMS
from .fxlms import FxLMS
from .fxnlms import FxNLMS
from .fxrls import fx_rls
from .kalman import kf_anc, kf_opc
from .leaky import LeakyFxLMS, OptimalLeakyFxLMS
from .mov import MOVFxLMS
from .power_budget import kf_pb
from .rescaling import RescalingFxLMS
from .two_gradient import TwoGradientFxLMS

# In the compiled core, so that they can be exported.
CORE: dict[str, Callable[..., Any]] = {
    "KF-ANC": kf_anc,
    "KF-OPC": kf_opc,
    "KF-PB": kf_pb,
    "diagonal KF": DiagonalKalman,
    "FxRLS": fx_rls,
    "FxLMS": FxLMS,
    "FxNLMS": FxNLMS,
    "leaky FxLMS": LeakyFxLMS,
    "optimal leaky FxLMS": OptimalLeakyFxLMS,
    "MOV-FxLMS": MOVFxLMS,
    "MOV-MFxLMS": partial(MOVFxLMS, modified=True),
    "two-gradient FxLMS": TwoGradientFxLMS,
    "re-scaling FxLMS": RescalingFxLMS,
    "clipping FxLMS": ClippingFxLMS,
}
MAKERS: dict[str, Callable[..., Any]] = CORE | {
    "frequency-domain FxLMS": FrequencyDomainFxLMS,
}
