"""Every algorithm of the package by name, with the function that makes its controllers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from .amplitude_limited import clipping_fx_lms, rescaling_fx_lms, two_gradient_fx_lms
from .diagonal import diagonal_kf
from .frequency_domain import frequency_domain_fx_lms
from .fxlms import fx_lms, fx_nlms
from .fxrls import fx_rls
from .kalman import kf_anc, kf_opc
from .kf_pb import kf_pb
from .leaky import leaky_fx_lms, optimal_leaky_fx_lms
from .mov import mov_fx_lms

# In the compiled core, so that they can be exported.
CORE: dict[str, Callable[..., Any]] = {
    "KF-ANC": kf_anc,
    "KF-OPC": kf_opc,
    "KF-PB": kf_pb,
    "diagonal KF": diagonal_kf,
    "FxRLS": fx_rls,
    "FxLMS": fx_lms,
    "FxNLMS": fx_nlms,
    "leaky FxLMS": leaky_fx_lms,
    "optimal leaky FxLMS": optimal_leaky_fx_lms,
    "MOV-FxLMS": mov_fx_lms,
    "MOV-MFxLMS": partial(mov_fx_lms, modified=True),
    "two-gradient FxLMS": two_gradient_fx_lms,
    "re-scaling FxLMS": rescaling_fx_lms,
    "clipping FxLMS": clipping_fx_lms,
}
MAKERS: dict[str, Callable[..., Any]] = CORE | {"frequency-domain FxLMS": frequency_domain_fx_lms}
