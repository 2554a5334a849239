"""Print what breaks without each constant of KF-PB: ``python tests/helpers/budget_ablation.py [constant ...]``.

In a copy of the package, a constant of the C core gets a value that takes it out of effect, or makes it small. Then
KF-PB runs through the events and ten noises of its studies, with three loudspeakers, with two for one microphone, and
with an amplifier that clips peaks.
"""

from __future__ import annotations

import json
import os
import pickle
import re
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

ROOT = Path(__file__).resolve().parents[2]
if __name__ == "__main__" and "PYTHONPATH" not in os.environ:
    sys.path.insert(0, str(ROOT))

from comparisons.studies import events  # noqa: E402
from comparisons.studies import kf_pb_cases as study  # noqa: E402
from comparisons.studies.cases import FS  # noqa: E402
from kfopc_filterpy import (  # noqa: E402
    HardClipAmplifier,
    Plant,
    kf_pb,
    noise_reduction_db,
    power_constrained_wiener,
    simulate,
)
from kfopc_filterpy.core.library import load  # noqa: E402
from kfopc_filterpy.metrics import overshoot  # noqa: E402
from kfopc_filterpy.signals import band_limited_noise  # noqa: E402

WITHOUT = {  # the value that takes a constant out of effect, or makes it as small as is sensible
    "PLANNED": "1",
    "MOST": "1e9",
    "WINDOW_LASTS": "20",  # no longer than the block's power
    "BLOCK_LASTS": "4",  # as long as the window's power
    "SHORTER": "1",
    "GROWTH": "1e30",
    "FILTER_STEPS": "1",
    "LEAKED": "1e-7",  # no more than what keeps rounding away
    "DRAWS": "2",
    "LOUDER": "1e30",
    "SURPRISE": "1e9",
    "REDRAWN": "0.1",  # what is known before a surprise
    "HELD": "9",  # then it is REDRAWN
    "PLAYS_ON": "1",
    "PARTS_OF_BLOCK": "1",
    "PLANT_STEPS": "1",
}
CASES = (
    *(("duct", noise) for noise in ("compressor", "bursts", "swelling band noise", "recorded motor")),
    *(("measured duct", noise) for noise in ("compressor", "recorded motor")),
    ("duct", "compressor, 12 dB louder from 8 s on"),
    ("band-pass", "compressor, 10 dB louder for 4 s"),
    ("band-pass", "compressor, 12 dB softer from 8 s on"),
    ("band-pass", "band noise, then compressor"),
)


def cases() -> list[tuple[str, study.Rated]]:
    """Return the noises whose recordings are at hand, at a quarter of the power that full control needs."""
    plants, made = study.all_plants(), study.noises()
    usable = [(path, noise) for path, noise in CASES if path in plants and noise in made]
    return [
        (f"{noise} ({path})", study.make_rated(plants[path], made[noise][1](), study.SHARES[0]))
        for path, noise in usable
    ]


def three_loudspeakers() -> tuple[float, float]:
    """Return the noise reduction from the second second on, and the largest power over the rating."""
    rng, fs, taps, n = np.random.default_rng(0), 16000, 64, 6 * 16000
    s = rng.standard_normal((3, 3, taps)) * np.exp(-np.arange(taps) / 15) * (np.arange(taps) >= 5)
    x = np.convolve(rng.standard_normal(n), [1, 1.6, 0.9, 0, -0.4])[:n]
    p = rng.standard_normal((3, taps)) * np.exp(-np.arange(taps) / 30) * (np.arange(taps) >= 20)
    d = np.array([np.convolve(x, path)[:n] for path in p])
    rated = 0.02 * np.mean(d**2) * np.array([1.0, 2.0, 0.5])
    run = simulate(kf_pb(128, s, rated_power=rated, fs=fs), x, Plant(s, fs=fs), disturbance=d)
    power = np.mean(run.control_signal[:, n // 3 :] ** 2, axis=1) / rated
    return noise_reduction_db(run.error[:, fs:], d[:, fs:], steady=1.0), float(np.max(power))


def two_loudspeakers_for_one_microphone() -> tuple[float, float]:
    """Return the same with a rated power that is nearly enough for full control, which they can share in many ways."""
    rng, fs, n = np.random.default_rng(7), 8000.0, 48000
    s = rng.standard_normal((1, 2, 24)) * 0.85 ** np.arange(24) * (np.arange(24) >= 2)
    p = np.roll(rng.standard_normal(60) * 0.85 ** np.arange(60), 16) * (np.arange(60) >= 16)
    x = band_limited_noise((80, 2000), n / fs, fs=fs, rng=3)
    d = np.convolve(x, p)[:n] + 0.01 * rng.standard_normal(n)
    plant = Plant(s, fs=fs)
    full = power_constrained_wiener(x, plant, n_taps=48, disturbance=d, rated_power=1e6).whole.control_power
    rated = 0.9 * np.asarray(full)
    run = simulate(kf_pb(48, s, rated_power=rated, fs=fs), x, plant, disturbance=d)
    power = np.mean(run.control_signal[:, n // 3 :] ** 2, axis=1) / rated
    return noise_reduction_db(run.error[:, n // 3 :], d[np.newaxis, n // 3 :], steady=1.0), float(np.max(power))


def clipped_peaks() -> tuple[float, float, int]:
    """Return noise reduction, power and alarms with just enough power, and an amplifier that clips the highest peaks."""
    own = events.event("start, ample power")
    fs, rated = own.plant.fs, 0.42 * own.settings["rated_power"]  # which full control takes
    plant = Plant(events.SECONDARY, amplifier=HardClipAmplifier(3 * rated**0.5), fs=fs)
    controller = kf_pb(events.N_TAPS, Plant(events.SECONDARY, fs=fs), rated_power=rated)
    run = simulate(controller, own.reference, plant, disturbance=own.disturbance)
    heard = run.error[round(fs) :], own.disturbance[round(fs) :]
    return noise_reduction_db(*heard, steady=1.0), float(run.output_power) / rated, int(controller.alarms)


def measure(made: Path) -> dict[str, Any]:
    """Return the figures of all runs."""
    rows = [events.event_row(name, (0.75,)) for name in events.EVENTS]  # one delay: a run each
    of_events = {row.event: (row.lost_db[1:], row.loudest_tenth_db, row.power, row.alarms) for row in rows}
    of_cases = {}
    for name, case in pickle.loads(made.read_bytes()):
        controller = case.kf_pb(case.secondary)
        run = case.run(controller)
        power = overshoot(run.control_signal, case.rated_power, FS, window_s=10.0)
        of_cases[name] = case.reduction_db(run.error), power, int(controller.alarms)
    of_cases["three loudspeakers"] = *three_loudspeakers(), 0
    of_cases["two loudspeakers, one microphone"] = *two_loudspeakers_for_one_microphone(), 0
    of_cases["clipped peaks"] = clipped_peaks()
    return {"events": of_events, "cases": of_cases}


def measured_without(constant: str, folder: Path, made: Path) -> dict[str, Any]:
    """Return the figures of a package in which a constant does nothing."""
    tree = folder / (constant or "as it is")
    ignored = shutil.ignore_patterns("libanc-*", "__pycache__")
    for package in ("kfopc_filterpy", "comparisons"):
        shutil.copytree(ROOT / package, tree / package, ignore=ignored)
    core = tree / "kfopc_filterpy" / "core"
    for path in core.glob("*.[ch]"):
        text = path.read_text()
        changed = (
            re.sub(rf"\b{constant} = [^,; ]+", f"{constant} = {WITHOUT.get(constant)}", text) if constant else text
        )
        path.write_text(changed)
    subprocess.run([sys.executable, "-c", BUILD, str(core), load().level], check=True)
    environment = os.environ | {"PYTHONPATH": str(tree), "OPENBLAS_NUM_THREADS": "1"}
    run = subprocess.run(
        [sys.executable, __file__, "measure", str(made)], env=environment, check=True, capture_output=True, text=True
    )
    found: dict[str, Any] = json.loads(run.stdout)
    return found


# In a process of its own: the copy's builder names the copy's sources.
BUILD = """
import importlib.util, pathlib, sys
core = pathlib.Path(sys.argv[1])
spec = importlib.util.spec_from_file_location("building", core / "building.py")
own = importlib.util.module_from_spec(spec)
spec.loader.exec_module(own)
for level in {own.LEVELS[0], sys.argv[2]}:
    own.build(own.core_sources(), core / own.library_name("double", level), level=level)
"""


HEADING = f"""\
Against the law as it is: the most that is lost in a second, from the second one after an event on (dB), and in which event; the
change of the noise reduction of the noises, on average and at worst (dB), and of which. Loudest 100 ms of all events (dB); power
over any averaging time, and alarms, of all events and of all noises.
{"without":15}{"lost":>6} {"event":35}{"100 ms":>6}{"power":>7}{"":4}{"mean":>7}{"worst":>7} {"noise":44}{"power":>6}"""


def line(constant: str, own: dict[str, Any], usual: dict[str, Any]) -> str:
    """Return a row of the table: the most that is lost against the law as it is, and where."""
    lost = {name: max(np.subtract(row[0], usual["events"][name][0])) for name, row in own["events"].items()}
    gained = {name: row[0] - usual["cases"][name][0] for name, row in own["cases"].items()}
    event, case = max(lost, key=lambda name: lost[name]), min(gained, key=lambda name: gained[name])
    tenth = max(row[1] for row in own["events"].values())
    power = max(row[2] for row in own["events"].values()), max(row[1] for row in own["cases"].values())
    alarms = sum(row[3] for row in own["events"].values()), sum(row[2] for row in own["cases"].values())
    return (
        f"{constant or 'nothing':15}{lost[event]:6.1f} {event:35}{tenth:6.1f}{power[0]:7.3f}{alarms[0]:4}"
        f"{np.mean(list(gained.values())):+7.2f}{gained[case]:+7.2f} {case:44}{power[1]:6.3f}{alarms[1]:4}"
    )


def main(*names: str) -> None:
    """Print a line for each constant."""
    constants = names or tuple(WITHOUT)
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(os.cpu_count()) as pool:
        made = Path(folder, "cases.pkl")
        made.write_bytes(pickle.dumps(cases()))
        measured = pool.map(partial(measured_without, folder=Path(folder), made=made), ("", *constants))
        usual: dict[str, Any] = {}
        print(HEADING)
        for constant, own in tqdm(zip(("", *constants), measured, strict=True), total=1 + len(constants), disable=None):
            usual = usual or own
            tqdm.write(line(constant, own, usual), file=sys.stdout)


if __name__ == "__main__":
    if sys.argv[1:2] == ["measure"]:
        print(json.dumps(measure(Path(sys.argv[2]))))
    else:
        main(*sys.argv[1:])
