"""A network that serves a folder to pooch."""

from __future__ import annotations

from pathlib import Path

import pytest


def serve(folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, float]]:
    """Serve the file that an address ends with to pooch, whose cache is a new folder; the requests: address, timeout."""
    pooch = pytest.importorskip("pooch")
    asked: list[tuple[str, float]] = []

    class Downloader:
        def __init__(self, timeout):
            self.timeout = timeout

        def __call__(self, url, output_file, _):
            asked.append((url, self.timeout))
            (path,) = (path for path in folder.glob("*/*") if path.name == url.rsplit("/", 1)[1])
            Path(output_file).write_bytes(path.read_bytes())

    monkeypatch.setattr(pooch, "HTTPDownloader", Downloader)
    monkeypatch.setattr(pooch, "os_cache", lambda name: folder / "cache" / name)
    return asked
