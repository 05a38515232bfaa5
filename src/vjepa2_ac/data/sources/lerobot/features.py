"""The features that meta/info.json lists: columns of numbers, cameras, depth maps, language."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from vjepa2_ac.media.video_reader import is_deep_grey


@dataclass(frozen=True)
class Feature:
    """One column, or one camera."""

    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...] = ()
    is_depth: bool = field(default=False, repr=False)  # not in the key of stored indexes

    @property
    def width(self) -> int:
        """Its width: numbers per step."""
        return math.prod(self.shape)

    @property
    def is_camera(self) -> bool:
        """Whether it contains frames that show what a camera saw."""
        return self.dtype in {"video", "image"} and not self.is_depth

    @property
    def is_numbers(self) -> bool:
        """Whether it is a column of numbers."""
        return self.dtype.startswith(("float", "int", "uint", "bool"))

    @property
    def kind(self) -> str:
        """What it is, in words."""
        if self.is_depth:
            return "a depth map"
        if self.is_camera:
            return "a camera"
        return "a column of numbers" if self.is_numbers else f"a column of {self.dtype}"


def feature_of(content: Mapping[str, Any]) -> Feature:
    """Return a feature as meta/info.json describes it.

    Raises:
        KeyError, TypeError, AttributeError: It is not described as one.
    """
    dtype, shape, names = content["dtype"], tuple(content["shape"]), content.get("names")
    if not isinstance(dtype, str) or not all(type(size) is int and size > 0 for size in shape):
        raise TypeError(f"a feature of dtype {dtype!r} and shape {shape!r}")
    if isinstance(names, dict) and len(names) == 1:  # {"motors": ["x", "y", ...]}, as in older ports
        names = next(iter(names.values()))
    named = tuple(map(str, names)) if isinstance(names, list) else ()
    return Feature(dtype, shape, named, is_depth=_is_depth(content))


def _is_depth(content: Mapping[str, Any]) -> bool:
    """Return whether a feature is marked as a depth map, in one of the ways of LeRobot's versions, or stored as one.

    Source: huggingface/lerobot @ 7427f31, src/lerobot/configs/video.py, is_depth_map.
    """
    said = [content.get(name) for name in ("info", "video_info")]
    marks = [one for one in said if isinstance(one, Mapping)]
    return any(
        one.get("is_depth_map") or one.get("video.is_depth_map") or is_deep_grey(str(one.get("video.pix_fmt")))
        for one in marks
    )
