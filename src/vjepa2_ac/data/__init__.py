"""Data sets as clips: sources, filters, clip order, inspection."""
