"""Sources: readers of episodes, one per form of data."""
