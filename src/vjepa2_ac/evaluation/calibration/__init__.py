"""Calibration: variants of the same clips, such as other strides or axes, are measured and compared."""
