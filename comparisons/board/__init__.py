"""Exported controllers on an emulated microcontroller."""
