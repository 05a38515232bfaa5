"""How does a latent cache become `Episode`s? One safetensors file for each episode and camera, and an index."""
