"""Sweeps: the Monte-Carlo engine."""
