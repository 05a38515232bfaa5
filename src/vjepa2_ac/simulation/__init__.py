"""Simulation of a Franka-like arm in MuJoCo (extra `sim`): recording of data, and tests of models in closed loop."""
