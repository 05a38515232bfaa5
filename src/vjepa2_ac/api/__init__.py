"""The public functions: short ways into the other packages. `vjepa2_ac` itself gives their names."""
