"""Latent caches: one safetensors file per episode and camera, and an index."""
