"""Closed loop: how well does a policy steer the simulated arm?"""
