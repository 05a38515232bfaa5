"""The world model: an encoder of frames to latents, and a predictor of the next latents from latents and actions."""
