"""Adaptive controllers for active noise control, one family a file."""
