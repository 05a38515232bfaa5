"""Whether predictions are distributed as the truth: as varied, and alike in their second moments."""
