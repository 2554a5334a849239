"""`kfopc data`: the public measured data."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

from .options import DONE, Parser, add_command
from .printing import warn

EXAMPLES = """examples:
  kfopc data list
  kfopc data fetch duct compressor
  kfopc data where"""


def add_to(commands: argparse._SubParsersAction[Parser]) -> None:
    """Add the subcommand."""
    about = "list or fetch the public measured data, or print their folder"
    parser = add_command(commands, "data", data, about, EXAMPLES)
    parser.add_argument("action", choices=("list", "fetch", "where"), help="what to do")
    parser.add_argument("name", nargs="*", help="data sets to list or fetch (default: all)")
    parser.add_argument("--folder", metavar="FOLDER", help="folder of the data, in place of KFOPC_DATA or the cache")
    parser.add_argument("--json", action="store_true", help="print JSON")


def data(options: argparse.Namespace) -> int:
    """List or fetch data sets, or print their folder."""
    from ..signals import dataset_folder, fetch_dataset, has_dataset, list_datasets

    known = {one.name: one for one in list_datasets()}
    for name in options.name:
        if name not in known:
            raise ValueError(f"there is no data set {name!r}; there are {', '.join(known)}")
    folder = str(options.folder or dataset_folder())
    is_named = options.folder or os.environ.get("KFOPC_DATA")
    if is_named and options.action != "fetch" and not Path(folder).is_dir():
        warn(options, f"the folder {folder} does not exist: correct --folder or KFOPC_DATA, or run kfopc data fetch")
    if options.action == "where":
        print(json.dumps({"folder": folder}) if options.json else folder)
        return DONE
    facts = {}
    for name in (name for name in known if name in options.name or not options.name):
        if options.action == "fetch":
            fetch_dataset(name, folder)
        one = known[name]
        facts[name] = {
            "title": one.title,
            "source": f"https://github.com/{one.repository}/tree/{one.commit}",
            "licence": one.licence,
            "fs": one.fs,
            "units": one.units,
            "here": has_dataset(name, folder),
        }
    if options.json:
        print(json.dumps(facts, indent=2))
        return DONE
    for name, fact in facts.items():
        here = f"in {folder}" if fact["here"] else "not there: run kfopc data fetch"
        print(f"{name}: {fact['title']}, {fact['fs']:g} Hz; licence: {fact['licence']}; {here}")
    return DONE
