"""DROID as it was recorded: trajectory.h5, metadata, MP4."""
