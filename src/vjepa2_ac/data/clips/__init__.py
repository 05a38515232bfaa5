"""Clips: how episodes become batches, and in which order."""
