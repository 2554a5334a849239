"""`python -m comparisons speed`: the time of a sample, against the machine's limit and against other filters.

The limit is 3 L^2 flops at the rate of a matrix product (dgemm, 384 x 384, best of 20), one BLAS thread. The probe and
all variants take turns, and the best time of each counts, so that other work on the machine slows all of them alike.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kfopc_filterpy import KFOPC
from kfopc_filterpy._writing import replacing, write_whole

from ..studies.report_parts import new_figure
from . import variants
from .beside_filterpy import table_beside_filterpy, times_beside_filterpy

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TAPS = (16, 32, 64, 128, 256, 512, 1024)
ROUNDS = 8
PROBE_SIZE, PROBE_TIMES = 384, 20
TURN_S = 0.05  # a variant's turn, about as long as the probe's
REAL_TIME_FS = (16000.0, 48000.0)
WORST_TAPS = (128, 256, 512)
WORST_SAMPLES = 1_000_000
CHANNEL_BLOCKS = 100
BLOCK_SAMPLES = 640_000  # 40 s at 16 kHz; 40,000 of the shortest blocks
# Above these taps a variant would take minutes or gigabytes, and the trend is clear.
LARGEST = {"pykalman": 512, f"closed loop, each of {variants.SCENARIOS} KF-OPC": 512}
NEEDS = {
    "statsmodels": "statsmodels",
    "pykalman": "pykalman",
    "padasip RLS": "padasip",
    "pyroomacoustics RLS": "pyroomacoustics",
}
OTHER_RECURSIONS = ("padasip RLS", "pyroomacoustics RLS")


def seconds(work: Callable[[], Any]) -> float:
    """Return the time of one call."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def shortest(work: Callable[[], Any]) -> float:
    """Return the best time of a turn: as many calls as the probe has if they are short, one if they are long."""
    best, spent, calls = np.inf, 0.0, 0
    while calls == 0 or (spent < TURN_S and calls < PROBE_TIMES):
        took = seconds(work)
        best, spent, calls = min(best, took), spent + took, calls + 1
    return best


def dgemm_probe() -> Callable[[], float]:
    """Return a function that measures the rate of a matrix product in GFLOP/s, the best of some."""
    from scipy.linalg.blas import dgemm

    a = np.asfortranarray(np.random.default_rng(0).standard_normal((PROBE_SIZE, PROBE_SIZE)))
    flops = 2 * PROBE_SIZE**3
    return lambda: max(flops / seconds(lambda: dgemm(1.0, a, a)) for _ in range(PROBE_TIMES)) / 1e9


def chosen_variants(taps: int) -> dict[str, Callable[[int], variants.Work]]:
    """Return all variants for a number of taps whose packages are installed."""
    every = variants.OURS | variants.PEERS
    return {
        name: make
        for name, make in every.items()
        if taps <= LARGEST.get(name, taps) and (name not in NEEDS or find_spec(NEEDS[name]))
    }


def measure(taps: int, rounds: int = ROUNDS, tick: Callable[[], Any] = lambda: None) -> tuple[float, dict[str, float]]:
    """Return the dgemm rate in GFLOP/s and the time of a sample in µs by variant: the best of some rounds, in turns."""
    probe, works = dgemm_probe(), {name: make(taps) for name, make in chosen_variants(taps).items()}
    rate, best = 0.0, dict.fromkeys(works, np.inf)
    for _ in range(rounds):
        for name, (work, samples) in works.items():
            best[name] = min(best[name], shortest(work) / samples * 1e6)
        rate = max(rate, probe())
        tick()
    return rate, best


def rows_of(taps: int, rate: float, best: dict[str, float]) -> list[dict[str, Any]]:
    """Return the rows of speed.json."""
    limit = 3 * taps**2 / rate / 1e3
    return [
        {
            "variant": name,
            "taps": taps,
            "us_per_sample": us,
            "limit_fraction": limit / us,
            "times_filterpy": best["filterpy"] / us,
            "times_numpy": best["numpy rank-1"] / us,
        }
        for name, us in best.items()
    ]


def worst_sample(taps: int, samples: int = WORST_SAMPLES) -> dict[str, float]:
    """Return the longest and the usual time of one sample of the filter, called from Python sample by sample."""
    kf, x = variants.random_walk(taps), variants.signal(taps, 4096)
    times = np.empty(samples)
    clock = time.perf_counter_ns
    for k in range(-10, samples):
        h = x[k % 4096 : k % 4096 + taps]
        began = clock()
        kf.predict()
        kf.update(1.0, H=h)
        if k >= 0:
            times[k] = clock() - began
    usual, rare = np.percentile(times, (50, 99.99)) / 1e3
    return {"taps": taps, "median_us": float(usual), "percentile_99_99_us": float(rare), "worst_us": times.max() / 1e3}


def first_samples_us(taps: int) -> float:
    """Return the usual time of an update after a large P(0|0), here 1 with q = 1e-3, which is computed carefully."""
    kf = KFOPC.random_walk(taps, state_noise=variants.R, measurement_noise=1e-3)
    x = variants.signal(taps, 60)
    times = []
    for k in range(60):
        kf.predict()
        began = time.perf_counter()
        kf.update(1.0, H=x[k : k + taps])
        times.append(time.perf_counter() - began)
    return float(np.median(times[10:]) * 1e6)


def channel_times(taps: int = 512) -> list[dict[str, Any]]:
    """Return the times of KF-PB with several channels, a block at a time, beside one channel of KF-OPC in the same run."""
    single, samples = variants.closed_loop("KF-OPC", taps)
    rows = []
    for sizes in variants.CHANNELS:
        run, block = variants.channel_blocks(*sizes)
        reference = min(seconds(single) for _ in range(3)) / samples
        blocks = [seconds(run) for _ in range(CHANNEL_BLOCKS)]
        names = ("references", "loudspeakers", "microphones", "n_taps")
        rows.append(
            dict(zip(names, sizes, strict=True))
            | {
                "us_per_sample": 1e6 * min(blocks) / block,
                "times_one_channel": min(blocks) / block / reference,
                "worst_block_share": max(blocks) / (block / REAL_TIME_FS[0]),
            }
        )
    return rows


def channel_table(rows: list[dict[str, Any]], taps: int = 512) -> str:
    """Return the times of several channels for the terminal."""
    title = f"KF-PB: I x J x K, taps L    µs a sample   times one channel of {taps} taps   worst block / its duration"
    lines = (
        f"{row['references']:6} x {row['loudspeakers']:2} x {row['microphones']:2}, {row['n_taps']:4}"
        f"{row['us_per_sample']:18.1f}{row['times_one_channel']:22.2f}{row['worst_block_share']:36.2f}"
        for row in rows
    )
    return "\n".join([title, *lines])


def block_times(samples: int = BLOCK_SAMPLES) -> list[dict[str, Any]]:
    """Return the usual, the 99.99 % and the longest time of `process` for a block, for each controller and length."""
    rows = []
    for name in variants.BLOCK_CONTROLLERS:
        for block in variants.BLOCKS:
            run = variants.process_block(name, block)
            times = np.array([seconds(run) for _ in range(max(samples // block, 1))])
            usual, rare = np.percentile(times, (50, 99.99))
            rows.append(
                {
                    "controller": name,
                    "block": block,
                    "median_us": 1e6 * float(usual),
                    "percentile_99_99_us": 1e6 * float(rare),
                    "worst_us": 1e6 * float(times.max()),
                    "shares": [[float(t) * fs / block for t in (usual, rare, times.max())] for fs in REAL_TIME_FS],
                }
            )
    return rows


def block_table(rows: list[dict[str, Any]]) -> str:
    """Return the times of blocks for the terminal."""
    rates = "".join(f"{f'at {fs / 1e3:g} kHz':>24}" for fs in REAL_TIME_FS)
    title = f"{'process, a block at a time':28}{'block':>6}{'median µs':>11}{'99.99 %':>10}{'worst':>10}{rates}"
    lines = [f"{'median, 99.99 %, worst over the duration of a block':>{len(title)}}", title]
    for row in rows:
        shares = "".join(f"{' '.join(f'{share:.2f}' for share in three):>24}" for three in row["shares"])
        times = f"{row['median_us']:11.1f}{row['percentile_99_99_us']:10.1f}{row['worst_us']:10.1f}"
        lines.append(f"{row['controller']:28}{row['block']:6}{times}{shares}")
    return "\n".join(lines)


def long_times() -> list[dict[str, Any]]:
    """Return the times of a sample with many taps in µs: the best of some rounds, in turns."""
    rows = []
    for taps in variants.LONG_TAPS:
        works = {name: variants.long_filter(name, taps) for name in variants.LONG}
        best = dict.fromkeys(works, np.inf)
        for _ in range(ROUNDS):
            for name, (work, samples) in works.items():
                best[name] = min(best[name], shortest(work) / samples * 1e6)
        rows += [{"controller": name, "taps": taps, "us_per_sample": us} for name, us in best.items()]
    return rows


def long_table(rows: list[dict[str, Any]]) -> str:
    """Return the times with many taps for the terminal, and their ratios to the first controller's."""
    us = {(row["controller"], row["taps"]): row["us_per_sample"] for row in rows}
    first, taps = rows[0]["controller"], list(dict.fromkeys(row["taps"] for row in rows))
    title = f"{f'µs a sample, blocks of {variants.LONG_BLOCK}':38}{''.join(f'{n:>10}' for n in taps)}"
    lines, ratios = [title], [f"times the time of {first}"]
    for name in dict.fromkeys(row["controller"] for row in rows):
        lines.append(f"{name:38}{''.join(f'{us[name, n]:10.3f}' for n in taps)}")
        ratios.append(f"{name:38}{''.join(f'{us[name, n] / us[first, n]:10.2f}' for n in taps)}")
    return "\n".join([*lines, "", *ratios])


def real_time_taps(rows: list[dict[str, Any]], name: str, fs: float) -> int | None:
    """Return the most taps at which a sample of a variant is over before the next."""
    fits = [row["taps"] for row in rows if row["variant"] == name and row["us_per_sample"] < 1e6 / fs]
    return max(fits, default=None)


def figure(result: dict[str, Any]) -> Figure:
    """Draw the time of a sample against the taps, both logarithmic."""
    drawing, axes = new_figure((8.5, 5.5))
    ax = axes[0, 0]
    rows = result["rows"]
    for name in dict.fromkeys(row["variant"] for row in rows):
        taps, us = zip(*[(r["taps"], r["us_per_sample"]) for r in rows if r["variant"] == name], strict=True)
        ours = name in variants.OURS
        ax.loglog(taps, us, "o-" if ours else "s:", lw=1.8 if ours else 1.0, ms=4, label=name)
    limit = [3 * n**2 / result["dgemm_gflops"] / 1e3 for n in TAPS]
    ax.loglog(TAPS, limit, "k--", lw=1.0, label="3 L² flops at the rate of dgemm")
    for fs in REAL_TIME_FS:
        ax.axhline(1e6 / fs, color="0.6", lw=0.8)
        ax.annotate(f"real time\nat {fs / 1e3:g} kHz", (TAPS[0] / 1.9, 1e6 / fs), va="bottom", fontsize=8, color="0.3")
    ax.set_xlim(left=TAPS[0] / 2)  # room for these labels beside the data
    ax.set(xlabel="taps L of the control filter", ylabel="time a sample (µs)", xticks=TAPS, xticklabels=TAPS)
    ax.minorticks_off()
    ax.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return drawing


def table(result: dict[str, Any]) -> str:
    """Return what was measured for the terminal."""
    rows = result["rows"]
    lines = [f"{'µs a sample':32}" + "".join(f"{n:>10}" for n in TAPS)]
    cell = {(row["variant"], row["taps"]): row for row in rows}
    names = list(dict.fromkeys(row["variant"] for row in rows))
    for title, key, form in (
        ("", "us_per_sample", "{:.4g}"),
        ("of the limit (3 L² flops at dgemm)", "limit_fraction", "{:.0%}"),
        ("times as fast as filterpy", "times_filterpy", "{:.3g}"),
        ("times as fast as numpy rank-1", "times_numpy", "{:.3g}"),
    ):
        lines += [f"\n{title}"] if title else []
        for name in names:
            shown = (form.format(cell[name, n][key]) if (name, n) in cell else "-" for n in TAPS)
            lines.append(f"{name:32}" + "".join(f"{text:>10}" for text in shown))
    return "\n".join(lines)


def remarks(result: dict[str, Any]) -> list[str]:
    """Return what the table does not say."""
    rows = result["rows"]
    us = {(row["variant"], row["taps"]): row["us_per_sample"] for row in rows}
    shared = f"closed loop, each of {variants.SCENARIOS} KF-OPC"
    real_time = (
        f"{name} at {fs / 1e3:g} kHz: {real_time_taps(rows, name, fs)}"
        for name in ("closed loop, KF-OPC", "stepped from Python, KF-OPC", "filterpy API of KFOPC", "filterpy")
        for fs in REAL_TIME_FS
    )
    missing = [name for name in variants.PEERS if (name, TAPS[0]) not in us]
    return [
        f"dgemm, one thread: {result['dgemm_gflops']:.1f} GFLOP/s.",
        f"Most taps timed that run in real time, {'; '.join(real_time)}.",
        *(
            f"{name} stepped from Python takes {us[f'stepped from Python, {name}', 128]:.1f} µs a sample at 128 taps, "
            f"in the compiled loop {us[f'closed loop, {name}', 128]:.1f} µs."
            for name in variants.CONTROLLERS
        ),
        f"KF-PB takes {us['closed loop, KF-PB', 256] / us['closed loop, KF-OPC', 256]:.2f} times as long as KF-OPC at 256 taps.",
        f"{variants.SCENARIOS} scenarios that share gains, at 256 taps: "
        f"{us['closed loop, KF-OPC', 256] / us[shared, 256]:.1f} times faster than as many runs.",
        *(
            f"One sample of the filterpy API, {w['taps']} taps, {WORST_SAMPLES:,} samples: "
            f"median {w['median_us']:.1f} µs, 99.99 % within {w['percentile_99_99_us']:.1f} µs, worst "
            f"{w['worst_us']:.0f} µs (with interruptions by the operating system). While S/q exceeds 1e3, after a large "
            f"P(0|0): {w['first_samples_us']:.0f} µs."
            for w in result["worst_sample"]
        ),
        f"{' and '.join(OTHER_RECURSIONS)}: another recursion, with forgetting in place of state noise.",
        *([f"Not installed, left out: {', '.join(missing)}; they come with the extra bench."] if missing else []),
    ]


def main(folder: Path, quiet: bool = False) -> int:
    """Measure, print, and write speed.json and speed.png into a folder."""
    from textwrap import fill

    from threadpoolctl import threadpool_limits
    from tqdm import tqdm

    rates, rows, worst, others = [], [], [], {}
    measures: dict[str, Callable[[], Any]] = {
        "beside_filterpy": times_beside_filterpy,
        "channels": channel_times,
        "blocks": block_times,
        "long": long_times,
    }
    planned = len(TAPS) * ROUNDS + len(WORST_TAPS) + len(measures)
    with threadpool_limits(1), tqdm(total=planned, disable=quiet, unit="round") as bar:
        for taps in TAPS:
            bar.set_description(f"speed, {taps} taps")
            rate, best = measure(taps, tick=bar.update)
            rates.append(rate)
            rows += rows_of(taps, rate, best)
        for taps in WORST_TAPS:
            bar.set_description(f"speed, worst of {WORST_SAMPLES:,} samples, {taps} taps")
            worst.append(worst_sample(taps) | {"first_samples_us": first_samples_us(taps)})
            bar.update()
        for name, work in measures.items():
            bar.set_description(f"speed, {name.replace('_', ' ')}")
            others[name] = work()
            bar.update()
    result = {"dgemm_gflops": max(rates), "rows": rows, "worst_sample": worst} | others
    write_whole(folder / "speed.json", json.dumps(result, indent=1) + "\n")
    with replacing(folder / "speed.png") as file:
        figure(result).savefig(file, dpi=150)
    print(
        table(result),
        channel_table(others["channels"]),
        table_beside_filterpy(others["beside_filterpy"]),
        block_table(others["blocks"]),
        long_table(others["long"]),
        "\n".join(fill(f"- {line}", 110, subsequent_indent="  ") for line in remarks(result)),
        sep="\n\n",
    )
    print(f"\n{folder / 'speed.json'} and speed.png written")
    return 0
