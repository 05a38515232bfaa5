"""Runs on disk: run folder, checkpoints, metrics log, lock, and the mirror on remote storage."""
