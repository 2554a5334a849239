"""The tables of docs/filterpy.md: each line of code runs with filterpy's filter and with KFOPC, and does what its row says."""

from __future__ import annotations

import ast
import copy
import re
import warnings
from typing import Any

import filterpy
import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from helpers.pages import ROOT, table_of

from kfopc_filterpy import KFOPC

PAGE = (ROOT / "docs" / "filterpy.md").read_text(encoding="utf-8")
CODE = re.compile(r"`([^`]+)`")
STATE = ("x", "P", "y", "S", "K", "z", "x_post", "P_post")
names: dict[str, Any] = {}
exec(re.search(r"^```python\n(.*?)^```$", PAGE, re.M | re.S)[1], names)


def exactly(*values: Any) -> str:
    """Shapes and values, to the last digit; NaN equals NaN."""
    return repr([(np.shape(value), np.asarray(value).tolist()) for value in values])


def state_of(kf: Any) -> str:
    return exactly(*(getattr(kf, name) for name in STATE))


def run(kind: type, code: str) -> tuple[Any, Any, Any, Exception | None]:
    """Return the filter after the code and before its last statement, what that returned, and the error that ended it."""
    scope, value = names | {"kind": kind, "kf": names["make"](kind)}, None
    for statement in ast.parse(code).body:
        before = copy.deepcopy(scope["kf"])
        try:
            if isinstance(statement, ast.Expr):
                value = eval(ast.unparse(statement), scope)
            else:
                exec(ast.unparse(statement), scope)
        except Exception as error:  # noqa: BLE001 - the page says which
            return scope["kf"], before, None, error
    return scope["kf"], before, value, None


def outcome(kind: type, code: str) -> str:
    """Return in the words of the page what a filter is after the code."""
    kf, before, _, error = run(kind, code)
    if error is not None:
        name = f"`{type(error).__name__}`" if issubclass(kind, KFOPC) else "an error"
        return name if state_of(kf) == state_of(before) else f"{name}, half-way"
    x, P = np.asarray(kf.x), np.asarray(kf.P)
    if x.dtype.kind in "cO":
        return {"c": "complex numbers in `x`", "O": "objects in `x`"}[x.dtype.kind]
    if isinstance(kf.x, np.ma.MaskedArray):
        return "`x` is a masked array"
    for name in ("x", "K"):
        if np.shape(getattr(kf, name)) != np.shape(getattr(before, name)):
            return f"`{name}` of shape {np.shape(getattr(kf, name))}"
    if not (np.isfinite(x).all() and np.isfinite(P).all()):
        return "NaN or Inf"
    if not np.allclose(P, P.T) or np.linalg.eigvalsh(P)[0] < -1e-6:
        return "`P` is no covariance"
    return "computes"


def require_outcome(kind: type, code: str, cell: str) -> None:
    """The code does with a filter of this kind what the cell says."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numpy's, of overflow and of imaginary parts that are dropped
        warnings.filterwarnings("error", "Conversion of an array with ndim > 0")  # an error from numpy 2.4 on
        if not cell.startswith("as `"):
            assert outcome(kind, code) == cell, code
            return
        (like,) = CODE.findall(cell)
        kf, _, _, error = run(kind, code)
        other, _, _, failed = run(KalmanFilter, like)
    assert (error, failed) == (None, None), code
    for name in ("x", "P"):  # to rounding: the same matrix may be an argument or a number, or have a row of zeros
        np.testing.assert_allclose(getattr(kf, name), getattr(other, name), rtol=1e-14, atol=1e-15, err_msg=code)


EXCEPTIONS = table_of(PAGE, "Exceptions")
SAME = [code for row in table_of(PAGE, "As in filterpy, although it may surprise") for code in CODE.findall(row[0])]


@pytest.mark.parametrize("row", EXCEPTIONS, ids=lambda row: CODE.findall(row[0])[0])
def test_an_exception_is_as_the_page_says(row: list[str]) -> None:
    codes, theirs, ours, why = CODE.findall(row[0]), *row[1:]
    assert all([codes, why]), "a row has code and a reason"
    theirs, _, version = theirs.partition(" in ") if re.search(r" in [12]\.\d\.\d$", theirs) else (theirs, "", "")
    for code in codes:
        require_outcome(KFOPC, code, ours)
        if version in ("", filterpy.__version__):
            require_outcome(KalmanFilter, code, theirs)
        elif ours.startswith("as "):  # the other version does the same
            require_outcome(KalmanFilter, code, ours)


@pytest.mark.parametrize("code", SAME)
def test_what_may_surprise_is_as_in_filterpy(code: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        (kf, _, value, error), (ours, _, own_value, own_error) = run(KalmanFilter, code), run(KFOPC, code)
    assert (error, own_error) == (None, None)
    assert state_of(kf) == state_of(ours)
    each, own = (one if isinstance(one, tuple) else (one,) for one in (value, own_value))
    assert exactly(*each) == exactly(*own)
