"""Features and distances of whole clips, for comparing videos: V-JEPA 2 features, FVD, LPIPS."""
