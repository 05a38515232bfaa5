"""State hashes: identify copies of an episode under another name by their measured states."""

from __future__ import annotations

import hashlib

import numpy as np
from jaxtyping import Float

UNKNOWN = 0  # of an episode whose states were not read, since no other is similar

_BYTES = 8


def hash_of_states(states: Float[np.ndarray, "steps state_dim"]) -> int:
    """Return 64 bits of the BLAKE2b of the states as float32, never `UNKNOWN`.

    As float32, since the same recording is float64 in one file and float32 in another. Rounding further would not make
    other roundings agree: a value at an edge of any grid may be rounded to either side.
    """
    return hash_of_bytes(f"{states.shape} ".encode() + (states.astype("<f4") + np.float32(0)).tobytes())  # -0 is 0


def hash_of_bytes(content: bytes) -> int:
    """Return 64 bits of the BLAKE2b of data that represents an episode's states, never `UNKNOWN`."""
    return int.from_bytes(hashlib.blake2b(content, digest_size=_BYTES).digest(), "big") or 1
