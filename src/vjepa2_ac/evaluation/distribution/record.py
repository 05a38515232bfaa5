"""What is known of the latents that a model predicts, as a whole."""

from __future__ import annotations

from dataclasses import dataclass

from vjepa2_ac.evaluation.distribution.mmd import Discrepancy
from vjepa2_ac.intervals import Estimate


@dataclass(frozen=True)
class LatentDistribution:
    """How the latents of one kind of prediction are distributed, by horizon (index h - 1), against the truth."""

    spread: tuple[Estimate, ...]  # 1: as varied as the truth
    mmd: tuple[Discrepancy, ...]  # of latents averaged over tokens
