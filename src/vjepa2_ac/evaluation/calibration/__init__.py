"""Calibration: k variants of the same clips, measured and compared. Beside the core, which does not import it."""
