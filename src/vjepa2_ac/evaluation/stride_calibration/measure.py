"""Stride calibration: the stride with the lowest prediction error relative to persistence.

The step length of the released weights is unknown (see IMPLEMENTATION_NOTES), and robots differ in their control rate.
At each candidate stride, the same clips begin at the same control steps of the same held-out episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from accelerate import Accelerator
from jaxtyping import Float

from vjepa2_ac.config import Config, ModelConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.loader import batches_of, validation_windows
from vjepa2_ac.encoding.batch import encode_batch
from vjepa2_ac.episode import Batch, LatentBatch, Progress, no_progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.measure import ClipSample, Predictor, one_step_errors
from vjepa2_ac.intervals import Estimate, ratio, ratio_difference
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.spaces import ActionSpace

_EPISODES_NEEDED = 2  # for an interval
_EPISODES_TO_BE_SURE = 10  # an interval from fewer is too narrow


@dataclass(frozen=True)
class StrideResult:
    """The one-step, teacher-forced error of a model at one stride."""

    stride: int
    seconds_per_step: float
    ratio: Estimate  # of the error to that of copying the frame before
    error: float  # mean over clips
    persistence: float
    moved_cm: float | None  # median distance of the flange per model step; None: the states are no poses
    clips: int
    episodes: int


@dataclass(frozen=True)
class Calibration:
    """The results at each stride, and the best one."""

    results: tuple[StrideResult, ...]
    impossible: dict[int, str]  # stride -> why it could not be measured
    frames: int
    split: Split
    runner_up: int | None  # the second-best stride
    difference: Estimate | None  # of the two best ratios, the best's minus the other's, paired by clip

    @property
    def best(self) -> StrideResult:
        """The stride with the lowest ratio."""
        return min(self.results, key=lambda one: one.ratio.value)

    @property
    def is_certain(self) -> bool:
        """Whether the best stride is better than the next with its whole 95 % interval, over enough episodes."""
        return (
            self.difference is not None
            and self.difference.has_interval
            and self.difference.high < 0
            and self.best.episodes >= _EPISODES_TO_BE_SURE
        )

    def verdict(self) -> str:
        """Return as text the best stride, and how certain it is."""
        best = self.best
        words = (
            f"Best: stride {best.stride} ({best.seconds_per_step:.2f} s per model step), error/persistence {best.ratio}"
        )
        if self.difference is None:
            words += "; there is no other to compare with"
        else:
            words += f"; {-self.difference.value:.3f} below stride {self.runner_up}"
            words += _interval(self.difference)
            words += "" if self.is_certain else f": not certain on {self.best.episodes} episodes, try more"
        if best.ratio.value >= 1:
            words += ". At no stride is the model better than doing nothing: does it fit this data at all?"
        return words if words.endswith("?") else words + "."

    def lines(self) -> list[str]:
        """Return the results as lines of text, the verdict last."""
        results = [
            f"  stride {one.stride} ({one.seconds_per_step:.2f} s): error/persistence {one.ratio},"
            f" {one.clips} clips of {one.episodes} episodes"
            for one in self.results
        ]
        return [*results, *(f"  stride {n}: not possible: {why}" for n, why in self.impossible.items()), self.verdict()]

    def as_dict(self) -> dict[str, Any]:
        """Return all metrics as plain values, for `calibration.json`."""
        strides = [
            {**{name: getattr(one, name) for name in _METRICS}, "error_over_persistence": one.ratio.as_dict()}
            for one in self.results
        ]
        return {
            "stride": self.best.stride,
            "certain": self.is_certain,
            "verdict": self.verdict(),
            "split": self.split,
            "frames": self.frames,
            "strides": strides,
            "impossible": {str(stride): why for stride, why in self.impossible.items()},
            "runner_up": self.runner_up,
            "difference": None if self.difference is None else self.difference.as_dict(),
        }


_METRICS = ("stride", "seconds_per_step", "error", "persistence", "moved_cm", "clips", "episodes")


def _interval(difference: Estimate) -> str:
    return f" (95 % interval {-difference.high:.3f} to {-difference.low:.3f})" if difference.has_interval else ""


def calibrate(
    model: Predictor,
    encode: Callable[[Batch], LatentBatch],
    dataset: Dataset,
    sample: ClipSample,
    *,
    progress: Progress = no_progress,
) -> Calibration:
    """Measure a model's one-step error over persistence at each stride.

    A stride is possible if clips of it fit into at least two episodes (one, if no stride fits into two). All possible
    ones are measured on the starts from which a clip of the widest fits.

    Args:
        model: The predictor.
        encode: Turns a batch of pixels into latents on the model's device.
        dataset: The source of clips; its config has the candidates, its own stride does not matter.
        sample: The clips at each stride.
        progress: Called with (clips done, clips in total).

    Raises:
        InputError: The split is empty, no stride fits into any of its episodes, or a clip cannot be read.
    """
    frames, split = sample.frames_of(dataset.config), sample.split
    strides = sorted(set(dataset.config.strides_to_try(dataset.control_rate_hz)))
    settings = dataset.config.model_copy(update={"frames": frames, "short_episodes": "skip"})
    views = {stride: replace(dataset, config=settings.with_stride(stride)) for stride in strides}
    possible, impossible = _possible(views, split)
    chosen = validation_windows(views[possible[-1]], split, clips=sample.clips)
    measured = {}
    for done, stride in enumerate(possible):
        batches = batches_of(views[stride], chosen, batch_size=sample.batch_size)
        parts = _measure(model, encode, batches, dataset.spaces.action)
        before, total = done * len(chosen), len(possible) * len(chosen)
        measured[stride] = _Measured.joined(list(_reported(parts, progress, before, total)))
    runner_up, difference = _compared(measured)
    rate = dataset.control_rate_hz
    results = tuple(one.summary(stride, stride / rate) for stride, one in measured.items())
    return Calibration(results, impossible, frames, split, runner_up, difference)


@dataclass(frozen=True)
class _Measured:
    """Metrics by clip; a clip is named by its episode and first step."""

    errors: Float[np.ndarray, " clips"]
    persistence: Float[np.ndarray, " clips"]
    moved_cm: Float[np.ndarray, " steps"]  # none if the states are no poses
    clips: tuple[tuple[str, int], ...]

    @classmethod
    def joined(cls, parts: Sequence[_Measured]) -> _Measured:
        return cls(
            errors=np.concatenate([part.errors for part in parts]),
            persistence=np.concatenate([part.persistence for part in parts]),
            moved_cm=np.concatenate([part.moved_cm for part in parts]),
            clips=tuple(clip for part in parts for clip in part.clips),
        )

    @property
    def episode_ids(self) -> tuple[str, ...]:
        return tuple(episode for episode, _ in self.clips)

    @property
    def value(self) -> float:
        return float(self.errors.sum() / self.persistence.sum())

    def summary(self, stride: int, seconds_per_step: float) -> StrideResult:
        return StrideResult(
            stride=stride,
            seconds_per_step=seconds_per_step,
            ratio=ratio(self.errors, self.persistence, self.episode_ids),
            error=float(self.errors.mean()),
            persistence=float(self.persistence.mean()),
            moved_cm=float(np.median(self.moved_cm)) if len(self.moved_cm) else None,
            clips=len(self.clips),
            episodes=len(set(self.episode_ids)),
        )


def _measure(
    model: Predictor, encode: Callable[[Batch], LatentBatch], batches: Iterator[Batch], space: ActionSpace
) -> Iterator[_Measured]:
    for batch in batches:
        errors, persistence = one_step_errors(model, encode(batch))
        moved_cm = np.zeros(0)
        if space.position is not None:
            moved_cm = space.shown_size(batch.actions.flatten(0, 1).numpy().astype(np.float64))
        yield _Measured(errors, persistence, moved_cm, tuple(zip(batch.episode_ids, batch.starts, strict=True)))


def _reported(parts: Iterator[_Measured], progress: Progress, done: int, total: int) -> Iterator[_Measured]:
    for part in parts:
        done += len(part.clips)
        progress(done, total)
        yield part


def _possible(views: dict[int, Dataset], split: Split) -> tuple[list[int], dict[int, str]]:
    """Return the strides whose clips fit into enough episodes, and for the others the reason why not."""
    fitting, reasons = {}, {}
    for stride, dataset in views.items():
        try:
            fitting[stride] = len(np.unique(dataset.windows(split).episodes))
        except InputError as error:
            reasons[stride] = f"{error.found}; needed: {error.needed}" if error.needed else error.found
            if len(reasons) == len(views):
                raise
    needed = min(_EPISODES_NEEDED, max(fitting.values()))
    for stride, episodes in fitting.items():
        if episodes < needed:
            reasons[stride] = f"a clip of {views[stride].config.clip_steps} control steps fits into 1 episode only"
    return [stride for stride in fitting if stride not in reasons], dict(sorted(reasons.items()))


def _compared(measured: dict[int, _Measured]) -> tuple[int | None, Estimate | None]:
    """Return the second-best stride, and how far the best ratio is below its ratio."""
    if len(measured) < 2:
        return None, None
    first, second = sorted(measured, key=lambda stride: measured[stride].value)[:2]
    best, other = measured[first], measured[second]
    places = {clip: place for place, clip in enumerate(other.clips)}
    pairs = [(place, places[clip]) for place, clip in enumerate(best.clips) if clip in places]
    mine, theirs = (np.array(side, dtype=np.int64) for side in zip(*pairs, strict=True))
    difference = ratio_difference(
        (best.errors[mine], best.persistence[mine]),
        (other.errors[theirs], other.persistence[theirs]),
        tuple(best.episode_ids[place] for place in mine),
    )
    return second, difference


def require_learned(model: ModelConfig) -> None:
    """Refuse a randomly initialized model.

    Raises:
        InputError: It is.
    """
    if model.base is None:
        raise InputError(
            where="model.random",
            found="a model that has learned nothing",
            needed="one that can say which stride it was trained at",
            fix="Set data.stride to a number, or name another model with model.base (data calibrate: --model)",
        )


def calibrate_model(
    world_model: WorldModel,
    dataset: Dataset,
    config: Config,
    accelerator: Accelerator,
    sample: ClipSample,
    progress: Progress = no_progress,
) -> Calibration:
    """Calibrate a model that is on the accelerator's device, in the run's precision.

    Raises:
        InputError: As `calibrate`; or the data is a latent cache.
    """
    if dataset.config.is_cache:
        raise InputError(
            where=f"data.path: {dataset.config.path}",
            found=f"latents that were encoded for clips at stride {dataset.config.stride}",
            needed="frames at every candidate stride",
            fix="Calibrate on the data set itself, with data.cache: off",
        )
    world_model.eval()
    sample = replace(sample, batch_size=config.validation.batch_size)
    encode = partial(encode_batch, world_model, device=accelerator.device, chunk=config.model.encode_chunk)
    with accelerator.autocast(), torch.no_grad():
        return calibrate(world_model, encode, dataset, sample, progress=progress)
