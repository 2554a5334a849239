"""The comparison of the package with an earlier version of itself."""
