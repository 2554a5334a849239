"""Adaptive controllers for active noise control, and what a controller of your own must offer."""

import lazy_loader

from .._removed import naming_removed

VERIFIED = "VerifiedController, which learns the paths while it controls"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = naming_removed(
    __getattr__,
    __name__,
    {
        "DirectPowerBudget": "kf_pb, which is one form for all channels",
        "MonitoredController": VERIFIED,
        "HealthEvent": "PathEvent, of VerifiedController",
        "PathTracker": VERIFIED,
        "PathChange": "PathEvent, of VerifiedController",
        "FrequencyDomainKalman": "kf_pb, which keeps a rated power as it did; kfopc_filterpy.FrequencyDomainKalman is new and keeps none",
        "SharedGainKalman": "kf_pb, which is one form for all channels",
    },
)
