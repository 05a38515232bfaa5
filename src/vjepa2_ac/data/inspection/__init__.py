"""Inspection: the content of a data set, and its errors."""
