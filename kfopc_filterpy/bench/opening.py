"""What the report opens with: the claims in one sentence, and one figure of all algorithms in all studies."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from kfopc_filterpy.plot import curve_style

from .study_report import OF_THE_PAPER, Claim, FigureItem, StudyReport, jsonable

# Words of a claim, and what a claim that has them is about.
SUBJECTS = {
    "output power": "the output power",
    "rated power": "the output power",
    "noise reduction": "the noise reduction",
    "reduces the noise": "the noise reduction",
    "converge": "the speed of convergence",
    "harmonics": "distortion",
    "saturation": "distortion",
}
GLANCE = "at-a-glance"


# A claim, and the conditions of its study.
_Stated = tuple[Claim, Sequence[str]]


def claims_sentence(studies: Sequence[StudyReport]) -> str:
    """Return how many claims hold, and what those that do not hold have in common, as a sentence.

    The subjects of a claim are found by its words, its conditions are those of its study. A subject or condition is named
    if all exceptions have it, else if most of them do; never if the claims that hold fail to set it apart.

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
    >>> from kfopc_filterpy.bench import StudyReport, Claim, claims_sentence
    >>> def study(name, conditions, *claims):
    ...     return StudyReport(name, name, "", 16000, 1.0, {}, {}, claims=claims, conditions=conditions)
    >>> kept, fast = Claim("It keeps the rated power", True, ""), Claim("It converges faster", True, "")
    >>> over = Claim("It keeps the rated power", False, "")
    >>> claims_sentence([study("a", ["a tone"], kept, fast), study("b", ["noise"], over, fast, over)])
    '3 of the 5 claims of the paper were reproduced; both exceptions concern the output power, with noise.'
    """
    kinds: dict[bool, list[_Stated]] = {True: [], False: []}
    for study in studies:
        kinds[study.claims_heading == OF_THE_PAPER] += [(claim, study.conditions) for claim in study.claims]
    return " ".join(_sentence(claims, of_paper) for of_paper, claims in kinds.items() if claims)


def _sentence(claims: list[_Stated], of_paper: bool) -> str:
    what, done = ("claims of the paper", "reproduced") if of_paper else ("aims of the studies", "met")
    exceptions = [claim for claim, _ in claims if not claim.holds]
    if len(claims) == 1:
        return f"The one {what.replace('s of', ' of', 1)} was {'not ' if exceptions else ''}{done}."
    if not exceptions:
        return f"All {len(claims)} {what} were {done}."
    if len(exceptions) == len(claims):
        return f"None of the {len(claims)} {what} was {done}."
    held = len(claims) - len(exceptions)
    return f"{held} of the {len(claims)} {what} {'was' if held == 1 else 'were'} {done}; {_exceptions(claims)}."


def _exceptions(claims: list[_Stated]) -> str:
    """Return what the exceptions, two at least, have in common; one is quoted."""
    exceptions = [claim for claim, _ in claims if not claim.holds]
    if len(exceptions) == 1:
        return f"the exception is “{exceptions[0].text}”"
    subjects = _in_common([(claim.holds, _subjects(claim)) for claim, _ in claims])
    conditions = _in_common([(claim.holds, set(of_study)) for claim, of_study in claims])
    if not subjects and not conditions:
        return f"the {len(exceptions)} exceptions have neither a subject nor a condition in common"
    most = max([*subjects.values(), *conditions.values()], key=len)  # the same exceptions for both
    whom = f"{len(most)} of the {len(exceptions)} exceptions"
    if len(most) == len(exceptions):
        whom = "both exceptions" if len(most) == 2 else f"all {len(most)} exceptions"
    about, under = (" and ".join(label for label in of if of[label] == most) for of in (subjects, conditions))
    if not about:
        return f"{whom} occurred with {under}"
    return f"{whom} concern {about}" + (f", with {under}" if under else "")


def _subjects(claim: Claim) -> set[str]:
    words = claim.text.lower()
    return {subject for word, subject in SUBJECTS.items() if word in words}


def _in_common(claims: Sequence[tuple[bool, set[str]]]) -> dict[str, list[int]]:
    """Return the labels that most exceptions have, and claims that hold have less often, with these exceptions."""
    exceptions = [own for holds, own in claims if not holds]
    having = {
        label: [i for i, own in enumerate(exceptions) if label in own] for label in sorted(set().union(*exceptions))
    }
    everywhere = Counter(label for _, own in claims for label in own)
    return {
        label: those
        for label, those in having.items()
        if 2 * len(those) > len(exceptions) and len(those) * len(claims) > len(exceptions) * everywhere[label]
    }


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
