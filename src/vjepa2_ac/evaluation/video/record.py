"""Metrics of networks that a user names by file: their records, labels and reasons. PyTorch is not imported."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

NO_LPIPS = (
    "it needs the weights of a backbone and of its heads, which are not shipped: name them with --lpips and"
    " --lpips-heads"
)
NO_I3D = "it needs the file i3d_torchscript.pt, which is not shipped: name it with --i3d"
FVD_LABEL = "FVD (biased)"
LPIPS_MEANING = (
    "A distance: 0 is identical, lower is better. Of whole images, which are mostly background: read it beside decoded"
    " truth and decoded persistence. Comparable only for the same backbone, image size and decoder."
)
"""The words that stand beside an LPIPS wherever it is shown."""

FVD_MEANING = (
    "Frechet distance of I3D features of whole clips, the given frame included. Biased: it grows as clips get fewer, of"
    " few clips a smoothed set may score better than a second sample of the truth, and two samples of one distribution"
    " are far apart. The clips are the same in both sets, which lowers it. Comparable only for the same clips, their"
    " number, frames, stride and decoder. It has no interval: a bootstrap repeats clips, which adds to the bias."
)
"""The words that stand beside an FVD wherever it is shown."""


@dataclass(frozen=True, eq=False)
class LpipsDistances:
    """LPIPS of whole images, by source and reference."""

    backbone: str  # alex, vgg
    by_clip: Mapping[tuple[str, str], Float[np.ndarray, "clips horizon"]]

    def about(self) -> dict[str, Any]:
        """Return what is known of the metric, for JSON."""
        return {"backbone": self.backbone, "version": "0.1", "region": "whole", "meaning": LPIPS_MEANING}


@dataclass(frozen=True)
class FrechetVideoDistance:
    """FVD, or why there is none."""

    value: float | None
    clips: int  # in each set; the bias depends on it
    reason: str = ""  # why there is no value

    def as_dict(self) -> dict[str, float | int | str | None]:
        """Return plain values, for JSON."""
        return {"value": self.value, "clips": self.clips, "reason": self.reason or None, "label": FVD_LABEL}


@dataclass(frozen=True)
class FrechetVideoDistances:
    """FVD by reference and source, of clips with the given frame."""

    against: Mapping[str, Mapping[str, FrechetVideoDistance]]  # by reference; without truth from a cache
    clips: int
    features: int  # numbers of a clip

    @property
    def notes(self) -> tuple[str, ...]:
        """What makes these values worse than the label says."""
        if self.clips > self.features:
            return ()
        return (f"{self.clips} clips of {self.features} features: their covariance is singular, and the bias large",)

    def about(self) -> dict[str, Any]:
        """Return what is known of the metric, for JSON."""
        return {"label": FVD_LABEL, "meaning": FVD_MEANING, "clips": self.clips, "notes": list(self.notes)}
