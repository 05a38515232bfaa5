"""The cost of a run before it starts: trained parameters and FLOPs by arithmetic, memory measured on fake tensors."""
