"""Solvers: the search for the action sequence of lowest cost. CEM, iCEM, MPPI, gradient descent."""
