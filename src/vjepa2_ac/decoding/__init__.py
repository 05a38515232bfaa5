"""Latents to images: the decoder, its training, and imagined rollouts."""
