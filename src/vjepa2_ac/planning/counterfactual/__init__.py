"""Actions that were not taken: named ones, or those of a file."""
