"""Rollouts of models, decoded and measured: what is needed for it, and the pass over the clips."""
