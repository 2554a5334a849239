"""Algorithms that exist to be compared: plain numpy, one channel, the equations above their lines, and nothing checked."""

from .fast_array import FastArrayKalman as FastArrayKalman
from .frequency_kalman import FrequencyDomainKalman as FrequencyDomainKalman
from .improved_mov import ImprovedMOV as ImprovedMOV
from .power_limited import PowerLimitedFxLMS as PowerLimitedFxLMS
from .subband import SubbandFxLMS as SubbandFxLMS
from .subfilters import SubfilterKalman as SubfilterKalman
