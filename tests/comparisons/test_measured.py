"""The measured duct and room, and their fetch from a server on this machine; no test reaches beyond it."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any
from urllib.parse import unquote

import numpy as np
import pooch
import pytest
import scipy.io

from comparisons.__main__ import main
from comparisons.bench import measured
from comparisons.bench.measured import PLACES, SHA256, DataUnavailableError, load_measured_duct, load_measured_room

EACH = range(1, 5)


# ---- The published files


def test_pinned_hashes_are_those_of_the_published_files(shared_data: Path) -> None:
    files = [name for name in SHA256 if (shared_data / name).is_file()]
    assert len(files) >= 4
    for name in files:
        assert hashlib.sha256((shared_data / name).read_bytes()).hexdigest() == SHA256[name]


@pytest.mark.parametrize("noise", measured.NOISES)
def test_published_ducts_have_their_known_contents(
    shared_data: Path, monkeypatch: pytest.MonkeyPatch, noise: str
) -> None:
    monkeypatch.setenv("KFOPC_DATA", str(shared_data))
    duct, author = load_measured_duct(noise), load_measured_duct(noise, "author")
    assert (duct.primary.shape, duct.secondary.shape, duct.fs) == ((1024,), (512,), 16000)
    assert (author.primary.shape, author.secondary.shape, author.fs) == ((800,), (800,), 16000)
    for (name, key), found in (
        *zip(measured.DUCTS["gfanc"], (duct.primary, duct.secondary), strict=True),
        *zip(measured.DUCTS["author"], (author.primary, author.secondary), strict=True),
        (measured.NOISES[noise], duct.noise),
        (measured.NOISES[noise], author.noise),
    ):
        np.testing.assert_array_equal(found, scipy.io.loadmat(shared_data / name)[key][:, 0])
    # The first author's paths have unit energy, and the noise arrives 23 samples after the loudspeaker's sound.
    assert np.sum(author.primary**2) == pytest.approx(1.0)
    assert np.sum(author.secondary**2) == pytest.approx(1.0)
    assert (np.argmax(np.abs(author.secondary)), np.argmax(np.abs(author.primary))) == (12, 35)
    # The secondary path gains 10 to 30 dB in the middle of 200 to 2000 Hz.
    gain_db = 20 * np.log10(np.abs(np.fft.rfft(duct.secondary, 4096)))[52:513]
    assert 10 < np.median(gain_db) < 30


# ---- Small files in their place


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Small files in place of the published ones, on a server: S{k}{j} holds k and j. The cache is a new folder."""
    contents = {"duct/Pz1": "Pz1", "duct/Sz": "S", "motor/Motor": "Motor_noise", "compressor/compressor_16kHz": "yr"}
    files = {f"{name}.mat": {key: [[1.0], [2.0], [3.0]]} for name, key in contents.items()}
    files["author/Path.mat"] = {"P": [[4.0], [5.0]], "S": [[6.0], [7.0]]}
    for name in (*(f"P{k}" for k in EACH), *(f"S{k}{j}" for k in EACH for j in EACH)):
        files[f"room4x4/{name}.mat"] = {name: [[float(digit)] for digit in f"{name[1:]:0<6}"]}  # six taps
    assert files.keys() == SHA256.keys()
    folder = tmp_path / "published"
    for name, content in files.items():
        path = folder / unquote(PLACES[name])
        path.parent.mkdir(parents=True, exist_ok=True)
        scipy.io.savemat(path, content)
        monkeypatch.setitem(SHA256, name, hashlib.sha256(path.read_bytes()).hexdigest())
    for name in ("http_proxy", "https_proxy", "all_proxy", "HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "KFOPC_DATA"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pooch, "os_cache", lambda name: tmp_path / "cache" / name)
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(SimpleHTTPRequestHandler, directory=folder)) as server:
        monkeypatch.setattr(measured, "HOST", f"http://127.0.0.1:{server.server_port}")
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield folder
        server.shutdown()
        thread.join()


def left_in(folder: Path) -> list[str]:
    """Return the names of all files in a folder."""
    return sorted(path.name for path in folder.rglob("*") if path.is_file())


def test_without_a_folder_each_file_is_fetched_once_to_the_cache(served: Path, tmp_path: Path) -> None:
    for _ in range(2):
        duct = load_measured_duct("motor")
        assert [duct.primary.tolist(), duct.secondary.tolist(), duct.noise.tolist()] == 3 * [[1.0, 2.0, 3.0]]
        author = load_measured_duct("motor", "author")
        assert [author.primary.tolist(), author.secondary.tolist()] == [[4.0, 5.0], [6.0, 7.0]]
        shutil.rmtree(served, ignore_errors=True)  # the second time, there is nothing to fetch
    assert left_in(tmp_path / "cache" / "kfopc_filterpy") == ["Motor.mat", "Path.mat", "Pz1.mat", "Sz.mat"]


def test_first_index_of_the_room_is_the_microphone_and_second_the_loudspeaker(served: Path) -> None:
    room = load_measured_room()
    assert room.primary[..., 0].tolist() == [[k] for k in EACH]
    assert room.secondary[..., :2].tolist() == [[[k, j] for j in EACH] for k in EACH]


def test_the_command_fetches_all_to_the_folder_that_is_named_and_nothing_else_does(
    served: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "measured"
    monkeypatch.setenv("KFOPC_DATA", str(folder))
    assert main(["data"]) == 0
    assert capsys.readouterr().out == f"{folder}\n"
    assert left_in(folder) == sorted(Path(name).name for name in SHA256)
    assert load_measured_room().secondary[3, 1, :2].tolist() == [4, 2]
    (folder / "duct" / "Sz.mat").unlink()
    with pytest.raises(DataUnavailableError, match=r"Sz\.mat is missing: python -m comparisons data fetches it"):
        load_measured_duct("compressor")
    (folder / "duct" / "Pz1.mat").write_bytes(b"measured by the user")
    with pytest.raises(SystemExit):
        main(["data"])
    assert "Pz1.mat is not at hand" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [(lambda path: path.write_bytes(b"other"), "does not match"), (Path.unlink, "404 Client Error")],
)
def test_a_fetch_that_fails_leaves_nothing(served: Path, tmp_path: Path, spoil: Any, reason: str) -> None:
    spoil(served / unquote(PLACES["duct/Pz1.mat"]))
    with pytest.raises(DataUnavailableError, match=rf"(?s)Pz1\.mat is not at hand \(.*({reason}).*\): set KFOPC_DATA"):
        load_measured_duct("motor")
    assert left_in(tmp_path / "cache") == []
