"""Fixtures of the tests of explore."""

from decoders import whole_decoder  # noqa: F401
from explored import live, recorded  # noqa: F401
