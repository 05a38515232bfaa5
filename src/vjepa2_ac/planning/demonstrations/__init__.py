"""Goals from demonstrations: beside the core, for `vjepa2-ac goals` and the simulator."""
