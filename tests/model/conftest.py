"""Tiny world models, and inputs that fit them."""

from model_fixtures import fresh, inputs, model, sizes  # noqa: F401 - fixtures for this folder
