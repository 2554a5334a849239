"""Gives the readers of files what atheris makes of valid ones: `python tests/signals/fuzz_readers.py -max_total_time=60`.

A file is read, or refused by an error that names it, within 10 s and 1.5 GB; anything else ends the search, and atheris
writes the input that did it. Further arguments are those of libFuzzer. `nox -s fuzz` runs it for a minute.
"""

import sys
import tempfile
import warnings
from pathlib import Path

import atheris

TESTS = Path(__file__).parents[1]
sys.path[:0] = [str(TESTS.parent), str(TESTS), str(TESTS / "signals")]

with atheris.instrument_imports(include=["kfopc_filterpy.paths", "kfopc_filterpy.signals"]):
    from helpers.files import WRITERS
    from test_damaged_files import check, outcome

    from kfopc_filterpy.paths import read_path
    from kfopc_filterpy.signals import read_recording

NAMES = [name for name in WRITERS if not name.endswith(".mat")]  # each of these takes a process of its own


def read(data: bytes) -> None:
    """Read a file whose first byte chooses the format, as a recording and as a path."""
    if data:
        path = Path(folder.name) / NAMES[data[0] % len(NAMES)]
        path.write_bytes(data[1:])
        for reader in (read_recording, read_path):
            check(outcome(reader, path), path)


with tempfile.TemporaryDirectory() as corpus:
    for index, name in enumerate(NAMES):
        valid = Path(corpus) / name
        WRITERS[name](valid)
        valid.write_bytes(bytes([index]) + valid.read_bytes())
    warnings.simplefilter("error")
    folder = tempfile.TemporaryDirectory()
    limits = ["-timeout=10", "-rss_limit_mb=1500", "-max_len=20000"]
    atheris.Setup([sys.argv[0], *limits, *sys.argv[1:], corpus], read)
    atheris.Fuzz()
