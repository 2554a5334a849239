from .measurement_noise import (
    measurement_noise_from_residual as measurement_noise_from_residual,
)
from .measurement_noise import (
    measurement_noise_from_run as measurement_noise_from_run,
)
from .power_constrained import (
    ControlFilter as ControlFilter,
)
from .power_constrained import (
    ControlFilters as ControlFilters,
)
from .power_constrained import (
    PowerConstrainedWiener as PowerConstrainedWiener,
)
from .power_constrained import (
    power_constrained_solution as power_constrained_solution,
)
from .rated_power import RatedPower as RatedPower
from .rated_power import required_rated_power as required_rated_power
from .wiener import (
    WienerSolution as WienerSolution,
)
from .wiener import (
    coherence_bound as coherence_bound,
)
from .wiener import (
    wiener_solution as wiener_solution,
)
