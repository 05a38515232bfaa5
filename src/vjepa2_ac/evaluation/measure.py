"""Measure predictions: errors between predicted and true latents, and the errors of persistence.

All errors compare layer-normalised latents, per clip and model step. *Persistence* copies the last given frame. A
relative error of 1 is as good as persistence, and 0 is perfect.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.distributed import gather_shared
from vjepa2_ac.episode import Batch, LatentBatch
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.result import L1, MODES, ActionMode, Metric, Mode, PredictionErrors

_Window = TypeVar("_Window")
# Rollouts take longest, so they are made with the true actions only.
VALIDATION_PREDICTIONS: tuple[tuple[ActionMode, Mode], ...] = (
    *(("true", mode) for mode in MODES),
    *(("persistence", mode) for mode in MODES),
    ("zero", "teacher_forced"),
    ("shuffled", "teacher_forced"),
)
_MAX_FRAMES = 8  # of a clip: as in the training of the released weights, and short enough for large strides
ONE_STEP_PREDICTIONS: tuple[tuple[ActionMode, Mode], ...] = (
    ("true", "teacher_forced"),
    ("persistence", "teacher_forced"),
)


@runtime_checkable
class Predictor(Protocol):
    """A predictor of latents: `WorldModel`, or an oracle in a test."""

    def predict(
        self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None
    ) -> Float[Tensor, "batch time tokens dim"]:
        """Return the prediction of each frame from the true frames before it (teacher forcing)."""
        ...

    def rollout(
        self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None
    ) -> Float[Tensor, "batch horizon tokens dim"]:
        """Return the predicted frames after the context; each prediction is the input of the next one."""
        ...


@dataclass(frozen=True)
class ClipSample:
    """Options of a sample of held-out clips."""

    split: Split = "validation"
    clips: int = 64  # maximum number of clips
    batch_size: int = 8
    strides: tuple[int, ...] = ()  # strides of a calibration; empty: `windows.candidate_strides`

    def num_frames(self, config: DataConfig) -> int:
        """Return the number of frames of a clip: `data.frames`, but at most 8."""
        return min(config.frames, _MAX_FRAMES)


@torch.no_grad()
def measure_errors(
    model: Predictor,
    batch: LatentBatch,
    predictions: Sequence[tuple[ActionMode, Mode]],
    metrics: Sequence[Metric],
    shuffled_actions: Float[Tensor, "batch time action_dim"] | None = None,
    on_prediction: Callable[[ActionMode, Mode, Float[Tensor, "batch horizon tokens dim"]], None] | None = None,
) -> PredictionErrors:
    """Return the errors of a model on a batch of clips.

    Args:
        model: The predictor.
        batch: The clips.
        predictions: The actions and the mode of each prediction.
        metrics: The metrics of the errors.
        shuffled_actions: The actions of other clips, required for predictions with shuffled actions.
        on_prediction: Called with each prediction, since predictions are not stored.
    """
    arrays: dict[tuple[ActionMode, Mode, str], Float[np.ndarray, "clips horizon"]] = {}
    for actions, mode in predictions:
        predicted = predict_frames(model, batch, actions, mode, shuffled_actions)
        if on_prediction is not None:
            on_prediction(actions, mode, predicted)
        for metric in metrics:
            errors = metric.of(predicted, batch.latents[:, 1:])
            arrays[actions, mode, metric.name] = np.asarray(errors.cpu().numpy(), dtype=np.float64)
    return PredictionErrors(batch.episode_ids, arrays)


def concatenate_errors(parts: Sequence[PredictionErrors]) -> PredictionErrors:
    """Concatenate the errors of several batches.

    Raises:
        InputError: There are no batches.
    """
    if not parts:
        raise no_readable_clips()
    arrays = {key: np.concatenate([part.arrays[key] for part in parts]) for key in parts[0].arrays}
    return PredictionErrors(tuple(name for part in parts for name in part.episode_ids), arrays)


def no_readable_clips() -> InputError:
    """Return the error that none of the clips can be read."""
    fix = "Repair or fetch these episodes again, or add them to data.exclude"
    return InputError(where="data.path", found="none of the clips can be read: their episodes are broken", fix=fix)


def prediction_errors(
    model: Predictor,
    batches: Iterable[LatentBatch],
    metrics: Sequence[Metric] = (L1,),
    before: Float[Tensor, "1 time action_dim"] | None = None,
) -> PredictionErrors:
    """Return the errors of a validation. The batches are measured one by one, and no latents are stored.

    If several processes share the work, each process passes its own batches, and `before` as in
    `with_shuffled_actions`.
    """
    pairs = with_shuffled_actions(batches, before)
    return concatenate_errors(
        gather_shared(
            [
                measure_errors(model, batch, VALIDATION_PREDICTIONS, metrics, shuffled_actions)
                for batch, shuffled_actions in pairs
            ]
        )
    )


def previous_clip_actions(
    indices: range, windows: Sequence[_Window], read: Callable[[list[_Window]], Iterator[Batch]]
) -> Float[Tensor, "1 time action_dim"] | None:
    """Return the shuffled actions of this process's first clip: the actions of the clip before it.

    Return None if the process has all clips, or no clips.

    Args:
        indices: Indices of this process's clips.
        windows: The windows of all clips.
        read: Reads the clips at some windows; broken clips are left out.
    """
    if len(indices) in (0, len(windows)):
        return None
    earlier = (batch.actions for window in reversed(windows[: indices.start]) for batch in read([window]))
    if (previous := next(earlier, None)) is not None:
        return previous
    # No earlier clip can be read: use the second readable clip, as a single process does for its first clip.
    readable = (batch.actions for window in windows for batch in read([window]))
    return next(islice(readable, 1, None), None)


def with_shuffled_actions(
    batches: Iterable[LatentBatch], before: Float[Tensor, "1 time action_dim"] | None = None
) -> Iterator[tuple[LatentBatch, Float[Tensor, "batch time action_dim"]]]:
    """Yield each batch with shuffled actions: each clip gets the actions of the previous clip, for any batch size.

    The first clip gets `before`. Without it, the first clip gets the actions of the second clip, and a single clip gets
    its own actions in reverse order.
    """
    remaining = iter(batches)
    first = list(islice(remaining, 1))
    if before is None and first:
        first += islice(remaining, 1 if len(first[0].actions) == 1 else 0)  # a second clip is needed
        actions = torch.cat([batch.actions for batch in first])
        before = actions[1:2] if len(actions) > 1 else actions.flip(1)
    for batch in chain(first, remaining):
        assert before is not None  # noqa: S101  # there is a first batch
        yield batch, torch.cat([before.to(batch.actions), batch.actions[:-1]])
        before = batch.actions[-1:]


def predict_frames(
    model: Predictor,
    batch: LatentBatch,
    actions: ActionMode = "true",
    mode: Mode = "rollout",
    shuffled_actions: Tensor | None = None,
) -> Float[Tensor, "batch horizon tokens dim"]:
    """Return the predictions of all frames after the first.

    The model receives the true states with all actions, and these can reveal the motion. The increase of the error with
    zero or shuffled actions is therefore a lower bound of the model's sensitivity to actions.
    """
    context = batch.latents[:, :1] if mode == "rollout" else batch.latents[:, :-1]
    if actions == "persistence":
        return context.expand_as(batch.latents[:, 1:])
    actions_by_mode = {"true": batch.actions, "zero": torch.zeros_like(batch.actions)}
    actions_by_mode |= {} if shuffled_actions is None else {"shuffled": shuffled_actions}
    extrinsics = None if batch.extrinsics is None else batch.extrinsics[:, :-1]
    predict = model.rollout if mode == "rollout" else model.predict
    return predict(context, actions_by_mode[actions], batch.states[:, :-1], extrinsics)
