"""The world model: frames become latents, and latents and actions become the latents of the next step."""
