"""Figures of results, data and plans, drawn with matplotlib."""
