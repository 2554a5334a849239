"""Studies of the KF-OPC paper, studies beyond it, sweeps and the speed study: `python -m comparisons`."""
