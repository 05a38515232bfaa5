"""The key of a latent cache: everything that determines its latents, by the names that users know."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.section import Affects, knobs_that_affect
from vjepa2_ac.data.sources.latents.dtypes import DTYPES, CacheType
from vjepa2_ac.errors import InputError
from vjepa2_ac.storage.structured import shown

NORMALISATION = 1  # of pixels, in `transforms.pixels_to_input`, and of features: increase it when one of them changes

_OF_THE_FRAMES = {"source", "camera", "pose_frame", "cache_dtype"}  # the other knobs are of clips
OF_ENCODING = (
    "encoder", "image_size", "patch_size", "normalisation", "model.dtype", "training.precision",
    "encoder.family", "encoder.frame", "encoder.heads",
)  # fmt: skip


@dataclass(frozen=True)
class Encoding:
    """What determines a frame's latents besides the frame, and their size; made by `encoding.batch.encoding_of`.

    The number of frames per pass of the encoder is not included: with this encoder it changes no bit on a CPU
    (measured, tests/encoding/test_latent_cache.py), and elsewhere only the order of a sum.
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
    """What determines the content of a cache, as {name: JSON value}; with the names of knobs where they exist."""

    parts: Mapping[str, Any]

    @property
    def digest(self) -> str:
        """A short hash of it: the name of the cache's folder, also in each of its files."""
        return hashlib.sha256(json.dumps(dict(self.parts), sort_keys=True).encode()).hexdigest()[:32]

    @property
    def kind(self) -> CacheType:
        """The storage type of latents."""
        kind: CacheType = self.parts["data.cache_dtype"]
        return kind

    def require_whole(self, *, where: str, fix: str) -> None:
        """Refuse a key from a file without the parts needed to read a cache.

        Raises:
            InputError: A part is missing.
        """
        cameras, kind = self.parts.get("data.camera"), self.parts.get("data.cache_dtype")
        named = isinstance(cameras, list) and cameras and all(isinstance(camera, str) for camera in cameras)
        if not named or not isinstance(kind, str) or kind not in DTYPES:
            found = f"a key with data.camera {shown(cameras)} and data.cache_dtype {shown(kind)}"
            needed = f"names of cameras, and one of {', '.join(DTYPES)}"
            raise InputError(where=where, found=found, needed=needed, fix=fix)

    def differences(self, wanted: Mapping[str, Any], names: Collection[str] | None = None) -> list[str]:
        """Return the differences from the wanted key, as "data.stride: 8, not 4"; of these names, or of all."""
        names = sorted(self.parts.keys() | wanted) if names is None else names
        return [text for name in names for text in _differences(name, self.parts.get(name), wanted.get(name))]


def key_of_cache(config: DataConfig, fingerprint: str, encoding: Encoding) -> CacheKey:
    """Return the cache key of an open data set, whose stride is a number.

    Args:
        config: How its clips are made.
        fingerprint: Of its episodes.
        encoding: How frames become latents.
    """
    return CacheKey({
        "format": 1,
        **encoding.parts,
        **clip_parts(config),
        "data.cache_dtype": config.cache_dtype,
        "data.camera": list(config.cameras),
        "data.pose_frame": config.pose_frame,
        "data set": {
            "source": config.source,
            "episodes": fingerprint,
            **{name: knobs_that_affect(Affects.LATENTS, section) for name, section in config.own_section.items()},
        },
    })  # fmt: skip


def clip_parts(config: DataConfig) -> dict[str, Any]:
    """Return the parts that determine which frames and other data clips need: checked when a cache is used alone."""
    knobs = knobs_that_affect(Affects.LATENTS, config) | {"stride": config.model_stride}
    return {f"data.{name}": knobs[name] for name in sorted(knobs.keys() - _OF_THE_FRAMES - config.own_section.keys())}


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
