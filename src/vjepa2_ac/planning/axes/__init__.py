"""Calibrated axes: how those in which a model infers moves lie to the robot's own."""
