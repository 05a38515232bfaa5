"""Transforms of training clips, in a module that loader workers can import."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import BaseModel

from vjepa2_ac.episode import Clip


class Offset:
    """Add one random number to all pixels of a clip."""

    class Config(BaseModel, extra="forbid"):
        """The options."""

        most: int = 100

    def __init__(self, options: Config) -> None:
        self._most = options.most

    def __call__(self, clip: Clip, generator: np.random.Generator) -> Clip:
        return replace(clip, frames=clip.frames + np.uint8(generator.integers(1, self._most)))


def halve(clip: Clip, _: np.random.Generator) -> Clip:
    """Halve all pixels."""
    return replace(clip, frames=clip.frames // 2)


def cut(clip: Clip, _: np.random.Generator) -> Clip:
    """Keep the upper half of the frames."""
    return replace(clip, frames=clip.frames[:, : clip.frames.shape[1] // 2])


TRANSFORMS: dict[str, Any] = {"offset": Offset, "halve": halve, "cut": cut}
