from .base import Controller as Controller
from .core_controller import CoreController as CoreController
from .feedback import FeedbackNeutralizer as FeedbackNeutralizer
from .internal_model import with_internal_model as with_internal_model
from .mov import penalty_factor as penalty_factor
from .processing import RefusedUpdate as RefusedUpdate
from .virtual import KalmanObserver as KalmanObserver
from .virtual import VirtualMicrophones as VirtualMicrophones
