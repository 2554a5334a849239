from . import (
    bounds as bounds,
)
from . import (
    controllers as controllers,
)
from . import (
    export as export,
)
from . import (
    filters as filters,
)
from . import (
    metrics as metrics,
)
from . import (
    paths as paths,
)
from . import (
    plot as plot,
)
from . import (
    power as power,
)
from . import (
    realtime as realtime,
)
from . import (
    signals as signals,
)
from . import (
    verdict as verdict,
)
from .bounds.power_constrained import power_constrained_wiener as power_constrained_wiener
from .bounds.settings import suggest_settings as suggest_settings
from .controllers.amplitude_limited import clipping_fx_lms as clipping_fx_lms
from .controllers.amplitude_limited import rescaling_fx_lms as rescaling_fx_lms
from .controllers.amplitude_limited import two_gradient_fx_lms as two_gradient_fx_lms
from .controllers.diagonal import diagonal_kf as diagonal_kf
from .controllers.estimator import KalmanController as KalmanController
from .controllers.frequency_domain import frequency_domain_fx_lms as frequency_domain_fx_lms
from .controllers.fxlms import fx_lms as fx_lms
from .controllers.fxlms import fx_nlms as fx_nlms
from .controllers.fxrls import fx_rls as fx_rls
from .controllers.kalman import kf_anc as kf_anc
from .controllers.kalman import kf_opc as kf_opc
from .controllers.kf_pb import kf_pb as kf_pb
from .controllers.leaky import leaky_fx_lms as leaky_fx_lms
from .controllers.leaky import optimal_leaky_fx_lms as optimal_leaky_fx_lms
from .controllers.limited import LimitedController as LimitedController
from .controllers.mov import mov_fx_lms as mov_fx_lms
from .filters.kfopc import KFOPC as KFOPC
from .loop.result import SimulationResult as SimulationResult
from .loop.simulation import simulate as simulate
from .metrics import (
    noise_reduction_db as noise_reduction_db,
)
from .metrics import (
    output_power as output_power,
)
from .paths.models import bandpass_path as bandpass_path
from .plant import Plant as Plant
from .power.amplifiers import (
    HardClipAmplifier as HardClipAmplifier,
)
from .power.amplifiers import (
    LinearAmplifier as LinearAmplifier,
)
from .power.amplifiers import (
    SoftSaturationAmplifier as SoftSaturationAmplifier,
)
from .power.constraint import OutputPowerConstraint as OutputPowerConstraint
from .power.limiter import OutputLimiter as OutputLimiter

__version__: str
