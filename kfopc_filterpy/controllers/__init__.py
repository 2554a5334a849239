"""Adaptive controllers for active noise control, and what a controller of your own must offer."""

import lazy_loader

from .._removed import naming_removed

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = naming_removed(
    __getattr__,
    __name__,
    {
        "DirectPowerBudget": "kf_pb, which is one form for all channels",
        **dict.fromkeys(("MonitoredController", "PathTracker"), "VerifiedController"),
        **dict.fromkeys(("HealthEvent", "PathChange"), "PathEvent, in the events of a VerifiedController"),
        "FrequencyDomainKalman": "kf_pb, which is one form for all channels",
        "SharedGainKalman": "kf_pb, which is one form for all channels",
    },
)
