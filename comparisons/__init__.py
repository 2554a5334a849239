"""Studies of the KF-OPC paper, studies beyond it, sweeps and the speed study: `python -m comparisons`."""

from importlib.util import find_spec

if missing := [
    name for name in ("adafilt", "joblib", "padasip", "pooch", "pyroomacoustics") if find_spec(name) is None
]:
    from kfopc_filterpy._validate import how_to_install

    raise ImportError(f"the studies need {', '.join(missing)}: {how_to_install('studies')}")
