"""Draft a commented config for a data set and this machine (`vjepa2-ac init`)."""
