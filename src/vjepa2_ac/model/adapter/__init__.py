"""The adapter: LoRA around the predictor's layers, its start, its files, and merging."""
