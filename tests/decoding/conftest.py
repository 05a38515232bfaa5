"""Fixtures of the decoder tests."""

from decoders import encode_split, make_decoder, whole_decoder  # noqa: F401
