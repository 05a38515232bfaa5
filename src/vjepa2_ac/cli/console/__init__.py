"""Console output: progress bars, tables and lines of each command."""
