"""Scene, registry of algorithms, tuning rule and report: what studies and sweeps share."""

import lazy_loader

from .._removed import naming_removed

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = naming_removed(
    __getattr__,
    __name__,
    {
        "Levels": "SoundLevels",
        "Verdict": "Claim",
        "verdict_sentence": "claims_sentence",
        "read_setup": "AcousticSetup with what paths.read_path and signals.read_recording return",
    },
)
