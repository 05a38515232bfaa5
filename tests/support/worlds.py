"""A world that can be computed by hand, and predictors with known errors."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.evaluation.evaluate import RepeatableClips
from vjepa2_ac.evaluation.result import About
from vjepa2_ac.spaces import POSE_CHANGE, ActionSpace

TIME, TOKENS, DIM = 5, 4, 6


def moved(latents: Tensor, actions: Tensor) -> Tensor:
    """Return the next frames of this world: the first numbers of every token grow by those of the action, in cm."""
    grown = torch.zeros(*latents.shape[:2], 1, latents.shape[-1])
    width = min(actions.shape[-1], latents.shape[-1])
    grown[..., :width] = actions[:, :, None, :width] * 100
    return latents + grown


class Oracle:
    """A predictor without errors."""

    def predict(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        """Return the true next frames, given true ones and true actions."""
        del states, extrinsics
        return moved(latents, actions)

    def rollout(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        """Return the frames after the first."""
        frames = [latents[:, -1:]]
        for step in range(actions.shape[1]):
            frames.append(self.predict(frames[-1], actions[:, step : step + 1], states, extrinsics))
        return torch.cat(frames[1:], dim=1)


class Copier:
    """Persistence: predicts the last input frame."""

    def predict(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        """Return the input frames."""
        del actions, states, extrinsics
        return latents

    def rollout(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        """Return the last input frame for each step."""
        del states, extrinsics
        return latents[:, -1:].expand(-1, actions.shape[1], -1, -1)


class Halfway(Oracle):
    """A predictor that underestimates the effect of actions by half."""

    def predict(self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None) -> Tensor:
        """Return the next frames with half of the true change."""
        return super().predict(latents, actions / 2, states, extrinsics)


def actions_of(clips: int, seed: int = 0, width: int = 7) -> Tensor:
    """Return actions of a few cm with small rotations."""
    generator = torch.Generator().manual_seed(seed)
    return 0.03 * torch.randn(clips, TIME - 1, width, generator=generator)


def clips_batch(clips: int = 12, seed: int = 0, width: int = 7, actions: Tensor | None = None) -> LatentBatch:
    """Return clips of this world, two of each episode."""
    actions = actions_of(clips, seed, width) if actions is None else actions
    generator = torch.Generator().manual_seed(seed + 1)
    start = torch.randn(clips, 1, TOKENS, DIM, generator=generator)
    states = torch.zeros(clips, TIME, 7)
    latents = torch.cat([start, Oracle().rollout(start, actions, states)], dim=1)
    ids = tuple(f"episode {clip // 2}" for clip in range(clips))
    return LatentBatch(latents, states, actions, None, ids, tuple(range(clips)))


def rows(batch: LatentBatch, indices: list[int]) -> LatentBatch:
    """Return some clips of a batch."""
    return LatentBatch(
        batch.latents[indices],
        batch.states[indices],
        batch.actions[indices],
        None,
        tuple(batch.episode_ids[index] for index in indices),
        tuple(batch.starts[index] for index in indices),
    )


def in_batches(batch: LatentBatch, size: int) -> list[LatentBatch]:
    """Return the same clips in smaller batches."""
    count = len(batch.starts)
    return [rows(batch, list(range(first, min(first + size, count)))) for first in range(0, count, size)]


def repeatable_clips(batch: LatentBatch, size: int = 4, space: ActionSpace = POSE_CHANGE) -> RepeatableClips:
    """Return clips that can be read several times, with grey images."""
    indices = {name: index for index, name in enumerate(zip(batch.episode_ids, batch.starts, strict=True))}

    def read(names):  # type: ignore[no-untyped-def]
        chosen = list(indices.values()) if names is None else [indices[name] for name in names]
        for part in in_batches(rows(batch, chosen), size):
            yield part, lambda _: np.full((TIME, 8, 8, 3), 128, np.uint8)

    return RepeatableClips(tuple(indices), read, space)


def about(**changes: object) -> About:
    """Return the description of an evaluation of these clips."""
    values: dict[str, object] = {
        "subject": "run", "checkpoint": "step-00000002 (the newest)", "checkpoint_path": "step-00000002",
        "source": "rlds", "data": "data", "cameras": ("exterior_1_left",), "split": "test", "frames": TIME, "stride": 4,
        "seconds_per_step": 0.25, "seed": 0, "version": "0", "time": "2026-01-01T00:00:00Z",
    }  # fmt: skip
    return About(**(values | changes))  # type: ignore[arg-type]
