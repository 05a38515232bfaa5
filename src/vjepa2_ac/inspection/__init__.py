"""Inspection of data sets: checks, statistics, coverage of actions, duplicates."""
