"""The soak: controllers that run for very long."""
