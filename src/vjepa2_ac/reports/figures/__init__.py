"""Figures: what do results, data and plans look like? Drawn with matplotlib."""
