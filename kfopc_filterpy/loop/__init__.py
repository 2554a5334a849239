"""The plant, and the loop over samples, whole signals and scenarios."""
