"""What the report opens with: the claims in one sentence, and one figure of all algorithms in all studies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from kfopc_filterpy._writing import jsonable
from kfopc_filterpy.plot import curve_style
from kfopc_filterpy.verdict.items import FigureItem

from .study_report import OF_THE_PAPER, StudyReport

GLANCE = "at-a-glance"


def claims_sentence(studies: Sequence[StudyReport]) -> str:
    """Return how many claims hold, and in which studies some do not, as a sentence.

    Parameters
    ----------
    studies : sequence of StudyReport
        The studies. The paper's claims are counted apart from others.

    Returns
    -------
    str
        One sentence for the paper's claims, one for the others; empty if there are no claims.

    Examples
    --------
    >>> from comparisons.bench import StudyReport, Claim, claims_sentence
    >>> def study(name, *claims):
    ...     return StudyReport(name, name, "", 16000, 1.0, {}, claims=claims)
    >>> kept, over = Claim("It keeps the rated power", True, ""), Claim("It keeps the rated power", False, "")
    >>> claims_sentence([study("a", kept, kept), study("b", over, kept, over)])
    '3 of the 5 claims of the paper were reproduced; the others are of b (2).'
    """
    paper = [study for study in studies if study.claims_heading == OF_THE_PAPER]
    beyond = [study for study in studies if study.claims_heading != OF_THE_PAPER]
    return " ".join(filter(None, (_sentence(paper, True), _sentence(beyond, False))))


def _sentence(studies: Sequence[StudyReport], of_paper: bool) -> str:
    what, done = ("claims of the paper", "reproduced") if of_paper else ("aims of the studies", "met")
    total = sum(len(study.claims) for study in studies)
    missed = {study.name: sum(not claim.holds for claim in study.claims) for study in studies}
    held = total - sum(missed.values())
    if total <= 1:
        return f"The one {what.replace('s of', ' of', 1)} was {'' if held else 'not '}{done}." if total else ""
    if held == total:
        return f"All {total} {what} were {done}."
    if not held:
        return f"None of the {total} {what} was {done}."
    others = "the others are" if total - held > 1 else "the other is"
    where = ", ".join(f"{name} ({count})" if total - held > 1 else name for name, count in missed.items() if count)
    return f"{held} of the {total} {what} {'was' if held == 1 else 'were'} {done}; {others} of {where}."


def glance(studies: Sequence[StudyReport]) -> FigureItem | None:
    """Return output power and noise reduction of every algorithm in every study, None if no study has figures of merit."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    shown = [study for study in studies if study.algorithms]
    if not shown:
        return None
    figure = Figure(figsize=(5.8, 5.4), layout="constrained")
    powers, reductions = figure.subplots(2, 1, sharex=True)
    names = list(dict.fromkeys(name for study in shown for name in study.algorithms))
    for i, name in enumerate(names):
        at = np.arange(len(shown)) + 0.7 * ((i + 0.5) / len(names) - 0.5)
        style: dict[str, Any] = {**curve_style(name), "linestyle": "", "markersize": 8}
        powers.plot(at, [_number(s, name, "output_power") / s.rated_power for s in shown], label=name, **style)
        reductions.plot(at, [_number(s, name, "noise_reduction_db") for s in shown], **style)
    powers.axhline(1.0, color="0.35", linewidth=1.2)
    powers.set(yscale="log", ylabel="output power,\ntimes the rated power")
    for ax in (powers, reductions):
        ax.margins(y=0.12)  # no marker is cut off
    low, high = powers.get_ylim()
    low, high = min(low, 0.2), max(high, 5.0)
    powers.set_ylim(low, high)
    if high < 100.0 * low:  # powers of ten alone would be one tick or two
        powers.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    powers.yaxis.set_major_formatter("{x:g}")
    powers.yaxis.set_minor_formatter("")
    reductions.axhline(0.0, color="0.35", linewidth=1.2)  # and so the axis holds 0: small differences look small
    reductions.set(ylabel="noise reduction (dB)", xlim=(-0.5, len(shown) - 0.5))
    several = [study.name.replace("-", "\n") for study in shown] if len(shown) > 1 else []
    reductions.set_xticks(range(len(several)), several)
    for ax in (powers, reductions):
        ax.grid(axis="y", color="0.9")
        ax.set_axisbelow(True)
        for between in range(1, len(shown)):
            ax.axvline(between - 0.5, color="0.85", linewidth=0.8)
    figure.legend(loc="outside upper center", ncols=min(len(names), 4), frameon=False)
    return FigureItem(GLANCE, _caption(shown), figure)


def _caption(studies: Sequence[StudyReport]) -> str:
    powers = [_number(study, "KF-OPC", "output_power") / study.rated_power for study in studies]
    known = [power for power in powers if np.isfinite(power)]
    text = (
        "What each algorithm asks of the amplifier (above; the line is the rated power), and what it gets for it (below), "
        f"over the steady half{' of each study' if len(studies) > 1 else ''}."
    )
    if not known:
        return text
    spread = " to ".join(dict.fromkeys(f"{power:.2f}" for power in (min(known), max(known))))
    return f"{text} KF-OPC asks for {spread} times the rated power."


def _number(study: StudyReport, algorithm: str, key: str) -> float:
    value = jsonable(study.algorithms.get(algorithm, {}).get(key))
    return np.nan if value is None else float(value)
