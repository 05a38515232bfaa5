"""Fixtures of every test of the window."""

from decoders import whole_decoder  # noqa: F401
from explored import live, recorded  # noqa: F401
