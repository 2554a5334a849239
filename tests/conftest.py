"""Fixtures that any test may ask for, and the settings all tests run with."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# One BLAS thread in each worker and subprocess; set here, before anything imports numpy. On two cores, the threads of two
# workers wait for each other: that took a third of the time of some files.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MKL_NUM_THREADS", "1")
# Figures are drawn without a display, in subprocesses too; set before anything imports matplotlib.
os.environ.setdefault("MPLBACKEND", "Agg")

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

# The same examples on every run, and no deadline, since a first call may compile.
# For new random examples: `pytest --hypothesis-profile default`.
settings.register_profile(
    "ci", derandomize=True, deadline=None, database=None, print_blob=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("ci")

pytest.register_assert_rewrite("helpers")  # their assertions say what they compared, as those of the tests do

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A headless Chromium with a profile of its own; without one, the test is skipped.

    Its `until(condition)` waits for what a page does, as long as that takes on a busy machine.
    """
    webdriver = pytest.importorskip("selenium.webdriver", reason="needs selenium (the extra `test`)")
    pytest.importorskip("selenium.webdriver.support.wait")
    binary = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if binary is None or driver is None:
        pytest.skip("needs Chromium and its driver: apt-get install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = binary
    profile = tmp_path_factory.mktemp("profile")
    for argument in (
        "--headless",
        "--no-sandbox",
        "--disable-background-networking",
        "--disable-dev-shm-usage",
        "--window-size=1300,1000",
        f"--user-data-dir={profile}",
    ):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    chromium = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    chromium.set_script_timeout(600.0)
    chromium.until = webdriver.support.wait.WebDriverWait(chromium, 600.0).until
    yield chromium
    chromium.quit()


@pytest.fixture
def rng() -> np.random.Generator:
    """A random generator with the same seed in every test."""
    return np.random.default_rng(20241225)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of measured paths and noise: `KFOPC_DATA`, else `../shared/data` beside the checkout."""
    named = os.environ.get("KFOPC_DATA")
    folder = Path(named) if named else ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        setting = f"KFOPC_DATA={named}" if named else "KFOPC_DATA is not set"
        pytest.skip(f"no measured data: {setting}, and {folder} is not a folder")
    return folder


@pytest.fixture
def inside(tmp_path: Path) -> Iterator[Path]:
    """Be in a folder of the test's own."""
    with contextlib.chdir(tmp_path):
        yield tmp_path
