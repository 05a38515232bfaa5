"""Processes and devices: how a run is launched, and how its processes work together."""
