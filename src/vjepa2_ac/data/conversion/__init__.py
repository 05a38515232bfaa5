"""Writing data sets in other forms."""
