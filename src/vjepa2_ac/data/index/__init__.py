"""The index of a data set: facts about every episode, and their cache."""
