"""One-step action energies: the prediction error of one frame under each of many actions."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.distances import absolute_difference
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.evaluation.measure import Predictor
from vjepa2_ac.spaces import POSE, ActionSpace, vector_states


@dataclass(frozen=True)
class RolloutStart:
    """One frame of a held-out clip, and the true next frame: the state of a planner before an action."""

    clip: int  # index into the evaluation's clips
    episode_id: str
    first_step: int  # control step at which the clip begins
    frame: Float[Tensor, "tokens dim"]
    following: Float[Tensor, "tokens dim"]  # the next frame
    state: Float[Tensor, " state_dim"]
    action: Float[Tensor, " action_dim"]  # that led to it
    extrinsics: Float[Tensor, " 6"] | None

    @property
    def persistence(self) -> float:
        """The L1 error of predicting that nothing changes."""
        return float(absolute_difference(self.frame, self.following).mean())

    def generator(self, seed: int) -> np.random.Generator:
        """Return a random generator that depends only on the seed and this clip, not on those before it."""
        return clip_generator(seed, self.episode_id, self.first_step)


@dataclass(frozen=True)
class EvaluatedActions:
    """The results of each evaluated action of a start."""

    energy: Float[np.ndarray, " samples"]  # L1 distance of the prediction to the true next frame
    change: Float[np.ndarray, " samples"]  # L1 distance of the prediction to that with the true action


def clip_generator(seed: int, episode_id: str, first_step: int) -> np.random.Generator:
    """Return a random generator that depends only on the seed and the name of a clip, not on the clips before it."""
    digest = hashlib.blake2b(f"{episode_id} {first_step}".encode(), digest_size=8).digest()
    return np.random.default_rng([seed, int.from_bytes(digest, "big")])


def start_of(batch: LatentBatch, row: int, step: int, clip: int) -> RolloutStart:
    """Return a step of a clip in a batch as a start."""
    return _start(batch, row, clip, (step, step + 1), batch.actions[row, step])


def moves_of(batch: LatentBatch, row: int, clip: int, space: ActionSpace, reach: float) -> tuple[RolloutStart, ...]:
    """Return two moves of a clip as starts: the longest within reach, from one of its frames to another, and back.

    The world around an arm that moves slowly is what its pose makes it: frames that are several steps apart show what
    one larger action does, and in reverse order what the opposite one does. (What falls or was dropped does not go
    back: such clips are harder for every model alike.) If all moves are longer, the shortest is taken. Commands that
    are no changes of the state cannot be joined or turned back: then it is the clip's largest step, as it is.

    Args:
        batch: Of clips.
        row: The clip's, in the batch.
        clip: Its index.
        space: Of its actions.
        reach: Of a move, in metres; of vectors every move is within it.
    """
    if space.follows != "change":
        return (start_of(batch, row, int(batch.actions[row].norm(dim=-1).argmax()), clip),)
    states = batch.states[row].cpu().numpy().astype(np.float64)
    kind = vector_states(states.shape[1]) if space.position is None else POSE
    pairs = [(first, last) for first in range(len(states)) for last in range(first + 1, len(states))]
    changes = np.concatenate([kind.differences(states[[first, last]]) for first, last in pairs])
    lengths = np.linalg.norm(changes[:, kind.sized], axis=1)
    within = lengths <= (np.inf if space.position is None else reach)
    ends = pairs[int(np.where(within, lengths, -1.0).argmax() if within.any() else lengths.argmin())]
    found = []
    for pair in (ends, ends[::-1]):
        change = kind.differences(states[list(pair)])[0]
        found.append(_start(batch, row, clip, pair, torch.from_numpy(change).to(batch.actions)))
    return tuple(found)


@torch.no_grad()
def evaluate_actions(
    model: Predictor, start: RolloutStart, actions: Float[np.ndarray, "samples action_dim"], *, at_once: int
) -> EvaluatedActions:
    """Predict one step from one frame under each action; with the true state and camera.

    Args:
        model: The predictor.
        start: The frame.
        actions: In the units of the data.
        at_once: Samples per batch: limits the memory.
    """
    expected = _predict(model, start, start.action[None])[0]
    energies, changes = [], []
    for part in torch.from_numpy(actions.astype(np.float32)).to(start.action).split(at_once):  # type: ignore[no-untyped-call]  # torch
        predicted = _predict(model, start, part)
        energies.append(absolute_difference(predicted, start.following).mean(dim=(1, 2)))
        changes.append(absolute_difference(predicted, expected).mean(dim=(1, 2)))
    return EvaluatedActions(*(torch.cat(parts).cpu().numpy().astype(np.float64) for parts in (energies, changes)))


def _start(batch: LatentBatch, row: int, clip: int, ends: tuple[int, int], action: Tensor) -> RolloutStart:
    """Return two frames of a clip, and the action that leads from the first to the second, as a start."""
    first, last = ends
    return RolloutStart(
        clip=clip,
        episode_id=batch.episode_ids[row],
        first_step=batch.starts[row],
        frame=batch.latents[row, first].clone(),
        following=batch.latents[row, last].clone(),
        state=batch.states[row, first],
        action=action,
        extrinsics=None if batch.extrinsics is None else batch.extrinsics[row, first],
    )


def _predict(
    model: Predictor, start: RolloutStart, actions: Float[Tensor, "samples action_dim"]
) -> Float[Tensor, "samples tokens dim"]:
    """Return the predictions in float32. Keys are not shared: the only frame has its action beside it."""
    count = len(actions)
    camera = None if start.extrinsics is None else start.extrinsics.expand(count, 1, -1)
    frames = start.frame.expand(count, 1, *start.frame.shape)
    return model.predict(frames, actions[:, None], start.state.expand(count, 1, -1), camera)[:, 0].float()
