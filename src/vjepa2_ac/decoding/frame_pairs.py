"""The decoder's data: frames as the encoder saw them, and their latents, in files of a latent cache."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.sources.latents.cache_files import LatentFiles, unpack_latents
from vjepa2_ac.data.windows import spread
from vjepa2_ac.encoding.latent_cache import needed_frames
from vjepa2_ac.encoding.pipeline import FramesToEncode


@dataclass(frozen=True)
class Pairs:
    """Some frames, and the episode of each."""

    latents: Float[Tensor, "frames tokens dim"]
    images: UInt8[Tensor, "frames 3 size size"]  # what the encoder saw
    episode_ids: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class FramePairs:
    """Pairs in files, read by their number."""

    files: LatentFiles
    frames: tuple[FramesToEncode, ...]  # of each file; at least one
    episode_ids: tuple[str, ...]  # likewise

    @classmethod
    def of(cls, dataset: Dataset, wanted: Sequence[FramesToEncode], files: LatentFiles) -> FramePairs:
        """Return those of the wanted frames that could be encoded."""
        there = tuple(one for one in wanted if files.has(one.episode, one.camera))
        return cls(files, there, tuple(dataset.table.identity(one.episode) for one in there))

    @cached_property
    def _ends(self) -> Int[np.ndarray, " files"]:
        return np.cumsum([len(one.steps) for one in self.frames])

    def __len__(self) -> int:
        return int(self._ends[-1]) if self.frames else 0

    def read(self, numbers: Sequence[int]) -> Pairs:
        """Return pairs in the given order.

        Raises:
            InputError: A file is gone or damaged.
        """
        owners = np.searchsorted(self._ends, numbers, side="right").tolist()
        files = {owner: self.files.open(self.frames[owner].episode, self.frames[owner].camera) for owner in set(owners)}
        latents, images = list[Tensor](), list[Tensor]()
        for number, owner in zip(numbers, owners, strict=True):
            row = int(number - self._ends[owner]) + len(self.frames[owner].steps)
            latents.append(unpack_latents(files[owner].latents([row])))
            images.append(torch.from_numpy(files[owner].pictures([row])).permute(0, 3, 1, 2))
        ids = tuple(self.episode_ids[owner] for owner in owners)
        return Pairs(torch.cat(latents), torch.cat(images).contiguous(), ids)


def wanted_frames(dataset: Dataset, split: Split, *, frames: int) -> list[FramesToEncode]:
    """Return at most about this many frames of a split, spread over its episodes and cameras.

    They are among those that clips use: the decoder is to show clips. None, if the split has no clips.
    """
    members = dataset.members(split)
    needed = [one for one in needed_frames(dataset) if members[one.episode]]
    total = sum(len(one.steps) for one in needed)
    places, counted = np.linspace(0, total, min(frames, total), endpoint=False).astype(int), 0
    wanted = []
    for one in needed:
        count = int(((places >= counted) & (places < counted + len(one.steps))).sum())
        counted += len(one.steps)
        if count:
            steps = one.steps[spread(len(one.steps), count)]
            wanted.append(FramesToEncode(one.episode, one.camera, steps))
    return wanted
