from .base import Controller as Controller
from .leaky import leak_factor as leak_factor
from .mov import penalty_factor as penalty_factor
from .power_budget import PowerBudgetController as PowerBudgetController
from .shared_gain import SharedGainKalman as SharedGainKalman
from .virtual import KalmanObserver as KalmanObserver
from .virtual import VirtualMicrophones as VirtualMicrophones
