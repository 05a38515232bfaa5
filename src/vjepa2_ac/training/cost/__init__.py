"""The cost of a run before it starts: trained parameters, memory, FLOPs. Computed without torch."""
