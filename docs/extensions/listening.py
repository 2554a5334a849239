"""The page that plays: the C core as WebAssembly, noise and paths from Python, and the page's own scripts in one file."""

from __future__ import annotations

import base64
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from kfopc_filterpy import fx_nlms, kf_anc, kf_opc, kf_pb
from kfopc_filterpy.core.building import FLAGS, FOLDER
from kfopc_filterpy.export.joined import sources_of
from kfopc_filterpy.paths import Duct, duct_plant
from kfopc_filterpy.signals import band_limited_noise

PAGE = Path(__file__).resolve().parents[1] / "listen"
PLAYER, SCRIPT = PAGE / "player.c", "listen.js"
FS, SECONDS, BAND_HZ, TAPS = 8000, 8.0, (100, 1200), 128
RATES = (8000, 11025, 12000, 16000, 22050, 24000, 32000, 44100, 48000)
PEAK = 0.9  # of the noise, of full scale
NOISES = {"state_noise": 1e-9, "measurement_noise": 1e-3}  # the page sets its own
NOT_OF_WEBASSEMBLY = ("-shared", "-fPIC")


def sources() -> list[Path]:
    """Return the files of the core that the page needs, and its own."""
    return [PLAYER, *sources_of(PLAYER.read_text(encoding="utf-8"))]


def webassembly() -> bytes:
    """Return the core and the page's loop in single precision, compiled by zig."""
    flags = [flag for flag in FLAGS if flag not in NOT_OF_WEBASSEMBLY]
    target = ["-target", "wasm32-wasi", "-mexec-model=reactor", "-msimd128", "-DANC_FLOAT", f"-I{FOLDER}"]
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "player.wasm"
        command = [
            sys.executable,
            "-P",
            "-m",
            "ziglang",
            "cc",
            *flags,
            *target,
            "-Wl,--strip-all",
            *map(str, sources()),
        ]
        done = subprocess.run([*command, "-o", str(output)], capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"the core was not compiled to WebAssembly (is ziglang installed?): {done.stderr}")
        return output.read_bytes()


def scene() -> dict[str, Any]:
    """Return the noise, the paths and the controllers of the page."""
    noise = band_limited_noise(BAND_HZ, SECONDS, fs=float(FS), rng=3)
    integers = np.round(PEAK * 32767 * noise / np.abs(noise).max()).astype("<i2")
    plant = duct_plant(Duct(reflection=(0.2, -0.1)), fs=FS)
    controllers = {
        "off": (0, None),
        "FxNLMS": (1, fx_nlms(TAPS, plant, step_size=0.01)),
        "plain Kalman filter": (2, kf_anc(TAPS, plant, **NOISES)),
        "KF-OPC": (3, kf_opc(TAPS, plant, rated_power=1.0, **NOISES)),
        "KF-PB": (4, kf_pb(TAPS, plant, rated_power=1.0)),
    }
    defaults: dict[str, float] = {}
    chosen: dict[str, dict[str, Any]] = {}
    for name, (which, controller) in controllers.items():
        settings = settings_of(controller) if controller is not None else {}
        chosen[name] = {"which": which, "settings": list(settings)}
        defaults |= settings
    rates = {}
    for fs in RATES:
        of_budget = settings_of(kf_pb(TAPS, plant.secondary[0, 0], rated_power=1.0, fs=fs))
        constrained = kf_opc(TAPS, plant.secondary[0, 0], rated_power=1.0, fs=fs, **NOISES)
        rates[fs] = {name: of_budget[name] for name in ("block", "averaging", "window", "memory")}
        rates[fs]["rate"] = float(constrained._block.fields["constraint"].ravel()[1])
    return {
        "fs": FS,
        "noise": base64.b64encode(integers.tobytes()).decode(),
        "primary": plant.primary[0, 0].astype(np.float32).tolist(),
        "secondary": plant.secondary[0, 0].astype(np.float32).tolist(),
        "controllers": chosen,
        "defaults": defaults,
        "rates": rates,
    }


def settings_of(controller: Any) -> dict[str, float]:
    """Return the settings of a controller as the core takes them, in its order."""
    block = controller._block
    return {name: float(block.fields[name].ravel()[0]) for name, _ in block.algorithm.settings}


def write_script(folder: Path) -> Path:
    """Write all that the page loads as one script into a folder, and return its path."""
    worklet, page = ((PAGE / name).read_text(encoding="utf-8") for name in ("worklet.js", SCRIPT))
    made = scene() | {"wasm": base64.b64encode(webassembly()).decode(), "worklet": worklet}
    path = folder / SCRIPT
    path.write_text(f"const LISTEN = {json.dumps(made)};\n{page}", encoding="utf-8")
    return path


def write_for_build(app: Any) -> None:
    """Write the script beside the pages."""
    if app.builder.format == "html":
        static = Path(app.outdir) / "_static"
        static.mkdir(parents=True, exist_ok=True)
        write_script(static)


def setup(app: Any) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("builder-inited", write_for_build)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
