"""The report's mathematics: TeX as MathML, formulas within sentences, symbols and meanings of parameters."""

from __future__ import annotations

import re
from html import escape
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from markupsafe import Markup

# Formulas as the terminal and results.json write them, and as TeX.
FORMULAS = {
    "(R_x' + q/(N P0) I) w = r": r"(\mathbf{R}_{x'} + \frac{q}{N P_0}\mathbf{I})\,\mathbf{w} = \mathbf{r}",
    "sqrt(2 rated power)": r"\sqrt{2\rho_o}",
    "leak over E[x'^2]": r"\gamma / E[x'^2]",
    "mu L E[x'^2]": r"\mu L E[x'^2]",
    "r E[x'^2]/q": r"r E[x'^2] / q",
    "1 - lambda": r"1 - \lambda",
    "E[x'^2]": r"E[x'^2]",
    "O(L^2)": r"O(L^2)",
    "A^2": r"A^2",
    "G_s": r"G_s",
    "P0": r"P_0",
}
# Parameters that have a symbol, by their names in results.json: symbol as TeX, and meaning.
PARAMETERS = {
    "amplitude_limits": (r"A^2", "limits of the peak-limited algorithms, squared, over the amplifier's"),
    "averaging time in s": (r"T", "time over which the power is averaged in s"),
    "averaging_s": (r"T", "time over which the power is averaged in s"),
    "fs_hz": (r"f_s", "sampling frequency in Hz"),
    "initial_variance_P0": (r"P_0", "initial variance of the weights"),
    "leak over E[x'^2]": (r"\gamma / E[x'^2]", "leak, without units"),
    "measurement_noise_q": (r"q", "variance of the measurement noise"),
    "mu": (r"\mu", "step size"),
    "mu L E[x'^2]": (r"\mu L E[x'^2]", "step size, without units"),
    "mu of a block": (r"\mu", "step size of a block, without units"),
    "n_taps": (r"L", "taps of the control filter"),
    "penalty factor over G_s": (r"\beta / G_s", "penalty factor, without units"),
    "primary_path": (r"P(z)", "primary path"),
    "r": (r"r", "variance of the state noise"),
    "r E[x'^2]/q": (r"r E[x'^2] / q", "state noise, without units"),
    "rated_power": (r"\rho_o", "rated power, a mean square"),
    "rated_power_db": (r"\rho_o", "rated power in dB"),
    "reference_power": (r"E[x^2]", "power of the reference"),
    "secondary_path": (r"S(z)", "secondary path"),
    "secondary_path_estimate": (r"\hat{S}(z)", "estimate of the secondary path"),
    "sensor_noise_std": (r"\sigma_v", "standard deviation of the sensor noise"),
    "unconstrained_control_power": (r"E[y^2]", "power of the unconstrained control signal"),
    "wiener_control_power": (r"E[y^2]", "power of the unconstrained Wiener control signal"),
    "1 - lambda": (r"1 - \lambda", "forgetting"),
}
_MINUS = "\N{MINUS SIGN}"
_UNITS = {"_hz": "Hz", "_s": "s", "_db": "dB"}  # at the ends of other names
_UNIT = re.compile("(_hz|_s|_db)$")


def mathml(tex: str, display: str = "inline") -> Markup:
    r"""Return a formula as MathML, which browsers show without a script, a font or a network.

    Parameters
    ----------
    tex : str
        The formula in TeX, without dollar signs.
    display : {"inline", "block"}
        Whether it stands within a sentence or on a line of its own.

    Examples
    --------
    >>> print(mathml(r"\rho_o"))
    <math display="inline"><mrow><msub><mi>&#x003C1;</mi><mi>o</mi></msub></mrow></math>
    """
    from latex2mathml.converter import convert
    from markupsafe import Markup

    return Markup(re.sub(r' xmlns="[^"]*"', "", convert(tex, display=display)))  # in HTML it says nothing


def prose(text: str) -> Markup:
    """Return a text for the page: escaped, its known formulas as MathML, powers of ten with an exponent.

    Examples
    --------
    >>> print(prose("q < 2.5e-06, P > 1e3"))
    q &lt; 2.5 × 10<sup>−6</sup>, P &gt; 10<sup>3</sup>
    """
    from markupsafe import Markup

    def shown(found: re.Match[str]) -> str:
        if tex := FORMULAS.get(found[0]):
            return mathml(tex)
        factor = "" if float(found["factor"]) == 1 else f"{found['factor']} × "
        return f"{factor}10<sup>{str(int(found['exponent'])).replace('-', _MINUS)}</sup>"

    return Markup(_MATHEMATICS.sub(shown, escape(text, quote=False)))  # quotes are parts of formulas


def parameter(name: str) -> tuple[Markup | str, str]:
    """Return the symbol, "" if there is none, and the meaning of a parameter of results.json.

    Examples
    --------
    >>> parameter("own_setting")
    ('', 'own setting')
    """
    tex, meaning = PARAMETERS.get(name, ("", _UNIT.sub(lambda unit: f" in {_UNITS[unit[0]]}", name).replace("_", " ")))
    return (mathml(tex) if tex else ""), meaning


# A formula, or a number with an exponent, neither of which is part of a longer word.
_MATHEMATICS = re.compile(
    r"(?<![\w.])(?:" + "|".join(map(re.escape, FORMULAS)) + r"|(?P<factor>\d+(?:\.\d+)?)e(?P<exponent>[+-]?\d+))(?!\w)"
)
