"""Processes and devices: how is a run launched, and how do its processes work together?"""
