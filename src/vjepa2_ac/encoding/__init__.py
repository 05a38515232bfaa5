"""Encoding: building a latent cache, from frame selection and disk space to prefetching, batching and writing."""
