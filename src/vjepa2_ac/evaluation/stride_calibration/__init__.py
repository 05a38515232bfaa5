"""Stride calibration: at which stride does a model predict this data best?"""
