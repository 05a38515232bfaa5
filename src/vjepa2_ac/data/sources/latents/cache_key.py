"""The key of a latent cache: everything that determines its latents, by the names that users know."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vjepa2_ac import storage
from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.section import Affects, values_that_affect
from vjepa2_ac.errors import InputError, MissingFileError
from vjepa2_ac.storage.structured import read_json_object

FORMAT = 2  # of the files of a cache
NORMALISATION = 1  # of pixels, in `transforms.pixels_to_input`, and of features: increase it when one of them changes

_OF_THE_FRAMES = {"source", "camera", "pose_frame", "cache_dtype"}  # the other keys are of clips
_NOT_OF_ENCODING = ("data", "format")  # how the names of the other parts begin


@dataclass(frozen=True)
class Encoding:
    """What determines a frame's latents besides the frame, and their size; made by `encoding.batch.encoding_of`.

    The number of frames per pass of the encoder is not included: it changes only the order of a sum, and on
    some CPUs nothing (tests/encoding/test_training_cache.py).
    """

    encoder: str  # WorldModel.encoder_fingerprint
    image_size: int
    patch_size: int
    tokens: int
    dim: int
    weights: str  # model.dtype
    precision: str  # training.precision
    beyond: Mapping[str, str | int] = field(default_factory=dict)  # WorldModel.encoder_beyond_tensors

    @property
    def parts(self) -> dict[str, Any]:
        """The corresponding parts of a key."""
        return {
            "encoder": self.encoder,
            "image_size": self.image_size,
            "patch_size": self.patch_size,
            "normalisation": NORMALISATION,
            "model.dtype": self.weights,
            "training.precision": self.precision,
            **self.beyond,
        }


@dataclass(frozen=True)
class CacheKey:
    """What determines the content of a folder, as {name: JSON value}; with the names of knobs where they exist."""

    parts: Mapping[str, Any]

    @property
    def digest(self) -> str:
        """A short hash of it: the name of a cache's folder, also in each of its files."""
        return hashlib.sha256(json.dumps(dict(self.parts), sort_keys=True).encode()).hexdigest()[:32]

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras of a cache."""
        return tuple(map(str, self.parts["data.camera"]))

    def differences(self, wanted: Mapping[str, Any], names: Collection[str] | None = None) -> list[str]:
        """Return the differences from the wanted parts, as "data.stride: 8, not 4"; of these names, or of all."""
        wanted = json.loads(json.dumps(dict(wanted)))  # as a file has them
        names = sorted(self.parts.keys() | wanted) if names is None else names
        return [text for name in names for text in _differences(name, self.parts.get(name), wanted.get(name))]

    def differences_of(self, encoding: Encoding) -> list[str]:
        """Return the differences in how frames became latents."""
        names = sorted(self.parts.keys() | encoding.parts)
        return self.differences(encoding.parts, [one for one in names if not one.startswith(_NOT_OF_ENCODING)])


def key_of_cache(config: DataConfig, fingerprint: str, encoding: Encoding) -> CacheKey:
    """Return the cache key of an open data set, whose stride is a number.

    Args:
        config: How its clips are made.
        fingerprint: Of its episodes.
        encoding: How frames become latents.
    """
    return CacheKey({
        "format": FORMAT,
        **encoding.parts,
        **clip_parts(config),
        "data.cache_dtype": config.cache_dtype,
        "data.camera": list(config.cameras),
        "data.pose_frame": config.pose_frame,
        "data set": {"source": config.source, "episodes": fingerprint, **config.own_values},
    })  # fmt: skip


def clip_parts(config: DataConfig) -> dict[str, Any]:
    """Return the parts that determine which frames and other data clips need: checked when a cache is used alone."""
    values = values_that_affect(Affects.LATENTS, config) | {"stride": config.model_stride}
    names = values.keys() - _OF_THE_FRAMES - config.own_sections().keys()
    return {f"data.{name}": values[name] for name in sorted(names)}


def require_own_folder(folder: Path | str, name: str, key: CacheKey, *, where: str) -> None:
    """Refuse a folder that was begun with another key, or that holds other files; one that is not there passes.

    Args:
        folder: The folder, or its URL.
        name: Its JSON file with the key.
        key: Of what is about to be written there.
        where: The folder, for messages.

    Raises:
        InputError: Names what differs.
        UnreachableError: It cannot be read now.
    """
    fix = "Name another folder, or delete this one"
    others = [other for other in storage.list_names(folder) if other[0] != "."]  # first: another process may begin now
    try:
        there = read_json_object(storage.join(folder, name), fix=fix)
    except MissingFileError:
        if others:
            found = f"a folder with other things in it, such as {others[0]}"
            raise InputError(where=where, found=found, needed="a new or empty one", fix=fix) from None
        return
    if differing := CacheKey(there.get("key") or {}).differences(key.parts):
        found, needed = f"made otherwise: {'; '.join(differing)}", "a new folder, or one made with these settings"
        raise InputError(where=where, found=found, needed=needed, fix=fix)


def _differences(name: str, here: Any, there: Any) -> list[str]:
    if here == there:
        return []
    if isinstance(here, dict) and isinstance(there, dict):
        inner = sorted(here.keys() | there)
        return [text for key in inner for text in _differences(f"{name}.{key}", here.get(key), there.get(key))]
    return [f"{name}: {_as_text(here)}, not {_as_text(there)}"]


def _as_text(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
