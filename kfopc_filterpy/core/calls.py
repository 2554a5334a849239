"""Functions of the core that Python calls: limiter, powers, amplifiers. They keep the interpreter's lock."""

from __future__ import annotations

from .library import load

_held = load().held
preview, commit = _held.anc_preview, _held.anc_commit
limit, limit_all, amplify_all = _held.anc_limit, _held.anc_limit_all, _held.anc_amplify_all
