"""The loop over samples, for one controller or for several that share gains."""
