"""Checkpoints of base models: downloaded, read and written by Meta's names."""
