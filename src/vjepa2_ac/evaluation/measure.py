"""Measurement of predictions: errors between predicted and true latents, and those of persistence.

All errors compare layer-normalised latents, per clip and model step. *Persistence* is the error of copying a frame that
was seen. A ratio of 1 means: as good as persistence; 0: perfect.
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
from vjepa2_ac.distributed import gathered
from vjepa2_ac.episode import Batch, LatentBatch
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.result import L1, MODES, Metric, Mode, PredictionErrors, Way

_Window = TypeVar("_Window")
VALIDATED: tuple[tuple[Way, Mode], ...] = (  # rollouts, which take longest, with the true actions only
    *(("true", mode) for mode in MODES),
    *(("persistence", mode) for mode in MODES),
    ("zero", "teacher_forced"),
    ("shuffled", "teacher_forced"),
)
_MOST_FRAMES = 8  # of a sample: as the released weights were trained, and short enough for the widest stride
ONE_STEP: tuple[tuple[Way, Mode], ...] = (("true", "teacher_forced"), ("persistence", "teacher_forced"))


@runtime_checkable
class Predictor(Protocol):
    """A predictor of latents: `WorldModel`, or an oracle in a test."""

    def predict(
        self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None
    ) -> Float[Tensor, "batch time tokens dim"]:
        """Return the prediction of each next frame from the true frames before it."""
        ...

    def rollout(
        self, latents: Tensor, actions: Tensor, states: Tensor, extrinsics: Tensor | None = None
    ) -> Float[Tensor, "batch horizon tokens dim"]:
        """Return the frames after the context, each prediction fed back."""
        ...


@dataclass(frozen=True)
class ClipSample:
    """Held-out clips to measure, and how many of them are computed together."""

    split: Split = "validation"
    clips: int = 64  # at most
    batch_size: int = 8
    strides: tuple[int, ...] = ()  # of a calibration; empty: `windows.candidate_strides`

    def frames_of(self, config: DataConfig) -> int:
        """Return the frames of a clip of these data: 8 at most."""
        return min(config.frames, _MOST_FRAMES)


@torch.no_grad()
def measured(
    model: Predictor,
    batch: LatentBatch,
    wanted: Sequence[tuple[Way, Mode]],
    metrics: Sequence[Metric],
    others: Float[Tensor, "batch time action_dim"] | None = None,
    watch: Callable[[Way, Mode, Float[Tensor, "batch horizon tokens dim"]], None] | None = None,
) -> PredictionErrors:
    """Return the errors of a model on a batch of clips.

    Args:
        model: The predictor.
        batch: The clips.
        wanted: The predictions to make.
        metrics: By what they are measured.
        others: The actions of other clips, if predictions with shuffled actions are wanted.
        watch: Receives each prediction, which is not stored.
    """
    arrays: dict[tuple[Way, Mode, str], Float[np.ndarray, "clips horizon"]] = {}
    for way, mode in wanted:
        predicted = prediction(model, batch, way, mode, others)
        if watch is not None:
            watch(way, mode, predicted)
        for metric in metrics:
            found = metric.of(predicted, batch.latents[:, 1:])
            arrays[way, mode, metric.name] = np.asarray(found.cpu().numpy(), dtype=np.float64)
    return PredictionErrors(batch.episode_ids, arrays)


def joined(parts: Sequence[PredictionErrors]) -> PredictionErrors:
    """Return the errors of all clips of some batches.

    Raises:
        InputError: There are none.
    """
    if not parts:
        raise no_clips()
    arrays = {key: np.concatenate([part.arrays[key] for part in parts]) for key in parts[0].arrays}
    return PredictionErrors(tuple(name for part in parts for name in part.episode_ids), arrays)


def no_clips() -> InputError:
    """Return the error of clips of which no process can read one."""
    fix = "Repair or fetch these episodes again, or add them to data.exclude"
    return InputError(where="data.path", found="none of the clips can be read: their episodes are broken", fix=fix)


def prediction_errors(
    model: Predictor,
    batches: Iterable[LatentBatch],
    metrics: Sequence[Metric] = (L1,),
    before: Float[Tensor, "1 time action_dim"] | None = None,
) -> PredictionErrors:
    """Measure a model as a validation does, batch after batch, so that no latents are stored.

    Processes that share the work each have some batches, and `before` as of `with_other_actions`.
    """
    pairs = with_other_actions(batches, before)
    return joined(gathered([measured(model, batch, VALIDATED, metrics, others) for batch, others in pairs]))


def actions_before(
    own: range, windows: Sequence[_Window], read: Callable[[list[_Window]], Iterator[Batch]]
) -> Float[Tensor, "1 time action_dim"] | None:
    """Return the actions that the first clip of a process's part is given as another's; None: there is none before it.

    Args:
        own: The part.
        windows: Of all clips.
        read: Reads some; those that are broken are left out.
    """
    if len(own) in (0, len(windows)):
        return None
    before = (batch.actions for window in reversed(windows[: own.start]) for batch in read([window]))
    if (nearest := next(before, None)) is not None:
        return nearest
    first = (batch.actions for window in windows for batch in read([window]))  # the second, as of one process
    return next(islice(first, 1, None), None)


def with_other_actions(
    batches: Iterable[LatentBatch], before: Float[Tensor, "1 time action_dim"] | None = None
) -> Iterator[tuple[LatentBatch, Float[Tensor, "batch time action_dim"]]]:
    """Yield each batch with other actions for its clips: those of the clip before, whatever the batch size.

    The first clip gets `before`, where another process has the clips before it; else those of the second; if it is
    alone, its own reversed.
    """
    rest = iter(batches)
    head = list(islice(rest, 1))
    if before is None and head:
        head += islice(rest, 1 if len(head[0].actions) == 1 else 0)
        known = torch.cat([batch.actions for batch in head])
        before = known[1:2] if len(known) > 1 else known.flip(1)
    for batch in chain(head, rest):
        assert before is not None  # noqa: S101  # there is a first batch
        yield batch, torch.cat([before.to(batch.actions), batch.actions[:-1]])
        before = batch.actions[-1:]


def prediction(
    model: Predictor, batch: LatentBatch, way: Way = "true", mode: Mode = "rollout", others: Tensor | None = None
) -> Float[Tensor, "batch horizon tokens dim"]:
    """Return the frames after the first as predicted.

    States are the true ones, whatever the actions, and may reveal the motion: what wrong actions cost is a lower bound.
    """
    seen = batch.latents[:, :1] if mode == "rollout" else batch.latents[:, :-1]
    if way == "persistence":
        return seen.expand_as(batch.latents[:, 1:])
    actions = {"true": batch.actions, "zero": torch.zeros_like(batch.actions)}
    actions |= {} if others is None else {"shuffled": others}
    extrinsics = None if batch.extrinsics is None else batch.extrinsics[:, :-1]
    predict = model.rollout if mode == "rollout" else model.predict
    return predict(seen, actions[way], batch.states[:, :-1], extrinsics)
