"""Monitoring: how fast is training, and is it going wrong?"""
