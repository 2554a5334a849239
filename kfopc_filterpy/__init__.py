"""Kalman filter with output power constraint (KF-OPC) for active noise control."""
