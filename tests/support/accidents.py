"""Accidents of a file: what disks, copies and editors do to it."""

import numpy as np


def mutated(data: bytes, generator: np.random.Generator) -> bytes:
    """Return bytes after one accident: a flipped bit, a foreign, lost, repeated or blank stretch, an early end."""
    start = int(generator.integers(len(data)))
    end = min(len(data), start + int(2 ** generator.uniform(0, 12)))
    middle = {
        "flip": bytes([data[start] ^ 1 << int(generator.integers(8))]) + data[start + 1 : end],
        "foreign": generator.bytes(end - start),
        "lost": b"",
        "twice": data[start:end] * 2,
        "blank": bytes(end - start),
        "cut": None,
    }[str(generator.choice(["flip", "foreign", "lost", "twice", "blank", "cut"]))]
    return data[:start] if middle is None else data[:start] + middle + data[end:]
