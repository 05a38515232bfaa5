"""KV cache: the keys and values of every layer for earlier steps, computed once."""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor


class KeyValueCache:
    """The keys (rotated) and values of earlier steps, in every layer of a predictor; empty at first.

    Gradients flow through it into the passes that filled it. It stores the pieces as they were added: a block
    concatenates them while it computes, so that with gradient checkpointing no step is stored twice.
    """

    def __init__(self, pieces: tuple[tuple[Tensor, ...], ...] = ()) -> None:
        self._pieces = pieces  # of each layer

    @property
    def tokens(self) -> int:
        """Number of tokens in the cache."""
        return sum(piece.shape[3] for piece in self._pieces[0]) if self._pieces else 0

    def layer(self, index: int) -> tuple[Float[Tensor, "2 batch heads _ head_dim"], ...]:
        """Return the keys and values of a layer, piece by piece."""
        return self._pieces[index] if self._pieces else ()

    def append(self, added: Sequence[Float[Tensor, "2 batch heads tokens head_dim"]]) -> None:
        """Add keys and values of further tokens, one piece for every layer."""
        before = self._pieces or ((),) * len(added)
        self._pieces = tuple((*pieces, piece) for pieces, piece in zip(before, added, strict=True))

    def copy(self) -> KeyValueCache:
        """Return a cache that can grow independently; no tensor is copied."""
        return KeyValueCache(self._pieces)

    def expanded(self, samples: int) -> KeyValueCache:
        """Return the cache of one start expanded to many samples; no tensor is copied.

        Raises:
            RuntimeError: It holds more than one start.
        """
        return KeyValueCache(tuple(tuple(one.expand(-1, samples, -1, -1, -1) for one in own) for own in self._pieces))
