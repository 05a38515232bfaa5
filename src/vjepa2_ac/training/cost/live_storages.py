"""Live storages: the bytes of tensors that exist at once, and of those that autograd saves."""

from __future__ import annotations

import weakref

from torch import Tensor


class LiveStorages:
    """Counts the bytes of storages from the first sight of a tensor until nothing refers to its storage.

    Args:
        block: Each storage is rounded up to a multiple of so many bytes, as an allocator does.
    """

    def __init__(self, block: int = 1) -> None:
        self.live = self.peak = 0
        self.saved = 0  # of what is live, what autograd was given to save
        self._block = block
        self._sizes: dict[int, int] = {}
        self._saved: dict[int, int] = {}

    def reset_peak(self) -> None:
        """Let the peak be what is live now."""
        self.peak = self.live

    def forget(self) -> None:
        """Leave out of all counts what is live now, also where autograd saves it later."""
        self._sizes = dict.fromkeys(self._sizes, 0)
        self._saved = dict.fromkeys(self._saved, 0)
        self.live = self.saved = self.peak = 0

    def hold(self, tensor: Tensor) -> None:
        """Count the storage of a tensor, if it is new."""
        storage = tensor.untyped_storage()
        key = storage._cdata
        if key not in self._sizes:
            self._sizes[key] = -(-storage.nbytes() // self._block) * self._block
            self.live += self._sizes[key]
            self.peak = max(self.peak, self.live)
            weakref.finalize(storage, self._let_go, key)

    def save(self, tensor: Tensor) -> Tensor:
        """Count the storage of a tensor that autograd saves; return the tensor."""
        self.hold(tensor)
        key = tensor.untyped_storage()._cdata
        if key not in self._saved:
            self._saved[key] = self._sizes[key]
            self.saved += self._sizes[key]
        return tensor

    def _let_go(self, key: int) -> None:
        self.live -= self._sizes.pop(key)
        self.saved -= self._saved.pop(key, 0)
