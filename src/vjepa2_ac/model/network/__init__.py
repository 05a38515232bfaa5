"""The network: encoder, predictor, and what they are made of."""
