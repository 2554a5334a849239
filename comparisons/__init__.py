"""Reproductions of the three studies of the KF-OPC paper: `python -m comparisons`."""
