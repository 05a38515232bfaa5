"""The mirror of a run in another place, and how the run resumes from it: `checkpoint.remote`."""
