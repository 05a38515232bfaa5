"""A keyed permutation of any size: maps an index to its position without storing the whole order."""

from __future__ import annotations

import hashlib
from functools import lru_cache

_ROUNDS = 8
_HALF_BITS = 3  # minimum: narrower halves favour some orders of few windows
_MASK64 = (1 << 64) - 1


def permuted(index: int, *, size: int, seed: int, epoch: int) -> int:
    """Return the image of an index under a keyed permutation of `range(size)`, which is never in memory.

    A Feistel network permutes the next power of four; results outside the range are permuted again until inside.
    """
    if not 0 <= index < size:
        raise ValueError(f"index {index} of {size}")
    half = max(_HALF_BITS, ((size - 1).bit_length() + 1) // 2)
    keys = _round_keys(size, seed, epoch)
    index = _feistel(index, half, keys)
    while index >= size:
        index = _feistel(index, half, keys)
    return index


def _feistel(value: int, half: int, keys: tuple[int, ...]) -> int:
    mask = (1 << half) - 1
    left, right = value >> half, value & mask
    for key in keys:
        left, right = right, left ^ (_mix(right ^ key) & mask)
    return left << half | right


def _mix(value: int) -> int:
    """Scatter 64 bits. Source: Steele, Lea, Flood (2014), SplitMix64 (constants of Stafford's variant 13)."""
    value = (value ^ value >> 30) * 0xBF58476D1CE4E5B9 & _MASK64
    value = (value ^ value >> 27) * 0x94D049BB133111EB & _MASK64
    return value ^ value >> 31


@lru_cache(maxsize=8)
def _round_keys(size: int, seed: int, epoch: int) -> tuple[int, ...]:
    digest = hashlib.blake2b(f"{size} {seed} {epoch}".encode(), digest_size=8 * _ROUNDS).digest()
    return tuple(int.from_bytes(digest[8 * number : 8 * number + 8], "big") for number in range(_ROUNDS))
