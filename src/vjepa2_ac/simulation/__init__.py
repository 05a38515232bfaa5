"""Simulation: robot data and a test without a robot, from a Franka-like arm in MuJoCo (extra `sim`)."""
