"""The commands that show what latents hold, and what a model imagines."""
