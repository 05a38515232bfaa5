"""What the tests of this folder use."""

from decoders import encode_split, make_decoder, whole_decoder  # noqa: F401
