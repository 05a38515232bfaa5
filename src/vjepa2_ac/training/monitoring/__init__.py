"""Monitoring: how fast is training, and does it diverge?"""
