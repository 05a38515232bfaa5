"""Replay knobs: a second data set that a share of the training clips comes from."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from vjepa2_ac.config.data import DataConfig
from vjepa2_ac.config.section import Affects, AtMost, Section


class ReplayConfig(Section):
    """Clips of a second data set, mixed into training against forgetting: those of the base, or of varied motion.

    Validation, evaluation and planning know the first data set only.
    """

    share: Annotated[float, Field(gt=0.0, lt=1.0), Affects.RUN] = 0.25
    """Share of the training clips that come from it, evenly spread over the run."""
    data: Annotated[DataConfig, AtMost(Affects.RUN)]
    """The second data set, with the knobs of `data`: as many frames, the same kind of states and actions, and latents
    of a cache if the first one's clips are. Only its training split is used; `workers` and `prefetch` are not."""

    @model_validator(mode="after")
    def _stride_is_known(self) -> ReplayConfig:
        if self.data.stride == "auto":
            raise ValueError("data.stride auto: give its number; the model chooses for the first data set only")
        return self

    def misfits(self, first: DataConfig) -> list[str]:
        """Return why clips of both cannot be in one micro-batch, as far as their configs say."""
        same = ("frames", "states", "actions", "join_actions", "pose_frame")
        lines = [
            f"replay.data.{name} {getattr(self.data, name)} is not data.{name} {getattr(first, name)}"
            for name in same
            if getattr(self.data, name) != getattr(first, name)
        ]
        if self.data.takes_latents != first.takes_latents:
            from_cache, from_frames = ("replay.data", "data") if self.data.takes_latents else ("data", "replay.data")
            lines.append(f"{from_cache} takes latents from a cache and {from_frames} does not: set cache of both alike")
        if first.stride == "auto":
            lines.append("data.stride auto with replay: give its number, so that steps of both last equally long")
        return lines
