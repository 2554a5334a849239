"""What studies and sweeps share: scenes, the registry of algorithms, the tuning rule, reports."""
