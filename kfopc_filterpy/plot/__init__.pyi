from .paths import (
    plot_bode as plot_bode,
)
from .paths import (
    plot_causality_margin as plot_causality_margin,
)
from .paths import (
    plot_group_delay as plot_group_delay,
)
from .paths import (
    plot_impulse_responses as plot_impulse_responses,
)
from .paths import (
    plot_modelling_error as plot_modelling_error,
)
from .paths import (
    plot_phase_error as plot_phase_error,
)
from .paths import (
    plot_required_rated_power as plot_required_rated_power,
)
from .paths import (
    plot_secondary_path_gain as plot_secondary_path_gain,
)
from .runs import (
    plot_constraint_factor as plot_constraint_factor,
)
from .runs import (
    plot_noise_reduction_against_overdrive as plot_noise_reduction_against_overdrive,
)
from .runs import (
    plot_nse as plot_nse,
)
from .runs import (
    plot_output_power as plot_output_power,
)
from .runs import (
    plot_weight_history as plot_weight_history,
)
from .runs import (
    save_figure as save_figure,
)
from .signals import (
    plot_amplifier_output as plot_amplifier_output,
)
from .signals import (
    plot_anti_noise as plot_anti_noise,
)
from .signals import (
    plot_disturbance_and_anti_noise as plot_disturbance_and_anti_noise,
)
from .signals import (
    plot_error_spectra as plot_error_spectra,
)
from .style import curve_style as curve_style
