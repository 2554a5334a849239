from .paths import plot_bode as plot_bode
from .runs import plot_nse as plot_nse
from .runs import plot_output_power as plot_output_power
from .runs import save_figure as save_figure
from .signals import plot_amplifier_output as plot_amplifier_output
from .signals import plot_anti_noise as plot_anti_noise
from .signals import plot_error_spectra as plot_error_spectra
from .style import curve_style as curve_style
