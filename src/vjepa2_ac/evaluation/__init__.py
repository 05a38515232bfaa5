"""Evaluation: how good is a model on held-out episodes?"""
