"""Filters: which episodes and steps take part?"""
