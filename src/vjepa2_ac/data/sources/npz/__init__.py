"""A folder of .npz episodes."""
