"""A run on disk: its folder, checkpoints, metrics log, lock, and its mirror elsewhere."""
