"""`python -m comparisons`: run the studies and write the report."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path

from kfopc_filterpy._writing import prepare_folder

from .bench import Runs, StudyReport, results_table, write_report
from .studies import duct

Study = tuple[Callable[[Runs], StudyReport | str], Callable[[], int]]


def _study(module: str, main: str = "main") -> Study:
    """Return a function of a study's module that runs it, and the one that counts its runs."""
    own = import_module(f".studies.{module}", __package__)
    return getattr(own, main), own.planned_runs


ALONE = {  # with options of their own
    "speed": ".speed.study",
    "sweep": ".sweep.study",
    "benchmark": ".benchmark.study",
    "data": ".bench.measured",
}
STUDIES = {name: _study(name) for name in ("tonal", "broadband", "duct")}
MEASURED: dict[str, Study] = {name: (partial(duct.measured, name=name), duct.planned_runs) for name in duct.MEASURED}
STUDIES["duct-measured"] = MEASURED.pop("duct-measured")
BEYOND_THE_PAPER = [
    "ways",
    "constraint",
    "kf_pb",
    "events",
    "loss_map",
    "rated_powers",
    "mismatch",
    "uncertain_path",
    "tracking",
]
BEYOND_THE_PAPER += ["amplifier", "multichannel"]
FURTHER = {f"{name}-authors": _study(name, "authors") for name in ("tonal", "broadband")} | MEASURED
FURTHER |= {name: _study(name) for name in BEYOND_THE_PAPER}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the studies named, all by default; write report.html, results.json, figures and audio into a folder."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments and arguments[0] in ALONE:
        status: int = import_module(ALONE[arguments[0]], __package__).main(arguments[1:])
        return status
    parser = argparse.ArgumentParser(
        prog="python -m comparisons", description="Reproduce the studies of the KF-OPC paper."
    )
    parser.add_argument(
        "studies",
        nargs="*",
        metavar="STUDY",
        help=f"{', '.join(STUDIES)}, by default all of these; beyond the paper: {', '.join(FURTHER)}; "
        "sweep, which runs a grid; speed, which times the filter beside others; benchmark, which scores controllers and "
        "others on the same tasks; or data, which fetches the measured data; these have options of their own (sweep --help)",
    )
    parser.add_argument("--output", type=Path, default=Path("studies"), help="folder to write into (default: studies)")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    options = parser.parse_args(arguments)
    known = (*STUDIES, *FURTHER, *ALONE)
    for name in ALONE:
        if name in options.studies:
            parser.error(f"{name} runs alone, and is named first: its options follow it")
    unknown = [name for name in options.studies if name not in known]
    if unknown:
        parser.error(f"no study called {', '.join(unknown)}; there are {', '.join(known)}")

    import matplotlib
    from tqdm import tqdm

    matplotlib.use("Agg")
    try:
        prepare_folder(options.output)
    except OSError as error:
        parser.error(str(error))
    reports: list[StudyReport] = []
    left_out: list[str] = []
    chosen = {name: (STUDIES | FURTHER)[name] for name in options.studies or STUDIES}
    planned = sum(planned_runs() for _, planned_runs in chosen.values())
    with tqdm(total=planned, unit="run", disable=options.quiet, dynamic_ncols=True) as bar:
        runs = Runs(bar)
        for name, (study, planned_runs) in chosen.items():
            bar.set_description(name)
            report = study(runs)
            if isinstance(report, str):
                bar.total -= planned_runs()
                tqdm.write(report)
                left_out.append(report)
            else:
                reports.append(report)
    if not reports:
        return 1
    reports[-1].notes.extend(left_out)  # the page would not show otherwise that something is missing
    page = write_report(reports, options.output)
    print(results_table(reports))
    print(f"\n{page}, with notes and all tables, and results.json written")
    return 0


if __name__ == "__main__":
    sys.exit(main())
