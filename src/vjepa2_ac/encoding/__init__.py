"""How is a cache of latents built? Which frames, how much room, decoded ahead of the encoder, written whole."""
