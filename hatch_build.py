"""Compile the core for a wheel or for an editable installation.

The machine's C compiler is taken, or where there is none, zig's, which pip then fetches as a wheel. `nox -s wheels`
sets KFOPC_TARGET, a machine in zig's words, and KFOPC_PLATFORM, the tag of its wheel, to build for other machines.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from packaging.tags import platform_tags

CORE = Path("kfopc_filterpy", "core")


def _load_building(root: str) -> Any:
    """Return the package's module that compiles, without importing the package."""
    spec = importlib.util.spec_from_file_location("building", Path(root, CORE, "building.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class CompileCore(BuildHookInterface):
    """Builds one library for each type of numbers and each level of the processor."""

    def dependencies(self) -> list[str]:
        """Return what pip has to fetch before the build."""
        return [] if _load_building(self.root).machine_compiler() else ["ziglang>=0.13"]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and say what the wheel contains."""
        building = _load_building(self.root)
        target = os.environ.get("KFOPC_TARGET", "")
        tag = os.environ.get("KFOPC_PLATFORM") or next(tag for tag in platform_tags() if _is_local(tag))
        build_data |= {"pure_python": False, "tag": f"py3-none-{tag}"}
        self._temporary = ""
        try:
            if version == "editable":
                self._build_in_place(building)
                return
            self._temporary = tempfile.mkdtemp()
            for library in building.build_core(Path(self._temporary), target):
                build_data["force_include"][str(library)] = (CORE / library.name).as_posix()
        except building.BuildError as error:
            self.app.abort(str(error))

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the libraries that the wheel now contains."""
        if self._temporary:
            shutil.rmtree(self._temporary, ignore_errors=True)

    def _build_in_place(self, building: Any) -> None:
        folder = Path(self.root, CORE)
        if not any(os.environ.get(name) for name in ("CC", "CFLAGS", "CPPFLAGS", "LDFLAGS")):
            names = [building.library_name(real, level) for real in building.REALS for level in building.levels()]
            if all(_is_current(building, folder / name) for name in names):
                return
        built = building.build_core(folder)
        for path in folder.glob("libanc-*"):
            if path not in built:
                path.unlink()


def _is_local(tag: str) -> bool:
    """Tell whether a tag promises no more than this machine: linux_x86_64, not manylinux or musllinux."""
    return "linux_" not in tag or tag.startswith("linux_")


def _is_current(building: Any, path: Path) -> bool:
    """Tell whether a library loads on this machine and was built from these sources."""
    try:
        return building.stamp_of(ctypes.CDLL(str(path))) == building.stamp()
    except OSError:
        return False
