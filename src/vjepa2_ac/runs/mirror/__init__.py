"""How is a run kept in another place, and how does it go on from there? `checkpoint.remote`."""
