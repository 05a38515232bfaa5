"""Films of what happened and what a model imagines: rows of frames, drawn as a film strip or an animation."""
