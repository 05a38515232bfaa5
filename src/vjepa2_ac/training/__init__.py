"""Training: setup of a run, optimizer step, validation, checkpoints and monitoring."""
