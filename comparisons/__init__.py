"""Studies of the KF-OPC paper, studies beyond it, sweeps and the speed study: `python -m comparisons`."""

from importlib.util import find_spec

if missing := [
    name for name in ("adafilt", "joblib", "padasip", "pooch", "pyroomacoustics") if find_spec(name) is None
]:
    raise ImportError(
        f"the studies need {', '.join(missing)}: install the extra `studies` in the clone, "
        'python -m pip install -e ".[studies]"'
    )
