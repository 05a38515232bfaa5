"""LPIPS and FVD of decoded rollouts: networks from files that the user names, and why there is none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.evaluation.decoded.record import Reference
from vjepa2_ac.evaluation.request import EvaluationOptions
from vjepa2_ac.evaluation.video.frechet import LEAST_FRAMES, I3d, frechet_video_distance
from vjepa2_ac.evaluation.video.lpips import LEAST_SIDE, Lpips, LpipsFiles, load_lpips
from vjepa2_ac.evaluation.video.record import NO_I3D, NO_LPIPS, FrechetVideoDistances

IMAGES = 8
"""Images of each source that go through LPIPS at once: of VGG, 256 pixels and six sources they take 1.6 GB."""


@dataclass(frozen=True, eq=False)
class MetricNetworks:
    """The networks of metrics; None: no file was named."""

    lpips: Lpips | None = None
    i3d: I3d | None = None

    def to(self, device: torch.device) -> MetricNetworks:
        """Move them to a device."""
        if self.lpips is not None:
            self.lpips.to(device)
        if self.i3d is not None:
            self.i3d.to(device)
        return self

    def why_no_lpips(self, side: int) -> str:
        """Return why there is no LPIPS of images of this side; "": there is."""
        if self.lpips is None:
            return NO_LPIPS
        return "" if side >= LEAST_SIDE else f"images of {side} pixels; it needs {LEAST_SIDE} a side"

    def why_no_features(self, frames: int) -> str:
        """Return why I3D gives no features of clips of so many frames; "": it does."""
        if self.i3d is None:
            return NO_I3D
        return "" if frames >= LEAST_FRAMES else f"clips of {frames} frames; I3D needs {LEAST_FRAMES} (data.frames)"


def load_metric_networks(asked: EvaluationOptions) -> MetricNetworks:
    """Read the files of an evaluation's metrics, on the CPU; their hashes and shapes are checked.

    Raises:
        InputError: A file is missing, another one, or cannot be loaded.
    """
    lpips, i3d = None, None
    if asked.lpips is not None and asked.lpips_heads is not None:
        lpips = load_lpips(LpipsFiles(asked.lpips, asked.lpips_heads))
    if asked.i3d is not None:
        i3d = I3d(asked.i3d)
    return MetricNetworks(lpips, i3d)


def lpips_by_pair(
    network: Lpips,
    sources: Mapping[str, Float[Tensor, "batch horizon 3 size size"]],
    references: Mapping[Reference, Float[Tensor, "batch horizon 3 size size"]],
) -> dict[tuple[str, Reference], Float[np.ndarray, "batch horizon"]]:
    """Return LPIPS of whole images in 0 .. 1, of every source and reference; features are computed once of each.

    Args:
        network: On the device of the images.
        sources: By name.
        references: By name; one that is a source, too, is the same images.
    """
    every: dict[str, Tensor] = dict(sources) | {str(name): one for name, one in references.items()}
    images = {name: one.float().flatten(0, 1) for name, one in every.items()}
    shape = next(iter(sources.values())).shape[:2]
    found: dict[tuple[str, Reference], list[Tensor]] = {(one, other): [] for one in sources for other in references}
    for first in range(0, shape[0] * shape[1], IMAGES):
        features = {name: network.features(one[first : first + IMAGES]) for name, one in images.items()}
        for (one, other), parts in found.items():
            parts.append(network.distance(features[one], features[other]))
    return {pair: torch.cat(parts).reshape(shape).double().cpu().numpy() for pair, parts in found.items()}


def frechet_of(
    features: Mapping[str, Float[np.ndarray, "clips dim"]], references: Sequence[str], true_frames: str
) -> FrechetVideoDistances:
    """Return FVD of every source against each reference of which there are features.

    Args:
        features: By source.
        references: Sources to compare with.
        true_frames: The source that is not compared: it is a reference only.
    """
    clips, width = next(iter(features.values())).shape
    against = {
        reference: {
            source: frechet_video_distance(values, features[reference])
            for source, values in features.items()
            if source not in {reference, true_frames}
        }
        for reference in references
        if reference in features
    }
    return FrechetVideoDistances(against, clips, width)
