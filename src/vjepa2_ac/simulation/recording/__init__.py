"""Recording: how are demonstrations of the simulated arm made?"""
