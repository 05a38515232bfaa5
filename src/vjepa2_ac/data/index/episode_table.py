"""The episode table: facts about every episode of a data set, in a few bytes each.

DROID has 95,658 episodes: a list of as many objects is slow to load and to send to workers. This is columns instead.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, overload

import numpy as np
from jaxtyping import Int8, Int32, Int64, UInt8, UInt64

from vjepa2_ac.data.index.labels import Labels
from vjepa2_ac.data.index.packed_text import are_texts, pack_texts, text_of
from vjepa2_ac.episode import EpisodeInfo
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.npz_reader import read_arrays
from vjepa2_ac.storage.structured import json_object, record_of

FORMAT = 2  # of `to_bytes`: an index with another number is rebuilt

_UNKNOWN = -1
_LOCATOR, _LABEL = "locator.", "label."


class NotATableError(ValueError):
    """The bytes are not a table by `to_bytes`."""


@dataclass(frozen=True)
class EpisodeProblem:
    """An unusable episode, and the reason."""

    name: str  # its identity; if that cannot be read, its position
    where: str
    found: str
    needed: str = ""
    fix: str = ""


@dataclass(frozen=True, eq=False)
class EpisodeTable(Sequence[EpisodeInfo]):
    """The usable episodes of a data set, in the source's order, as columns.

    `locators` are columns of the source (the position of an episode); `labels` are an episode's groups, such as its
    scene; `texts` are small values of the whole data set.
    """

    num_steps: Int32[np.ndarray, " episodes"]
    success: Int8[np.ndarray, " episodes"]  # 1, 0, or -1: unknown
    id_ends: Int64[np.ndarray, " episodes"]
    id_bytes: UInt8[np.ndarray, " bytes"]
    id_hash: UInt64[np.ndarray, " episodes"]  # the first 8 bytes of the identity's SHA-256
    id_rank: Int32[np.ndarray, " episodes"]  # rank of the identity in alphabetical order
    problems: tuple[EpisodeProblem, ...] = ()
    locators: Mapping[str, np.ndarray] = field(default_factory=dict)
    texts: Mapping[str, str] = field(default_factory=dict)
    state_hash: UInt64[np.ndarray, " episodes"] | None = None  # `state_hash.hash_of_states`; None: unknown for all
    labels: Mapping[str, Labels] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        infos: Sequence[EpisodeInfo],
        *,
        problems: Sequence[EpisodeProblem] = (),
        locators: Mapping[str, np.ndarray] | None = None,
        texts: Mapping[str, str] | None = None,
        state_hashes: Sequence[int] | None = None,
        labels: Mapping[str, Labels] | None = None,
    ) -> EpisodeTable:
        """Make a table; a given table is returned unchanged."""
        if isinstance(infos, EpisodeTable):
            return infos
        ids = [info.id for info in infos]
        rank = np.empty(len(ids), np.int32)
        rank[sorted(range(len(ids)), key=ids.__getitem__)] = np.arange(len(ids), dtype=np.int32)
        return cls(
            num_steps=np.array([info.num_steps for info in infos], np.int32),
            success=np.array([_UNKNOWN if info.success is None else info.success for info in infos], np.int8),
            **pack_texts("id", ids),
            id_hash=np.array([identity_hash(name) for name in ids], np.uint64),
            id_rank=rank,
            problems=tuple(problems),
            locators=dict(locators or {}),
            texts=dict(texts or {}),
            state_hash=None if state_hashes is None else np.array(state_hashes, np.uint64),
            labels=dict(labels or {}),
        )

    def __len__(self) -> int:
        return len(self.num_steps)

    @overload
    def __getitem__(self, index: int) -> EpisodeInfo: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[EpisodeInfo]: ...

    def __getitem__(self, index: int | slice) -> EpisodeInfo | Sequence[EpisodeInfo]:
        """Return the facts about one episode, or several."""
        if isinstance(index, slice):
            return [self[number] for number in range(*index.indices(len(self)))]
        if not -len(self) <= index < len(self):
            raise IndexError(f"episode {index} of {len(self)}")
        index %= len(self)
        success = int(self.success[index])
        return EpisodeInfo(
            id=self.identity(index),
            num_steps=int(self.num_steps[index]),
            success=None if success == _UNKNOWN else bool(success),
        )

    def identity(self, index: int) -> str:
        """Return the identity of one episode."""
        return text_of("id", {"id_ends": self.id_ends, "id_bytes": self.id_bytes}, index)

    def find(self, identity: str) -> int | None:
        """Return the index of an episode, or None if the identity is unknown."""
        for index in np.flatnonzero(self.id_hash == np.uint64(identity_hash(identity))):
            if self.identity(int(index)) == identity:
                return int(index)
        return None

    def to_bytes(self) -> bytes:
        """Return the table as a file's content, with checksums."""
        text = json.dumps({
            "problems": [vars(problem) for problem in self.problems],
            "texts": dict(self.texts),
            "labels": {name: labels.names for name, labels in self.labels.items()},
        })  # fmt: skip
        file = io.BytesIO()
        arrays: dict[str, Any] = {name: getattr(self, name) for name in _COLUMNS}
        arrays |= {} if self.state_hash is None else {_HASH: self.state_hash}
        arrays |= {f"{_LOCATOR}{name}": column for name, column in self.locators.items()}
        arrays |= {f"{_LABEL}{name}": labels.number for name, labels in self.labels.items()}
        np.savez(file, text=np.frombuffer(text.encode(), np.uint8), **arrays)
        return file.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> EpisodeTable:
        """Read the result of `to_bytes`; older ones (of latent caches) have no hashes and labels.

        Raises:
            NotATableError: It is another kind of file, or damaged.
        """
        try:
            arrays = read_arrays(data)
            text = record_of(_Text, json_object(arrays.pop("text").tobytes(), where="text"), where="text")
        except (InputError, KeyError) as error:
            raise NotATableError(str(error)) from None
        locators = {name.removeprefix(_LOCATOR): one for name, one in arrays.items() if name.startswith(_LOCATOR)}
        _require_columns(arrays, locators)
        return cls(
            **{name: arrays[name] for name in _COLUMNS},
            problems=text.problems,
            locators=locators,
            texts=text.texts,
            state_hash=_column(arrays, _HASH, np.uint64) if _HASH in arrays else None,
            labels={name: _labels(arrays, name, names) for name, names in text.labels.items()},
        )


@dataclass(frozen=True)
class _Text:
    """The parts of a table that are not numbers."""

    problems: tuple[EpisodeProblem, ...]
    texts: Mapping[str, str]
    labels: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


_HASH = "state_hash"
_COLUMNS = {
    "num_steps": np.int32, "success": np.int8, "id_ends": np.int64, "id_bytes": np.uint8, "id_hash": np.uint64,
    "id_rank": np.int32,
}  # fmt: skip


def _require_columns(arrays: Mapping[str, np.ndarray], locators: Mapping[str, np.ndarray]) -> None:
    """Refuse inconsistent columns: positions of episodes would be wrong.

    Raises:
        NotATableError: They are.
    """
    for name, kind in _COLUMNS.items():
        if name not in arrays or arrays[name].dtype != kind or arrays[name].ndim != 1:
            raise NotATableError(f"no column {name} of {np.dtype(kind)}")
    episodes = len(arrays["num_steps"])
    whole = {name: arrays[name] for name in _COLUMNS} | {f"locator {name}": one for name, one in locators.items()}
    for name, column in whole.items():
        fits = len(column) == episodes or name.endswith("_bytes")  # of packed texts
        if column.ndim != 1 or column.dtype.kind not in "iuf" or not fits:
            raise NotATableError(f"the column {name} is {column.dtype} of shape {column.shape}, of {episodes} episodes")
    for packed in [name.removesuffix("_ends") for name in whole if name.endswith("_ends")]:
        if not are_texts(whole[f"{packed}_ends"], whole.get(f"{packed}_bytes")):
            raise NotATableError(f"the texts of {packed} do not fit together")
    if (arrays["num_steps"] < 0).any():
        raise NotATableError("an episode of less than no steps")


def _column(arrays: Mapping[str, np.ndarray], name: str, kind: type[np.generic]) -> np.ndarray:
    """Return an optional column: one value for each episode.

    Raises:
        NotATableError: It is missing, or of another type or length.
    """
    column, episodes = arrays.get(name), len(arrays["num_steps"])
    if column is None or column.dtype != kind or column.shape != (episodes,):
        raise NotATableError(f"no column {name} of {np.dtype(kind)} for {episodes} episodes")
    return column


def _labels(arrays: Mapping[str, np.ndarray], name: str, names: tuple[str, ...]) -> Labels:
    try:
        return Labels(names, _column(arrays, f"{_LABEL}{name}", np.int32))
    except ValueError as error:
        raise NotATableError(str(error)) from None


def identity_hash(identity: str) -> int:
    """Return 64 bits of the identity's SHA-256: as a share of 2**64 it determines the episode's split."""
    return int.from_bytes(hashlib.sha256(identity.encode()).digest()[:8], "big")
