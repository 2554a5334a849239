"""What the report opens with: the claims in a sentence, from claims made by hand, and the figure of all studies."""

import numpy as np
import pytest
from helpers.reports import study

from comparisons.bench import Claim, claims_sentence
from comparisons.bench.opening import GLANCE, glance

POWER, SPEED, CLEAN = "It keeps the Rated Power", "It converges faster", "It has no harmonics"


def made(name, *claims, **changes):
    """Return a study with these claims, each a text and whether it holds."""
    claims = [Claim(text, holds, "") for text, holds in claims]
    return study(name, claims=claims, **changes)


@pytest.mark.parametrize(
    ("claims", "sentence"),
    [
        ([(POWER, True), (SPEED, True), (CLEAN, True)], "All 3 claims of the paper were reproduced."),
        ([(POWER, False), (SPEED, False), (CLEAN, False)], "None of the 3 claims of the paper was reproduced."),
        ([(POWER, True)], "The one claim of the paper was reproduced."),
        ([(POWER, False)], "The one claim of the paper was not reproduced."),
        ([(POWER, True), (SPEED, False)], "1 of the 2 claims of the paper was reproduced; the other is of a."),
        ([], ""),
    ],
    ids=["all", "none", "one holds", "one fails", "one exception", "without"],
)
def test_claims_of_one_study(claims, sentence):
    assert claims_sentence([made("a", *claims)]) == sentence


def test_the_studies_of_the_other_claims_are_named():
    studies = [
        made("flat", (POWER, True), (SPEED, True)),
        made("duct", (POWER, False), (SPEED, True), (CLEAN, False)),
        made("other", (POWER, False), (CLEAN, True)),
    ]
    assert claims_sentence(studies) == (
        "4 of the 7 claims of the paper were reproduced; the others are of duct (2), other (1)."
    )


def test_aims_are_counted_apart_from_the_papers_claims():
    ours = made("ours", (POWER, True), (SPEED, True), claims_heading="Aims")
    paper = made("paper", (POWER, False), (SPEED, False))
    assert claims_sentence([ours, paper]) == (
        "None of the 2 claims of the paper was reproduced. All 2 aims of the studies were met."
    )


def test_the_figure_holds_every_algorithm_of_every_study():
    first = study(
        algorithms={"KF-ANC": {"output_power": 8.0, "noise_reduction_db": 20.0}, "KF-OPC": {"output_power": 0.4}}
    )
    second = study("duct", rated_power=2.0, algorithms={"KF-OPC": {"output_power": 3.0, "noise_reduction_db": 5.0}})
    item = glance([first, second])
    assert item.stem == GLANCE
    powers, reductions = item.figure.axes
    shown = {line.get_label(): line.get_ydata() for line in powers.get_lines() if line.get_marker() != "None"}
    np.testing.assert_allclose(shown["KF-ANC"], [10.0, np.nan])
    np.testing.assert_allclose(shown["KF-OPC"], [0.5, 1.5])
    np.testing.assert_allclose([line.get_ydata() for line in reductions.get_lines()][:2], [[20, np.nan], [np.nan, 5]])
    assert {0.2, 0.5, 1.0, 2.0, 5.0} <= set(powers.get_yticks())
    assert "KF-OPC asks for 0.50 to 1.50 times the rated power." in item.caption
    assert "KF-ANC" in item.alt
    assert "noise reduction (dB)" in item.alt


def test_no_figure_without_figures_of_merit():
    assert glance([study(algorithms={})]) is None
