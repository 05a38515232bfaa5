"""The index of a data set: facts about every episode, stored as columns and cached, so that it is built only once.

DROID has 95,658 episodes. A list of that many objects is slow to load and to send to workers; a table of columns is
small and fast.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import os
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Float32, Int8, Int32, UInt64

from vjepa2_ac import storage
from vjepa2_ac.config import DiskCacheConfig
from vjepa2_ac.episode import STATE_DIM, EpisodeInfo, StepRanges
from vjepa2_ac.errors import InputError, MissingFileError
from vjepa2_ac.spaces import compute_step_sizes
from vjepa2_ac.storage import paths

logger = logging.getLogger(__name__)

UNKNOWN = 0  # `state_hash` of an episode whose states were not read; `hash_states` never returns it

_UNKNOWN_NUMBER = -1  # value in the columns of labels and success
_COLUMNS = ("num_steps", "success", "ids", "id_hash", "id_rank")
_HASH, _MOTION, _LOCATOR, _LABEL = "state_hash", "motion", "locator.", "label."
_TEXT = "text"
_NO_MOTION = (np.nan,) * 8
MEANS, SPANS = slice(2, 5), slice(5, 8)  # parts of `StatesSummary.motion`
_CACHE_VARIABLE = "VJEPA2_AC_CACHE"
_VERSION = 5  # version of the cached files; a new number invalidates all of them


class InvalidTableError(ValueError):
    """The bytes are not a table written by `to_bytes`."""


def pack(arrays: Mapping[str, np.ndarray], text: object = None) -> bytes:
    """Serialise arrays and a JSON value to the bytes of a file; equal values give equal bytes."""
    file = io.BytesIO()
    np.savez(file, **{_TEXT: np.frombuffer(json.dumps(text).encode(), np.uint8)}, **arrays)  # type: ignore[arg-type] # no array has the name allow_pickle
    return file.getvalue()


def unpack(data: bytes) -> tuple[dict[str, np.ndarray], Any]:
    """Return the arrays and the JSON value that `pack` wrote; pickled and compressed arrays are refused.

    Raises:
        InvalidTableError: The bytes are another kind of file, or damaged.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if sum(member.file_size for member in archive.infolist()) > len(data) or archive.testzip() is not None:
                raise InvalidTableError("compressed or damaged arrays")  # noqa: TRY301
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            arrays = dict(file)
        text = arrays.pop("problems" if "problems" in arrays else _TEXT)  # "problems": the name in older caches
        return arrays, json.loads(text.tobytes())
    except Exception as error:  # zipfile and numpy raise many types of errors for damaged files
        raise InvalidTableError(str(error)[:200] or type(error).__name__) from None


@dataclass(frozen=True)
class EpisodeProblem:
    """An unusable episode and the reason."""

    name: str  # the identity of the episode, or its position if the identity cannot be read
    where: str
    found: str
    needed: str = ""
    fix: str = ""

    @classmethod
    def from_error(cls, error: InputError, name: str) -> EpisodeProblem:
        """Return the record of an error."""
        return cls(name=name, where=error.where, found=error.found, needed=error.needed, fix=error.fix)

    @property
    def error(self) -> InputError:
        """The error of the episode."""
        return InputError(where=self.where, found=self.found, needed=self.needed, fix=self.fix)


@dataclass(frozen=True, eq=False)
class Labels:
    """One name for each episode, as an index into a list of all names."""

    names: tuple[str, ...]
    number: Int32[np.ndarray, " episodes"]  # index into the names; -1: unknown

    def __post_init__(self) -> None:
        """Refuse numbers outside the list of names, which a damaged file may contain."""
        if len(self.number) and not _UNKNOWN_NUMBER <= self.number.min() <= self.number.max() < len(self.names):
            raise ValueError(f"labels of {len(self.names)} names with numbers up to {self.number.max()}")

    @classmethod
    def from_names(cls, values: Sequence[str | None]) -> Labels:
        """Create labels; None or an empty name means unknown."""
        names = sorted({value for value in values if value})
        number = {name: index for index, name in enumerate(names)}
        return cls(tuple(names), np.array([number.get(value or "", _UNKNOWN_NUMBER) for value in values], np.int32))

    def name_at(self, index: int) -> str | None:
        """Return the name of one episode, or None if unknown."""
        number = int(self.number[index])
        return None if number == _UNKNOWN_NUMBER else self.names[number]


@dataclass(frozen=True, eq=False)
class EpisodeTable(Sequence[EpisodeInfo]):
    """The usable episodes of a data set, in the source's order, as columns.

    `locators` are columns with which the source finds an episode; `labels` are groups of episodes, such as the scene;
    `texts` are small values of the whole data set.
    """

    num_steps: Int32[np.ndarray, " episodes"]
    success: Int8[np.ndarray, " episodes"]  # 1, 0, or -1: unknown
    ids: np.ndarray  # the identities in UTF-8, as NumPy bytes (type S)
    id_hash: UInt64[np.ndarray, " episodes"]  # the first 8 bytes of the identity's SHA-256
    id_rank: Int32[np.ndarray, " episodes"]  # rank of the identity in alphabetical order
    motion: Float32[np.ndarray, "episodes 8"]  # as in `StatesSummary`; NaN: states not read, or an older latent cache
    problems: tuple[EpisodeProblem, ...] = ()
    locators: Mapping[str, np.ndarray] = field(default_factory=dict)
    texts: Mapping[str, str] = field(default_factory=dict)
    state_hash: UInt64[np.ndarray, " episodes"] | None = None  # `hash_states`; None: unknown for all
    labels: Mapping[str, Labels] = field(default_factory=dict)

    @classmethod
    def from_infos(cls, infos: Sequence[EpisodeInfo]) -> EpisodeTable:
        """Create a table without the optional columns; an existing table is returned unchanged.

        Raises:
            InputError: An identity contains a NUL character.
        """
        if isinstance(infos, EpisodeTable):
            return infos
        for info in infos:
            if "\0" in info.id:
                raise nul_error(info.id, f"episode {info.id!r}")
        ids = np.array([info.id.encode() for info in infos] or [b""])[: len(infos)]
        return cls(
            num_steps=np.array([info.num_steps for info in infos], np.int32),
            success=np.array([_UNKNOWN_NUMBER if info.success is None else info.success for info in infos], np.int8),
            ids=ids,
            id_hash=np.array([hash_identity(info.id) for info in infos], np.uint64),
            id_rank=np.argsort(np.argsort(ids, kind="stable")).astype(np.int32),
            motion=np.array([_NO_MOTION for _ in infos], np.float32),
        )

    def __len__(self) -> int:
        return len(self.num_steps)

    def __getitem__(self, index: int) -> EpisodeInfo:  # type: ignore[override] # no slices
        """Return the facts about one episode."""
        success = int(self.success[index])
        return EpisodeInfo(
            id=self.identity(index),
            num_steps=int(self.num_steps[index]),
            success=None if success == _UNKNOWN_NUMBER else bool(success),
        )

    def identity(self, index: int) -> str:
        """Return the identity of one episode."""
        return bytes(self.ids[index]).decode(errors="replace")

    def label(self, name: str, index: int) -> str | None:
        """Return a label of one episode, such as its task, or None."""
        return self.labels[name].name_at(index) if name in self.labels else None

    def find(self, identity: str) -> int | None:
        """Return the index of an episode, or None if the identity is unknown."""
        for index in np.flatnonzero(self.id_hash == np.uint64(hash_identity(identity))):
            if self.identity(int(index)) == identity:
                return int(index)
        return None

    def to_bytes(self) -> bytes:
        """Serialise the table."""
        text = {
            "problems": [vars(problem) for problem in self.problems],
            "texts": dict(self.texts),
            "labels": {name: labels.names for name, labels in self.labels.items()},
        }
        arrays = {name: getattr(self, name) for name in (*_COLUMNS, _MOTION)}
        arrays |= {} if self.state_hash is None else {_HASH: self.state_hash}
        arrays |= {f"{_LOCATOR}{name}": column for name, column in self.locators.items()}
        arrays |= {f"{_LABEL}{name}": labels.number for name, labels in self.labels.items()}
        return pack(arrays, text)

    @classmethod
    def from_bytes(cls, data: bytes) -> EpisodeTable:
        """Read the result of `to_bytes`.

        Raises:
            InvalidTableError: The bytes are another kind of file, or damaged.
        """
        arrays, text = unpack(data)
        try:
            columns = {name: arrays[name] for name in _COLUMNS}
            unknown = np.array([_NO_MOTION for _ in columns["ids"]], np.float32)
            columns |= {_MOTION: arrays.get(_MOTION, unknown).reshape(-1, len(_NO_MOTION))}
            locators = {
                name.removeprefix(_LOCATOR): column for name, column in arrays.items() if name.startswith(_LOCATOR)
            }
            table = cls(
                **columns,
                problems=tuple(EpisodeProblem(**problem) for problem in text["problems"]),
                locators=locators,
                texts=text["texts"],
                state_hash=arrays.get(_HASH),
                labels={name: Labels(tuple(names), arrays[_LABEL + name]) for name, names in text["labels"].items()},
            )
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            raise InvalidTableError(str(error)) from None
        if len({len(column) for column in (*columns.values(), *locators.values())}) != 1:
            raise InvalidTableError("columns of different lengths")
        return table


@dataclass(frozen=True, eq=False)
class StepSelection:
    """Disjoint ranges [start, end) of control steps, sorted by episode and start; a clip must fit into one range."""

    episode: Int32[np.ndarray, " ranges"]  # index into the table
    start: Int32[np.ndarray, " ranges"]
    end: Int32[np.ndarray, " ranges"]
    problems: tuple[tuple[int, EpisodeProblem], ...] = ()  # (index into the table, problem) of unreadable episodes

    @classmethod
    def all_steps(cls, table: EpisodeTable, is_selected: Bool[np.ndarray, " episodes"]) -> StepSelection:
        """Return the selection of all steps of the episodes of a mask."""
        episode = np.flatnonzero(is_selected).astype(np.int32)
        return cls(episode, np.zeros(len(episode), np.int32), table.num_steps[episode])

    @classmethod
    def from_ranges(cls, results: Sequence[list[tuple[int, int]] | EpisodeProblem]) -> StepSelection:
        """Create a selection from the ranges or the problem of each episode."""
        problems = tuple((index, result) for index, result in enumerate(results) if isinstance(result, EpisodeProblem))
        ranges = [(index, *pair) for index, pairs in enumerate(results) if isinstance(pairs, list) for pair in pairs]
        episode, start, end = np.ascontiguousarray(np.array(ranges, np.int32).reshape(-1, 3).T)
        return cls(episode, start, end, problems)

    def select_episodes(self, episodes: Bool[np.ndarray, " episodes"]) -> StepSelection:
        """Return the selection without the episodes that are not in a mask."""
        selected = episodes[self.episode]
        return replace(self, episode=self.episode[selected], start=self.start[selected], end=self.end[selected])

    def ranges_of(self, episode: int) -> StepRanges:
        """Return the ranges of one episode."""
        first, last = np.searchsorted(self.episode, np.array([episode, episode + 1], np.int32))
        return tuple(zip(self.start[first:last].tolist(), self.end[first:last].tolist(), strict=True))

    @property
    def num_steps(self) -> int:
        """The total number of selected steps."""
        return int((self.end.astype(np.int64) - self.start).sum())

    def to_bytes(self) -> bytes:
        """Serialise the selection."""
        problems = [(index, vars(problem)) for index, problem in self.problems]
        return pack({"episode": self.episode, "start": self.start, "end": self.end}, problems)

    @classmethod
    def from_bytes(cls, data: bytes) -> StepSelection:
        """Read the result of `to_bytes`.

        Raises:
            InvalidTableError: The bytes are another kind of file, or damaged.
        """
        arrays, problems = unpack(data)
        try:
            return cls(**arrays, problems=tuple((index, EpisodeProblem(**values)) for index, values in problems))
        except (LookupError, TypeError, ValueError) as error:
            raise InvalidTableError(f"invalid ranges of steps ({error})") from None


T = TypeVar("T", EpisodeTable, StepSelection)


def nul_error(identity: str, where: str) -> InputError:
    """Return the error of an identity with a NUL character, which NumPy arrays of type S drop at the end of a text."""
    return InputError(
        where=where,
        found=f"a NUL character in the identity {identity!r}",
        needed="text without NUL characters",
        fix="Remove the character from the identity in the data set",
    )


def hash_identity(identity: str) -> int:
    """Return 64 bits of the identity's SHA-256; divided by 2**64 they determine the episode's split."""
    return int.from_bytes(hashlib.sha256(identity.encode()).digest()[:8], "big")


def build_labels(values: Sequence[Mapping[str, str | None]]) -> dict[str, Labels]:
    """Return labels from one {label: name} mapping per episode; labels without any name are dropped."""
    names = {name for episode in values for name in episode}
    all_labels = {name: Labels.from_names([episode.get(name) for episode in values]) for name in sorted(names)}
    return {name: labels for name, labels in all_labels.items() if labels.names}


def hash_states(states: Float[np.ndarray, "steps state_dim"]) -> int:
    """Return 64 bits of the BLAKE2b of the states as float32, never `UNKNOWN`.

    The states are hashed as float32, because a recording may be float64 in one file and float32 in another. Coarser
    rounding would not help, because two nearly equal values may still be rounded to different numbers.
    """
    content = f"{states.shape} ".encode() + (states.astype("<f4") + np.float32(0)).tobytes()  # + 0 converts -0 to 0
    return int.from_bytes(hashlib.blake2b(content, digest_size=8).digest(), "big") or 1


class StatesSummary(NamedTuple):
    """The summary of an episode's states in the index.

    `motion` has the longest distance (metres) and the largest rotation (radians) between consecutive poses, then the
    mean and the standard deviation of x, y and z over the episode. For vectors the first two numbers are 0, and x, y
    and z are the first three numbers of the states.
    """

    state_hash: int = UNKNOWN
    motion: Sequence[float] = _NO_MOTION


STATES_NOT_READ = StatesSummary()


def summarize_states(states: Float[np.ndarray, "steps state_dim"]) -> StatesSummary:
    """Summarise the states of an episode with one or more steps."""
    width = states.shape[1]
    largest = compute_step_sizes(states).max(axis=0, initial=0.0) if width == STATE_DIM else np.zeros(2)
    positions = states[:, np.arange(3) % width]
    return StatesSummary(hash_states(states), [*largest, *positions.mean(axis=0), *positions.std(axis=0)])


def cache_folder(config: DiskCacheConfig) -> Path:
    """Return the local cache folder: `data.disk_cache.dir`, $VJEPA2_AC_CACHE, or the user's default cache folder.

    Raises:
        InputError: The environment variable is not a local path.
    """
    if config.dir is not None:
        return Path(config.dir)
    if configured := os.environ.get(_CACHE_VARIABLE):
        try:
            return Path(paths.resolve_local_path(configured))
        except ValueError as error:
            raise InputError(where=_CACHE_VARIABLE, found=f"{configured!r} {error}", needed="a local folder") from None
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vjepa2-ac"


def hash_key(parts: Mapping[str, object]) -> str:
    """Return a short hash of all values that a cached result depends on."""
    text = json.dumps({"version": _VERSION, **parts}, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def index_key(parts: Mapping[str, object], path: str, *, identity: str = "") -> str:
    """Return the key of an index, on which the keys of other cached data of its episodes depend.

    A local folder is identified by its content, so that it may be moved. For a URL the path is part of the key, too,
    because the versions of remote files are less reliable.

    Args:
        parts: The files of the data set, and how they are read.
        path: The folder of the data set.
        identity: An episode's identity, if identities depend on the name of the folder.
    """
    return hash_key({**parts, "path": path} if storage.is_url(path) else {**parts, "named": identity})


def compute_fingerprint(table: EpisodeTable) -> str:
    """Return a fingerprint of the episodes: the key of the index, or a hash of a table without a key."""
    return table.texts.get("index") or hashlib.sha256(table.to_bytes()).hexdigest()


def get_or_build_index(config: DiskCacheConfig, key: str, path: str, build: Callable[[], EpisodeTable]) -> EpisodeTable:
    """Return the table cached under a key; build and cache it if it is missing or damaged.

    `EpisodeTable.texts` contains the key. If the data set was moved, the paths in cached problems are updated.
    """
    folder = storage.canonical_path(path)

    def build_with_key() -> EpisodeTable:
        table = build()
        return replace(table, texts={**table.texts, "index": key, "place": folder})

    table = get_or_build(config, key, build_with_key, EpisodeTable)
    problems = [
        replace(problem, where=problem.where.replace(table.texts["place"], folder, 1)) for problem in table.problems
    ]
    return replace(table, problems=tuple(problems))


def get_or_build(config: DiskCacheConfig, key: str, make: Callable[[], T], kind: type[T]) -> T:
    """Return the table cached under a key; make and cache it if it is missing or damaged.

    The file ends with its key, so that a renamed file of another key is not used.

    Raises:
        UnreachableError: The file exists and cannot be read.
    """
    path = cache_folder(config) / "index" / f"{key}.index"
    try:
        with storage.translate_read_errors(path):
            data = path.read_bytes()
        if not data.endswith(key.encode()):
            raise InvalidTableError("damaged, written by an older version, or for other data")  # noqa: TRY301
        return kind.from_bytes(data.removesuffix(key.encode()))
    except MissingFileError:
        pass
    except (InputError, InvalidTableError) as error:
        logger.warning("%s: cannot be used (%s); the index is built again", path, error)
    table = make()
    try:
        storage.write_atomically(path, table.to_bytes() + key.encode())
    except OSError as error:
        logger.warning("%s: cannot be written (%s); the index will be built again next time", path, error)
    return table
