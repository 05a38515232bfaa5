"""The HTML report of an evaluation: one page without network, scripts or other files."""
