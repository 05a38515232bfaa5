"""A prior of actions: a small network that says, without a search, what to do next and how sure it is."""
