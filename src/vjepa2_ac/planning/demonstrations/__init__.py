"""Goals from a demonstration: an episode of a data set, or a film."""
