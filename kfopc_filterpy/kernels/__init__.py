"""Compiled arithmetic that knows no acoustics."""
