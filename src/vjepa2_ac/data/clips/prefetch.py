"""Prefetching of batches to the device: loaded in advance, their events reported only when their turn has come."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, replace

from vjepa2_ac.data.clips.streams import Copies
from vjepa2_ac.data.filters.broken_episodes import BrokenEpisodes
from vjepa2_ac.episode import Batch, Skipped
from vjepa2_ac.errors import UserError


@dataclass(frozen=True)
class MicroBatch:
    """A worker's result for one micro-batch."""

    batch: Batch
    skipped: tuple[Skipped, ...] = ()

    def pin_memory(self) -> MicroBatch:
        """Return it in pinned memory; DataLoader calls a method of this name to pin."""
        return replace(self, batch=self.batch.pin_memory())


def prefetch_next(batches: Iterator[Batch]) -> None:
    """Prefetch the next batch if these batches support it: to be called before the host waits for the device."""
    if hasattr(batches, "prefetch_next"):
        batches.prefetch_next()


class Batches(Iterator[Batch]):
    """The batches of a loader, in order, each being copied to the device since it was fetched.

    They stay on the host; a copy on the device is in `on_device`. A batch's error and its skipped clips are reported
    when it is requested, not when it is prefetched: a checkpoint in between must not contain them.

    Args:
        rows: The workers' results: micro-batches, or errors instead.
        broken: Records clips that could not be read.
        copies: How batches are copied to the device; without overlap there are no copies and no prefetching.
        replayed: Records those of the second data set.
    """

    def __init__(
        self,
        rows: Generator[MicroBatch | UserError, None, None],
        broken: BrokenEpisodes,
        copies: Copies,
        replayed: BrokenEpisodes | None = None,
    ) -> None:
        self._rows, self._broken, self._copies = rows, broken, copies
        self._replayed = broken if replayed is None else replayed
        self._prefetched: Exception | MicroBatch | None = None

    def __next__(self) -> Batch:
        """Return the next batch.

        Raises:
            InputError: A clip cannot be read, also in a worker; or too many cannot.
        """
        fetched, self._prefetched = self._prefetched or self._fetched(), None
        if isinstance(fetched, Exception):
            self.close()
            raise fetched
        for one in fetched.skipped:
            (self._replayed if one.replayed else self._broken).met(one.episode_id, one.reason)
        return fetched.batch

    def prefetch_next(self) -> None:
        """Fetch the next batch and start its copy to the device."""
        if self._copies.overlap and self._prefetched is None:
            self._prefetched = self._fetched()

    def close(self) -> None:
        """End the workers and drop the prefetched batch."""
        self._prefetched = None
        self._rows.close()

    def _fetched(self) -> Exception | MicroBatch:
        try:
            row = next(self._rows)
            if isinstance(row, UserError) or not self._copies.overlap:
                return row
            on_device = _take_once(self._copies.to_device.start(row.batch.mapped))
        except Exception as error:  # also the end of the rows
            return error
        return replace(row, batch=replace(row.batch, on_device=on_device))


def _take_once(taken: Callable[[], Batch]) -> Callable[[], Batch | None]:
    """Return a function that returns a copy once and drops it, so that its memory is freed after use."""
    held = [taken]
    return lambda: held.pop()() if held else None
