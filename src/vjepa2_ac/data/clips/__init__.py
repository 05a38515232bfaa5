"""Clips: how do episodes become batches, in which order?"""
