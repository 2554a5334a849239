from .filter_consistency import Consistency as Consistency
from .filter_consistency import consistency as consistency
from .noise_fit import NoiseFit as NoiseFit
from .noise_fit import fit_noise as fit_noise
from .random_walk import RandomWalkKFOPC as RandomWalkKFOPC
from .state_limits import constrained as constrained
