"""filterpy 1.4.5's own tests, which only its source release has, with KFOPC in the place of KalmanFilter."""

from __future__ import annotations

import re
import subprocess
import sys
import types
import warnings
import zipfile
from pathlib import Path

import filterpy.kalman
import numpy as np
import pytest

from kfopc_filterpy import KFOPC

RELEASE = "filterpy==1.4.5 --hash=sha256:4f2a4d39e4ea601b9ab42b2db08b5918a9538c168cff1c6895ae26646f3d73b1"
# These fail with filterpy's own filter: its later version refuses their z, or numpy 2 and scipy refuse what they do.
FAIL_ALWAYS = {"test_imm: test_imm", "test_kf: test_noisy_1d", "test_kf: test_steadystate"}
FAIL = {
    "1.4.5": FAIL_ALWAYS
    | {"test_helpers: test_saver_kf", "test_helpers: test_saver_ekf", "test_ukf: test_batch_missing_data"},
    "2.0.0": FAIL_ALWAYS | {"test_helpers: test_kinematic_filter", "test_ukf: test_linear_rts"},
}


@pytest.fixture
def sources(tmp_path: Path) -> dict[str, str]:
    """The test modules that use a KalmanFilter, by name."""
    (tmp_path / "requirements.txt").write_text(RELEASE, encoding="utf-8")
    pip = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--no-binary", "filterpy"]
    options = ["--require-hashes", "--requirement", "requirements.txt"]
    ended = subprocess.run([*pip, *options], cwd=tmp_path, capture_output=True, text=True)
    if ended.returncode:
        assert "HASHES" not in ended.stderr, ended.stderr
        pytest.skip(f"filterpy's source release cannot be fetched: {ended.stderr.strip().splitlines()[-1]}")
    with zipfile.ZipFile(next(tmp_path.glob("*.zip"))) as release:
        names = [name for name in release.namelist() if re.search(r"/tests/test_\w+\.py$", name)]
        texts = {Path(name).stem: release.read(name).decode("utf-8") for name in names}
    return {name: text for name, text in texts.items() if re.search(r"\b(KalmanFilter|kinematic_kf)\b", text)}


def outcomes(sources: dict[str, str]) -> dict[str, Exception | None]:
    """Run every test of these modules; return the errors by the tests' names."""
    found: dict[str, Exception | None] = {}
    for stem, source in sources.items():
        module = types.ModuleType(stem)
        exec(compile(source, stem, "exec"), vars(module))
        for name in [name for name in vars(module) if name.startswith("test_")]:
            np.random.seed(1)  # noqa: NPY002 - they draw from it
            try:
                vars(module)[name]()
            except Exception as error:  # noqa: BLE001 - each is reported
                found[f"{stem}: {name}"] = error
            else:
                found[f"{stem}: {name}"] = None
    return found


@pytest.mark.slow
def test_what_passes_with_filterpys_filter_passes_with_KFOPC(
    sources: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        theirs = outcomes(sources)
        monkeypatch.setattr(filterpy.kalman, "KalmanFilter", KFOPC)
        ours = outcomes(sources)
    assert len(theirs) == len(ours) == 46
    assert {name for name, error in theirs.items() if error} == FAIL[filterpy.__version__]
    assert not {name: error for name, error in ours.items() if error and not theirs[name]}
    for name in ("test_kf: test_default_dims", "test_kf: test_z_checks"):
        assert ours[name] is None
