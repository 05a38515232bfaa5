"""Closed loop: how well does a policy control the simulated arm?"""
