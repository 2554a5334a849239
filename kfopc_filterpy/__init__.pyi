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
from .controllers.clipping import ClippingFxLMS as ClippingFxLMS
from .controllers.diagonal import DiagonalKalman as DiagonalKalman
from .controllers.frequency_domain import FrequencyDomainFxLMS as FrequencyDomainFxLMS
from .controllers.fxlms import FxLMS as FxLMS
from .controllers.fxnlms import FxNLMS as FxNLMS
from .controllers.fxrls import fx_rls as fx_rls
from .controllers.kalman import KalmanController as KalmanController
from .controllers.kalman import kf_anc as kf_anc
from .controllers.kalman import kf_opc as kf_opc
from .controllers.leaky import LeakyFxLMS as LeakyFxLMS
from .controllers.leaky import OptimalLeakyFxLMS as OptimalLeakyFxLMS
from .controllers.limited import LimitedController as LimitedController
from .controllers.mov import MOVFxLMS as MOVFxLMS
from .controllers.power_budget import kf_pb as kf_pb
from .controllers.rescaling import RescalingFxLMS as RescalingFxLMS
from .controllers.two_gradient import TwoGradientFxLMS as TwoGradientFxLMS
from .filters.kfopc import KFOPC as KFOPC
from .loop.result import SimulationResult as SimulationResult
from .loop.scenarios import simulate_scenarios as simulate_scenarios
from .loop.simulation import simulate as simulate
from .metrics import (
    clipped_fraction as clipped_fraction,
)
from .metrics import (
    convergence_time_s as convergence_time_s,
)
from .metrics import (
    noise_reduction_db as noise_reduction_db,
)
from .metrics import (
    nse_db as nse_db,
)
from .metrics import (
    output_power as output_power,
)
from .paths.models import bandpass_path as bandpass_path
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
