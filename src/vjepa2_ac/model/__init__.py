"""What does the network compute? Frames become latents, and latents and actions the latents of the next step."""
