"""Sweeps: a grid of values and seeds, a row for each run."""
