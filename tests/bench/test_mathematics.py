"""Formulas as MathML, texts with formulas, symbols of parameters."""

from xml.etree import ElementTree

import pytest

from kfopc_filterpy.bench import algorithms
from kfopc_filterpy.bench.mathematics import FORMULAS, PARAMETERS, mathml, parameter, prose

STATE_NOISE = FORMULAS["r E[x'^2]/q"]


def test_every_formula_becomes_mathml_without_a_rest_of_tex():
    for tex in {tex for tex, _ in PARAMETERS.values() if tex} | set(FORMULAS.values()):
        math = ElementTree.fromstring(mathml(tex))
        assert math.tag == "math"
        assert not set("\\{}_$") & set("".join(math.itertext())), tex


def test_a_fraction_is_a_fraction():
    math = ElementTree.fromstring(mathml(r"\sqrt{\frac{a}{b}}", "block"))
    assert math.get("display") == "block"
    assert ["".join(part.itertext()) for part in math.find(".//msqrt//mfrac")] == ["a", "b"]


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a <b> & c", "a &lt;b&gt; &amp; c"),
        ("1e-07, –", "10<sup>−7</sup>, –"),
        ("q = 2.5e+06.", "q = 2.5 × 10<sup>6</sup>."),
        ("file1e5 and 0x1e5a", "file1e5 and 0x1e5a"),
        ("up to sqrt(2 rated power);", f"up to {mathml(FORMULAS['sqrt(2 rated power)'])};"),
        ("KF-ANC's r E[x'^2]/q", f"KF-ANC's {mathml(STATE_NOISE)}"),
        ("", ""),
    ],
    ids=["escaped", "power", "factor", "words", "formula", "longest", "empty"],
)
def test_prose(text, shown):
    assert str(prose(text)) == shown


def test_settings_of_the_registry_have_symbols():
    for name, algorithm in algorithms().items():
        for setting in (algorithm.symbol, algorithm.kind):
            symbol, meaning = parameter(setting)
            assert symbol.startswith("<math"), name
            assert meaning != setting
