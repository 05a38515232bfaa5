"""Export of a trained run: merged, in the official format, or as an adapter for the Hub."""
