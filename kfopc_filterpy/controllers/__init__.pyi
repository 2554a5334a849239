from .base import Controller as Controller
from .direct import DirectKalman as DirectKalman
from .direct import DirectPowerBudget as DirectPowerBudget
from .frequency_domain import FrequencyDomainKalman as FrequencyDomainKalman
from .leaky import leak_factor as leak_factor
from .mov import penalty_factor as penalty_factor
from .power_budget import PowerBudgetController as PowerBudgetController
from .shared_gain import SharedGainKalman as SharedGainKalman
