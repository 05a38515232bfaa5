"""Filters: which episodes and steps are used."""
