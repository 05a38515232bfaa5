"""Goals from demonstrations: key frames, sub-goals, and the nearest demonstration."""
