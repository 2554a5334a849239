"""What studies share: scenes, the registry of algorithms, the tuning rule, the report."""

from kfopc_filterpy.verdict.items import FigureItem, Sound, Table
from kfopc_filterpy.verdict.runs import AllDivergedError

from .merit import figures_of_merit
from .registry import Algorithm, algorithms, make_controller
from .report import results_table, write_report
from .scene import Runs, Scene, make_scene, with_clipping
from .study_report import Claim, Parameter, StudyReport, claims_sentence
from .tuning import Trial, Tuned, best_setting, run_setting, run_settings, try_settings, tune

__all__ = [
    "Algorithm",
    "AllDivergedError",
    "Claim",
    "FigureItem",
    "Parameter",
    "Runs",
    "Scene",
    "Sound",
    "StudyReport",
    "Table",
    "Trial",
    "Tuned",
    "algorithms",
    "best_setting",
    "claims_sentence",
    "figures_of_merit",
    "make_controller",
    "make_scene",
    "results_table",
    "run_setting",
    "run_settings",
    "try_settings",
    "tune",
    "with_clipping",
    "write_report",
]
