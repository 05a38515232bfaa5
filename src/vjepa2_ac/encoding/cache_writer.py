"""Latent cache writer: one file per episode, written by any number of processes and finalized by one of them."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from vjepa2_ac import storage
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.idle import find_ranges
from vjepa2_ac.data.sources.latents.cache_key import CacheKey, Encoding
from vjepa2_ac.data.sources.latents.episode_file import EncodedEpisode, EpisodeLayout, write_episode_file
from vjepa2_ac.data.sources.latents.manifest import EPISODES, KEPT, MANIFEST, Manifest, path_of, size_column, size_of


@dataclass(frozen=True)
class CacheWriter:
    """Writes one cache into a folder. Several processes may each have one for the same folder.

    To resume after a kill, leave out the episodes that `has` knows: a file gets its final name when it is complete.
    """

    folder: Path
    key: CacheKey
    encoding: Encoding

    def has(self, number: int, camera: str) -> bool:
        """Return whether an episode, by its index in the data set, has been written."""
        return path_of(self.folder, number, camera).is_file()

    def write_episode(self, number: int, encoded: EncodedEpisode) -> int:
        """Write an episode of one camera and return the size of its file.

        Args:
            number: Index of the episode in the data set.
            encoded: Its latents, of the frames that `cache_lookup.needed_frames` names, in the type of the key.

        Raises:
            InputError: The folder cannot be written, or the disk is full.
        """
        layout = EpisodeLayout(self.key.digest, self.key.kind, self.encoding.tokens, self.encoding.dim)
        return write_episode_file(path_of(self.folder, number, encoded.camera), layout, encoded)

    def finish(self, dataset: Dataset, *, broken: Mapping[str, str], frames: int) -> Manifest:
        """Finalize the cache, when every episode with clips is written: one process does this, once.

        Args:
            dataset: The encoded data set, opened without a cache.
            broken: Identities of the episodes that could not be read (`data.broken_episodes` is skip), and why.
            frames: Number of encoded frames, of all cameras; for information.

        Raises:
            InputError: The folder cannot be written.
            ValueError: An episode is neither written nor broken.
        """
        sizes = self._sizes_without(broken, dataset)
        texts = {"control_rate_hz": str(dataset.control_rate_hz), "widths": " ".join(map(str, dataset.widths))}
        table = replace(dataset.table, locators=sizes, texts={**dataset.table.texts, **texts})
        files = {EPISODES: table.to_bytes()}
        if dataset.config.idle.rule != "none":
            files[KEPT] = find_ranges(dataset.source, dataset.table, dataset.config, None).to_bytes()
        manifest = Manifest(
            key=self.key.parts,
            digest=self.key.digest,
            tokens=self.encoding.tokens,
            dim=self.encoding.dim,
            control_rate_hz=dataset.control_rate_hz,
            episodes=len(table),
            encoded=int((np.stack(list(sizes.values())) > 0).all(axis=0).sum()),
            frames=frames,
            bytes=sum(int(column.sum()) for column in sizes.values()),
            broken=dict(broken),
            checksums={name: zlib.crc32(data) for name, data in files.items()},
            about={},
        )
        with storage.user_can_write(self.folder):
            for name, data in files.items():
                storage.write_atomically(self.folder / name, data)
            storage.write_atomically(self.folder / MANIFEST, manifest.to_text())
        return manifest

    def _sizes_without(self, broken: Mapping[str, str], dataset: Dataset) -> dict[str, Int64[np.ndarray, " episodes"]]:
        """Return the size of every file, a column for each camera.

        Raises:
            ValueError: One that clips need is missing, and its episode is not broken.
        """
        found = [dataset.table.find(name) for name in broken]
        unread = np.array([place for place in found if place is not None], np.int64)
        sizes = {}
        for place, camera in enumerate(dataset.config.cameras):
            paths = (path_of(self.folder, number, camera) for number in range(len(dataset.table)))
            column = np.array([size_of(path) or 0 for path in paths], np.int64)
            column[unread] = 0
            needed = dataset.starts.episodes
            missing = np.setdiff1d(needed[column[needed] == 0], unread)
            if len(missing):
                raise ValueError(f"{len(missing)} episodes are not written: {missing[:10].tolist()}")
            sizes[size_column(place)] = column
        return sizes
