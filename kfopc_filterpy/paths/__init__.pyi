from .analysis import CausalityMargin as CausalityMargin
from .analysis import (
    achieved_band as achieved_band,
)
from .analysis import causality_margin as causality_margin
from .analysis import (
    frequency_response as frequency_response,
)
from .analysis import (
    group_delay as group_delay,
)
from .analysis import (
    phase_error as phase_error,
)
from .analysis import (
    secondary_path_gain as secondary_path_gain,
)
from .duct import Duct as Duct
from .duct import DuctPaths as DuctPaths
from .duct import duct_paths as duct_paths
from .identification import (
    IdentificationResult as IdentificationResult,
)
from .identification import (
    PathEstimate as PathEstimate,
)
from .identification import (
    estimate_path as estimate_path,
)
from .identification import (
    identify_secondary_path as identify_secondary_path,
)
from .identification import (
    misalignment_db as misalignment_db,
)
from .identification import (
    modelling_error_db as modelling_error_db,
)
from .models import fir_path as fir_path
from .models import path_taps as path_taps
from .models import perturbed_path as perturbed_path
