"""The records of decoded rollouts: plain arrays by clip and horizon, from which `decoded.estimates` computes the rest.

Frame 0 is given, so horizons begin at 1 (index h - 1). A *source* is a model's rollout under the true actions, or one
of its neighbours: decoded truth (the ceiling of this decoder), decoded persistence (the floor), and raw persistence, a
copy of the pixels of frame 0, which beats any decoder in PSNR where little moves.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float, UInt8

from vjepa2_ac.evaluation.distribution.mmd import Discrepancy
from vjepa2_ac.evaluation.video.record import FVD_LABEL, FrechetVideoDistances, LpipsDistances
from vjepa2_ac.intervals import Estimate

Reference = Literal["truth", "decoded_truth"]
Region = Literal["whole", "moving"]
Similarity = Literal["psnr_db", "ssim", "ms_ssim"]
REFERENCES: tuple[Reference, ...] = get_args(Reference)
REGIONS: tuple[Region, ...] = get_args(Region)
SIMILARITIES: tuple[Similarity, ...] = get_args(Similarity)

Key = tuple[str, Reference, Region, Similarity]  # the first: a model or a neighbour
Arrays = Mapping[Key, Float[np.ndarray, "clips horizon"]]

DECODED_TRUTH, DECODED_PERSISTENCE, RAW_PERSISTENCE = "decoded_truth", "decoded_persistence", "raw_persistence"
MEANING = (
    "Squared MMD with JEDi's kernel on mean-pooled features of this model's own encoder, unbiased over episodes, x 100."
    " Not JEDi (V-JEPA ViT-H, probe of Something-Something v2, another estimator). Comparable only for the same"
    " encoder, clips, frames, stride and decoder. The encoder judges images that were made from its own features: what"
    " it does not see, this does not see."
)
"""The words that stand beside a V-JEPA 2 MMD wherever it is shown."""

ABSENT: Mapping[str, str] = {
    "truth": "Against the truth",
    "cycle": "Cycle error",
    "video": "V-JEPA 2 MMD",
    "hand": "The hand's position",
    "ssim": "SSIM",
    "ms_ssim": "MS-SSIM",
    "lpips": "LPIPS",
    "fvd": FVD_LABEL,
}
"""What may be absent, and what a reader knows it by."""

NEIGHBOURS = (DECODED_TRUTH, DECODED_PERSISTENCE, RAW_PERSISTENCE)
TRUE_FRAMES = "truth"


@dataclass(frozen=True)
class Found:
    """A metric at one horizon, or the reason why it is absent."""

    estimate: Estimate | None
    reason: str = ""  # of None
    identical: int = 0  # clips left out: identical images, whose PSNR is infinite
    still: int = 0  # clips left out: nothing moves in them

    @property
    def value(self) -> float:
        """The value; NaN: absent."""
        return math.nan if self.estimate is None else self.estimate.value

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        numbers = Estimate(math.nan, math.nan, math.nan) if self.estimate is None else self.estimate
        left_out = {name: count for name, count in (("identical", self.identical), ("still", self.still)) if count}
        return numbers.as_dict() | left_out | ({"reason": self.reason} if self.estimate is None else {})


@dataclass(frozen=True, eq=False)
class DecodedStrip:
    """The images of one example clip."""

    why: str
    episode_id: str
    start: int
    rows: Mapping[str, UInt8[np.ndarray, "time size size 3"]]  # truth, decoded_truth, base, adapter; the first is given


@dataclass(frozen=True)
class VideoDiscrepancy:
    """The V-JEPA 2 MMD of each source, of whole clips with the given frame."""

    against_truth: Mapping[str, Discrepancy]  # empty: from a cache, which has no frames
    against_decoded_truth: Mapping[str, Discrepancy]
    noise_floor: Mapping[str, float]  # of truth and decoded truth: what two halves of their episodes stay below
    frames: int  # of each video
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class HandErrors:
    """How far the hand is from where it is, read from images by a probe that was fitted on true ones."""

    pixels: Mapping[str, Float[np.ndarray, "clips horizon"]]  # by source, and of the true frames
    size: int  # height and width of the images, in pixels
    held_out: Estimate  # of the probe itself, on held-out true frames
    fitted_on: tuple[int, int]  # frames, episodes of the training split
    mean_position: float  # the error of always saying the mean position of the training frames: what a useless one has


@dataclass(frozen=True)
class DecodedRollouts:
    """All that was measured of decoded rollouts."""

    decoder: Mapping[str, Any]  # what is known of it: folder, size, encoder, data, frames, steps, held_out
    episode_ids: tuple[str, ...]
    models: tuple[str, ...]  # in the order of the evaluation
    horizon: int
    arrays: Arrays
    moving_share: Float[np.ndarray, "clips horizon"] | None  # of the pixels; None: there are no true frames
    cycle: Mapping[str, Float[np.ndarray, "clips horizon"]]  # of models and the decoded truth
    video: VideoDiscrepancy | None = None
    hand: HandErrors | None = None
    lpips: LpipsDistances | None = None
    fvd: FrechetVideoDistances | None = None
    strips: tuple[DecodedStrip, ...] = ()
    absent: Mapping[str, str] = field(default_factory=dict)  # a key of ABSENT -> the reason
