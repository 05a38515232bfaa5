"""The adapter: LoRA on the predictor's layers, its initialisation, files and merging."""
