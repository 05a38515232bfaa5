"""The data cache: remote data that was fetched once and is stored on the local disk."""
