"""Words that newcomers search for, and the page that answers: entries of the index, which the search ranks first."""

from __future__ import annotations

from typing import Any

WORDS = {
    "install": ("install", "pip", "Windows", "macOS", "requirements"),
    "index": ("cite", "licence"),
    "formats": ("save", "checkpoint", "WAV", "MATLAB", "CSV", "HDF5", "sample rate", "recording"),
    "constraint": ("rated power", "limiter", "constraint factor"),
    "limits": ("limitations", "diverges"),
    "algorithms": ("FxLMS", "RLS", "algorithm"),
    "theory": ("Kalman", "equations"),
    "symbols": ("symbols", "notation"),
    "filterpy": ("filterpy",),
    "realtime": ("real time", "sound card", "latency"),
    "embedded": ("microcontroller", "board", "DSP", "C code", "FMU", "Simulink"),
    "speed": ("speed",),
    "benchmark": ("benchmark", "compare"),
    "peers": ("alternatives", "padasip"),
    "feedback": ("feedback", "headphone", "hybrid"),
    "uncertainty": ("uncertainty", "wrong path"),
    "tutorials/index": ("tutorial", "example"),
    "tutorials/noise_control": ("beginner", "noise reduction"),
    "tutorials/saturation": ("clipping", "amplifier"),
    "tutorials/many_loudspeakers": ("multichannel", "loudspeaker", "MIMO"),
    "tutorials/paths": ("secondary path", "identification", "measure"),
    "tutorials/verdict": ("verdict", "watt"),
    "tutorials/choosing": ("settings", "tuning", "state noise"),
    "tutorials/virtual_microphones": ("virtual microphone", "headrest"),
}


def add_words(app: Any, doctree: Any) -> None:
    """Add the words of a page to its index entries."""
    from docutils import nodes
    from sphinx import addnodes

    section = next(doctree.findall(nodes.section), None)
    if section is not None and (words := WORDS.get(app.env.docname)):
        entries = [("single", word, section["ids"][0], "main", None) for word in words]
        section.insert(0, addnodes.index(entries=entries))


def require_pages(app: Any, env: Any) -> None:
    """Warn of words whose page is not there."""
    from sphinx.util import logging

    for page in WORDS.keys() - env.found_docs:
        logging.getLogger(__name__).warning("words are listed for the page %s, which is not there", page)


def setup(app: Any) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("doctree-read", add_words)
    app.connect("env-check-consistency", require_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
