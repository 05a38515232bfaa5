"""A data source in memory with synthetic episodes, which records how often they are read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from synthetic import synthetic_states
from vjepa2_ac.data.index import EpisodeProblem, EpisodeTable
from vjepa2_ac.episode import Episode, EpisodeInfo, Progress, StepRanges
from vjepa2_ac.errors import InputError


@dataclass
class MemorySource:
    """Episodes whose images identify their origin: every pixel is (episode, step, camera)."""

    lengths: Sequence[int]
    success: Sequence[bool | None] | None = None
    problems: Sequence[EpisodeProblem] = ()
    unreadable: frozenset[int] = frozenset()  # episodes for which `read` fails
    pictureless: frozenset[int] = frozenset()  # episodes for which `read_frames` fails
    fault: Callable[[str], InputError] = field(default=lambda where: InputError(where=where, found="damaged"))
    velocities: Callable[[int], np.ndarray | None] = field(default=lambda _: None)
    states: Callable[[int], np.ndarray] | None = None
    extrinsics: Callable[[int], np.ndarray | None] = field(default=lambda _: None)
    names: Sequence[str] | None = None
    reads: list[tuple[int, str | None, StepRanges | None]] = field(default_factory=list)
    decoded: list[tuple[int, int]] = field(default_factory=list)

    def infos(self, progress: Progress | None = None) -> EpisodeTable:
        """Return the episodes."""
        del progress
        return self._table

    @cached_property
    def _table(self) -> EpisodeTable:
        outcomes = self.success or [None] * len(self.lengths)
        names = self.names or [f"episode {number}" for number in range(len(self.lengths))]
        infos = [EpisodeInfo(*about) for about in zip(names, self.lengths, outcomes, strict=True)]
        return replace(EpisodeTable.from_infos(infos), problems=tuple(self.problems))

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:
        """Return an episode, and record the read."""
        self.reads.append((index, camera, needed))
        info = self._table[index]
        if index in self.unreadable:
            raise self.fault(f"memory: {info.id}")

        def frames(steps: Sequence[int]) -> np.ndarray:
            if index in self.pictureless:
                raise self.fault(f"memory: pictures of {info.id}")
            self.decoded += [(index, step) for step in steps]
            colour = len(camera or "")
            return np.array([np.full((4, 5, 3), (index % 256, step % 256, colour), np.uint8) for step in steps])

        states = synthetic_states(info.num_steps, seed=index) if self.states is None else self.states(index)
        return Episode(info, states, frames, 15.0, self.extrinsics(index), self.velocities(index))
