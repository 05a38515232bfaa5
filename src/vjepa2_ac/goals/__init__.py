"""Goals from demonstrations: key frames and sub-goals."""
