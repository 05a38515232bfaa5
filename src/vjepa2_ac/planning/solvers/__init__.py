"""Solvers: which actions cost least? CEM, iCEM, MPPI, gradient descent."""
