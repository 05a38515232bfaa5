"""The simulated world: arm, block, cameras."""
