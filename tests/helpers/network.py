"""A web server on this machine that stands in for the public source of the measured data."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Event, Thread

import pytest

from kfopc_filterpy.signals import datasets, list_datasets

HOST = "https://raw.githubusercontent.com"  # where the measured data are published


def publish(folder: Path, monkeypatch: pytest.MonkeyPatch, *, host: str = HOST) -> None:
    """Make the files that `folder` has the published ones: their hashes are pinned, and `host` is their source."""

    def published(file: datasets.DatasetFile) -> datasets.DatasetFile:
        path = folder / file.name
        sha256 = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else file.sha256
        return replace(file, sha256=sha256, url=host + "/" + file.url.split("/", 3)[3])

    for dataset in list_datasets():
        copied = replace(dataset, files=tuple(map(published, dataset.files)))
        monkeypatch.setitem(datasets._DATASETS, dataset.name, copied)


class Source:
    """A server of a folder's files by name. `asked` has the paths asked for, `fault` how it answers: by a method's name."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.asked, self.fault, self.finished = folder, [], "whole", Event()

    def content(self, path: str) -> bytes:
        (file,) = (file for file in self.folder.glob("*/*") if file.name == path.rsplit("/", 1)[1])
        return file.read_bytes()

    def whole(self, handler: BaseHTTPRequestHandler) -> None:
        self.answer(handler, self.content(handler.path))

    def changed(self, handler: BaseHTTPRequestHandler) -> None:
        self.answer(handler, self.content(handler.path)[:-1] + b"x")

    def cut(self, handler: BaseHTTPRequestHandler) -> None:
        content = self.content(handler.path)
        self.answer(handler, content[: len(content) // 2], length=len(content))

    def cut_of_unknown_length(self, handler: BaseHTTPRequestHandler) -> None:
        content = self.content(handler.path)
        self.answer(handler, content[: len(content) // 2], length=None)

    def missing(self, handler: BaseHTTPRequestHandler) -> None:
        handler.send_error(404)

    def silent(self, handler: BaseHTTPRequestHandler) -> None:
        self.finished.wait(30)

    @staticmethod
    def answer(handler: BaseHTTPRequestHandler, content: bytes, length: int | None = -1) -> None:
        handler.send_response(200)
        if length is not None:
            handler.send_header("Content-Length", str(len(content) if length < 0 else length))
        handler.end_headers()
        handler.wfile.write(content)


@contextmanager
def serving(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Source]:
    """Serve the files of `folder` on 127.0.0.1 as the published ones. pooch's cache is a new folder beside them."""
    pooch = pytest.importorskip("pooch")
    source = Source(folder)

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            source.asked.append(self.path)
            getattr(source, source.fault)(self)

        def log_message(self, *_: object) -> None:
            pass

    proxies = ("http_proxy", "https_proxy", "all_proxy")
    for name in (*proxies, *map(str.upper, proxies), "KFOPC_DATA"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pooch, "os_cache", lambda name: folder / "cache" / name)
    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        server.daemon_threads = True
        publish(folder, monkeypatch, host=f"http://127.0.0.1:{server.server_port}")
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield source
        finally:
            source.finished.set()
            server.shutdown()
            thread.join()
