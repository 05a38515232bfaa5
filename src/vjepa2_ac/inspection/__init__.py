"""Inspection of data sets: checks, statistics, action coverage, duplicates, and comparison of readings with a model."""
