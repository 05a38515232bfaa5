"""The network: encoder, predictor, and their building blocks."""
