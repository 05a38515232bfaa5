"""Read episodes from a latent cache, without the data set, and compare the keys of latent caches."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.removed import REMOVED
from vjepa2_ac.config.section import Affects, values_that_affect
from vjepa2_ac.data.files import open_download_cache
from vjepa2_ac.data.index import EpisodeTable, InvalidTableError, StepSelection, T
from vjepa2_ac.data.sources.indexed_source import IndexedSource, get_state_space
from vjepa2_ac.data.sources.latent_files import FIX, OPTIONAL, LatentFiles
from vjepa2_ac.episode import STATE_DIM, Episode, EpisodeInfo, Progress, StepRanges
from vjepa2_ac.errors import InputError, MissingFileError, counted
from vjepa2_ac.spaces import make_vector_states
from vjepa2_ac.storage.structured import read_json_object

FORMAT = 2  # version of the files of a cache
CACHE_FILE, EPISODES_FILE, STEPS_FILE = "cache.json", "episodes.npz", "kept.npz"  # see `latent_files`

_FRAME_KEYS = {"source", "camera", "pose_frame", "cache_dtype"}  # config keys that affect frames, not clips
_NON_ENCODING_PREFIXES = ("data", "format")  # prefixes of parts that are unrelated to the encoder
_MAX_BYTES = 1 << 30  # size limit of a table
_ENCODE = "Run `vjepa2-ac encode`, which resumes an unfinished cache, or copy the cache again"


@dataclass(frozen=True)
class Encoding:
    """The settings that determine a frame's latents, and the size of the latents; see `encoding.batch.get_encoding`.

    The number of frames per encoder call is not included, because it changes only the order of additions, on some CPUs
    not even that (tests/encoding/test_training_cache.py).
    """

    parts: Mapping[str, Any]  # parts of a `CacheKey`
    image_size: int
    tokens: int
    dim: int


@dataclass(frozen=True)
class CacheKey:
    """Values that determine the content of a folder, as {name: JSON value}. The name of a config key is its path."""

    parts: Mapping[str, Any]

    @property
    def digest(self) -> str:
        """A short hash of the key: the name of a cache's folder, which is also stored in each of its files."""
        return hashlib.sha256(json.dumps(dict(self.parts), sort_keys=True).encode()).hexdigest()[:32]

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras of a cache."""
        return tuple(map(str, self.parts["data.camera"]))

    def list_differences(self, parts: Mapping[str, Any], names: Collection[str] | None = None) -> list[str]:
        """Return how other parts differ, such as "data.stride: 8, not 4"; without `names` all parts are compared."""
        parts = json.loads(json.dumps(dict(parts)))  # converts tuples to lists, as in a file
        names = sorted(self.parts.keys() | parts) if names is None else names
        return [text for name in names for text in _compare_values(name, self.parts.get(name), parts.get(name))]

    def list_encoding_differences(self, encoding: Encoding) -> list[str]:
        """Return the differences in the settings of the encoder and its input."""
        names = sorted(self.parts.keys() | encoding.parts)
        return self.list_differences(
            encoding.parts, [name for name in names if not name.startswith(_NON_ENCODING_PREFIXES)]
        )


def build_cache_key(config: DataConfig, fingerprint: str, encoding: Encoding) -> CacheKey:
    """Return the cache key of an open data set, whose stride is a number.

    Args:
        config: The config of the data set and its clips.
        fingerprint: The fingerprint of its episodes.
        encoding: The settings of the encoder and its input.
    """
    return CacheKey({
        "format": FORMAT,
        **encoding.parts,
        **get_clip_parts(config),
        "data.cache_dtype": config.cache_dtype,
        "data.camera": list(config.cameras),
        "data.pose_frame": config.pose_frame,
        "data set": {"source": config.source, "episodes": fingerprint, **config.format_values},
    })  # fmt: skip


def get_clip_parts(config: DataConfig) -> dict[str, Any]:
    """Return the parts that determine the data of clips, to check a cache that is used without its data set."""
    values = values_that_affect(Affects.LATENTS, config) | {"stride": config.model_stride}
    names = values.keys() - _FRAME_KEYS - config.format_sections().keys()
    return {f"data.{name}": values[name] for name in sorted(names)}


def require_matching_folder(folder: Path | str, name: str, key: CacheKey, *, where: str) -> None:
    """Refuse a folder that was created with another key, or that holds other files; a missing folder is accepted.

    Args:
        folder: The folder, or its URL.
        name: Name of the JSON file with the key.
        key: The key of the content that is about to be written.
        where: The folder, for messages.

    Raises:
        InputError: Lists the differences.
        UnreachableError: The folder cannot be read now.
    """
    fix = "Choose another folder, or delete this one"
    # Listed before the key is read, because another process may start writing at any time.
    other_names = [other_name for other_name in storage.list_names(folder) if other_name[0] != "."]
    try:
        stored = read_json_object(storage.join(folder, name), fix=fix)
    except MissingFileError:
        if other_names:
            problem = f"the folder contains other files, such as {other_names[0]}"
            raise InputError(where=where, found=problem, needed="a new or empty folder", fix=fix) from None
        return
    if differences := CacheKey(stored.get("key") or {}).list_differences(key.parts):
        problem = f"the folder was created with different settings: {'; '.join(differences)}"
        needed = "a new folder, or a folder that was created with these settings"
        raise InputError(where=where, found=problem, needed=needed, fix=fix)


def _compare_values(name: str, stored: Any, current: Any) -> list[str]:
    if stored == current or (current is None and name in REMOVED and stored in REMOVED[name].values):
        return []  # equal, or a removed config key whose stored value is the present behaviour
    if isinstance(stored, dict) and isinstance(current, dict):
        keys = sorted(stored.keys() | current)
        return [text for key in keys for text in _compare_values(f"{name}.{key}", stored.get(key), current.get(key))]
    return [f"{name}: {_format_value(stored)}, not {_format_value(current)}"]


def _format_value(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def read_cache_key(folder: Path | str) -> CacheKey:
    """Read the key of a latent cache.

    Raises:
        InputError: The folder has no key, or a key of another format.
    """
    where = storage.join(folder, CACHE_FILE)
    needed = f"a folder with the {CACHE_FILE} of a latent cache, format {FORMAT}"
    try:
        key = read_json_object(where, fix=_ENCODE).get("key")
    except MissingFileError:
        is_folder = storage.is_url(folder) or Path(folder).is_dir()
        problem = "no latent cache" if is_folder else f"no such folder (working directory: {Path.cwd()})"
        raise InputError(where=str(folder), found=problem, needed=needed, fix=_ENCODE) from None
    if not isinstance(key, dict) or key.get("format") != FORMAT or not isinstance(key.get("data.camera"), list):
        raise InputError(
            where=where, found="not the key of a latent cache, or an unsupported format", needed=needed, fix=_ENCODE
        )
    return CacheKey(key)


def read_table(path: str, kind: type[T]) -> T:
    """Read a table of a latent cache.

    Raises:
        InputError: The file is missing or damaged.
        UnreachableError: The file cannot be read.
    """
    try:
        with storage.translate_read_errors(path, fix=_ENCODE):
            return kind.from_bytes(storage.read_small_file(path, _MAX_BYTES))
    except InvalidTableError as error:
        raise InputError(where=path, found=f"damaged ({error})", fix=_ENCODE) from None


@dataclass(frozen=True)
class _Cache:
    """An open latent cache."""

    key: CacheKey
    files: LatentFiles
    selected_steps: StepSelection | None


class LatentSource(IndexedSource[DataConfig, _Cache]):
    """The episodes of the data set from which a latent cache was encoded, in the order of that data set.

    Episodes that could not be read while encoding are included, and reading them raises an error, so that the clips
    and their order equal those of the data set.
    """

    @property
    def key(self) -> CacheKey:
        """The key of the cache."""
        return self._open()[1].key

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras that clips are drawn from: the cameras of the config, or all cameras of the cache."""
        return self.key.cameras if self._config.camera is None else self._config.cameras

    def read_selected_steps(self) -> StepSelection | None:
        """Return the ranges that `data.idle` keeps, from the cache; None if the rule is none.

        Raises:
            InputError: There is no cache, or it was encoded for other clips than the config's.
        """
        return self._open()[1].selected_steps

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:  # noqa: ARG002 - nothing is fetched
        """Return an episode; only requested latents are read.

        Raises:
            InputError: The file is missing or damaged, or the episode could not be read while encoding.
            UnreachableError: The file cannot be read now.
        """
        table, cache = self._open()
        camera = camera or self.cameras[0]
        file, info = cache.files.open(index, camera), table[index]
        arrays = {name: file.read_array(name) for name in OPTIONAL if name in file.names}
        arrays["states"] = file.read_array("states")
        self._require_plausible(arrays, info, f"{file.path}: {info.id}")
        return Episode(
            info=info,
            read_frames=lambda steps: file.read_images(file.find_frames(steps)),
            control_rate_hz=float(table.texts["control_rate_hz"]),
            metadata=file.metadata,
            read_latents=lambda steps: file.read_latents(file.find_frames(steps)),
            frame_steps=file.frame_steps,
            **arrays,
        )

    def _require_plausible(self, arrays: Mapping[str, np.ndarray], info: EpisodeInfo, where: str) -> None:
        """Refuse an episode with wrong lengths or implausible numbers, which only a damaged file contains.

        Raises:
            InputError: The number of steps differs from the index, or numbers are not finite or implausible.
        """
        for name, values in arrays.items():
            width = STATE_DIM if name == "states" and self._config.states == "pose" else np.atleast_2d(values).shape[1]
            if values.shape != (info.num_steps, width):
                needed = f"{info.num_steps} x {width}, as in the index of the cache"
                raise InputError(where=f"{where}: {name}", found=f"shape {values.shape}", needed=needed, fix=FIX)
            space = get_state_space(self._config, width) if name == "states" else make_vector_states(width)
            if name != "joint_velocities":  # only the idle filter reads them, and checks them
                space.require_plausible(values, f"{where}: {name}", fix=FIX)

    def resolve_cameras(self, episodes: Int[np.ndarray, " episodes"]) -> DataConfig:
        """Check that some episodes have files, and return the config with the names of the cameras.

        Raises:
            InputError: Some of these episodes have no files: the cache is unfinished, or was made from other episodes.
            UnreachableError: The folder cannot be listed now.
        """
        table, cache = self._open()
        numbers = np.unique(episodes).tolist()
        if missing := cache.files.find_missing(numbers, self.cameras):
            count = f"{len(missing)} of {counted(len(numbers), 'episode')}"
            problem = f"no latents of {count}, such as {table.identity(missing[0])}"
            fix = (
                "Run the `vjepa2-ac encode` command of this cache again to encode the missing episodes, or exclude them"
            )
            raise InputError(where=self._config.path, found=problem, fix=f"{fix} (data.outcome, data.exclude)")
        return self._config.model_copy(update={"camera": self.cameras})

    def _open_data_set(self, progress: Progress) -> tuple[EpisodeTable, _Cache]:  # noqa: ARG002 - opening a cache is fast
        folder = storage.parse_folder(self._config.path)
        key = read_cache_key(folder)
        parts = get_clip_parts(self._config)
        differences = key.list_differences(parts, parts)
        for camera in () if self._config.camera is None else self._config.cameras:
            if camera not in key.cameras:
                differences.append(f"data.camera: {', '.join(key.cameras)}, not {camera}")
        if differences:  # the clips of the cache differ from the config's
            raise cache_mismatch_error(folder, differences)
        has_idle_rule = self._config.idle.rule != "none"
        selected_steps = read_table(storage.join(folder, STEPS_FILE), StepSelection) if has_idle_rule else None
        cache = open_download_cache(self._config.disk_cache) if storage.is_url(folder) else None
        table = read_table(storage.join(folder, EPISODES_FILE), EpisodeTable)
        return table, _Cache(key, LatentFiles(folder, key.digest, cache), selected_steps)


def cache_mismatch_error(folder: Path | str, differences: Sequence[str]) -> InputError:
    """Return the error of a cache that was encoded with other settings than the present ones."""
    problem = f"the latent cache was encoded with different settings: {'; '.join(differences)}"
    needed = "a latent cache that was encoded with this model and these settings"
    fix = "Change the settings to those of the cache, or encode the data set again"
    return InputError(where=str(folder), found=problem, needed=needed, fix=fix)
