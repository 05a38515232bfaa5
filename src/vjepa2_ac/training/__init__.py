"""Training: how do the weights change?"""
