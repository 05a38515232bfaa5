"""Recording: demonstrations of the simulated arm."""
