"""Functions of the core that Python calls: limiter, powers, amplifiers, covariance. They keep the interpreter's lock."""

from __future__ import annotations

from .library import load

_held = load().held
preview, commit = _held.anc_preview, _held.anc_commit
limit, limit_all, amplify_all = _held.anc_limit, _held.anc_limit_all, _held.anc_amplify_all
covariance_predict, covariance_update = _held.anc_covariance_predict, _held.anc_covariance_update
covariance_size, covariance_describe = _held.anc_covariance_size, _held.anc_covariance_describe
