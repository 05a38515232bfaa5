"""The interactive page: a person drives a model's predictions in a browser."""
