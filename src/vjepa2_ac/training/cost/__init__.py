"""What does a run cost before it is started: trained parameters, memory, arithmetic? Computed without torch."""
