"""The window: a page in which a person drives a model's imagination, and watches a robot that is served."""
