"""How does the program look in a terminal? Progress bars, tables and lines, for each command."""
