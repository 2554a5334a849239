"""Print what each rule of KF-PB's price is worth, with the oracle: ``python tests/helpers/budget_ablation.py``.

It takes about an hour.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from tqdm import tqdm

sys.path[:0] = [str(Path(__file__).resolve().parents[2]), str(Path(__file__).resolve().parents[1])]

from oracles import power_budget as law  # noqa: E402

from comparisons.studies import kf_pb_cases as study  # noqa: E402
from kfopc_filterpy.controllers.kf_pb import DEFAULT_AVERAGING_S  # noqa: E402
from kfopc_filterpy.metrics import overshoot  # noqa: E402

CASES = (
    ("duct", "compressor"),
    ("duct", "bursts"),
    ("duct", "compressor, 12 dB louder from 8 s on"),
    ("band-pass", "compressor, 10 dB louder for 4 s"),
    ("band-pass", "band noise, then compressor"),
)


def run(case: study.Rated, **settings: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the error and the control signal after switch-on, computed in blocks."""
    own = law.PowerBudget(
        s_hat=case.secondary[np.newaxis, np.newaxis],
        n_taps=study.N_TAPS,
        rated_power=np.array([case.rated_power]),
        fs=study.FS,
        **settings,
    )
    B, on = own.B, round(study.SILENT_S * study.FS)
    taps = case.secondary.size
    x, d = case.reference, case.disturbance
    y, e = np.zeros(x.size + taps), d.copy()  # y is delayed by `taps` samples
    ends = range(B, x.size + 1, B)
    for b in ends:
        a = b - B
        sounds = a >= on
        if sounds:
            past = np.concatenate([own.x_past[0], x[a:b]])
            y[taps + a : taps + b] = np.convolve(past, own.w[0, 0])[: past.size][-B:]
            e[a:b] -= np.convolve(y[a + 1 : taps + b], case.secondary, "valid")
            own.asked = list(y[taps + a : taps + b, np.newaxis] ** 2)
        own.end_block(x[np.newaxis, a:b], y[np.newaxis, taps + a : taps + b], e[np.newaxis, a:b])
    return e[on:], y[taps + on :]


@contextmanager
def without(rule: str) -> Iterator[dict[str, float]]:
    """Switch a rule off; the settings of the controller that this takes."""
    kept, share = vars(law.core).copy(), law.PowerBudget.share
    windows = law.WINDOW_S, law.WINDOWS
    settings = {"spread": 0.0}
    if rule == "account":
        law.core.CHEAPER = 0.0
    elif rule == "floor":
        law.core.WORTHWHILE = 0.0
    elif rule == "the shorter window":
        law.WINDOW_S, law.WINDOWS = 10.0, 1
    elif rule == "the level":
        law.core.SHORTER = 1
    elif rule == "what the account stands":
        law.PowerBudget.share = lambda self, v, _: np.ones(len(v))
    elif rule == "with the path verified":
        settings = {}
    try:
        yield settings
    finally:
        law.PowerBudget.share = share
        law.WINDOW_S, law.WINDOWS = windows
        vars(law.core).update(kept)


def main() -> None:
    """Print a line for each rule."""
    plants, made = study.all_plants(), study.noises()
    cases = [study.make_rated(plants[path], made[noise][1](), study.SHARES[0]) for path, noise in CASES]
    rules = (
        "nothing",
        "the level",
        "account",
        "floor",
        "the shorter window",
        "what the account stands",
        "with the path verified",
    )
    print(f"{'without':26}{'over the bound, mean':>22}{'worst dB':>10}{'power over 10 s, most':>24}")
    with tqdm(total=len(rules) * len(cases)) as bar:
        for rule in rules:
            gains, powers = [], []
            for case in cases:
                with without(rule) as settings:
                    e, y = run(case, **settings)
                gains.append(case.reduction_db(e) - case.reduction_db(case.bound_error))
                powers.append(overshoot(y, case.rated_power, study.FS, window_s=DEFAULT_AVERAGING_S))
                bar.update()
            bar.write(f"{rule:26}{np.mean(gains):+22.2f}{min(gains):+10.2f}{max(powers):24.2f}", file=sys.stdout)


if __name__ == "__main__":
    main()
