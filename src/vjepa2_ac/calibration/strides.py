"""Stride calibration: the stride with the lowest prediction error relative to persistence.

The step length of the released weights is unknown (see IMPLEMENTATION_NOTES), and robots differ in their control rate.
At each candidate stride, the same clips begin at the same control steps of the same held-out episodes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from accelerate import Accelerator

from vjepa2_ac.calibration.variants import (
    SameClips,
    Variant,
    VariantErrors,
    is_certainly_better,
    load_named,
    measure_variants,
    ratios_by_name,
)
from vjepa2_ac.config import Config
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.loader import validation_windows
from vjepa2_ac.distributed import make_accelerator
from vjepa2_ac.encoding.batch import encode_batch
from vjepa2_ac.episode import Batch, LatentBatch, Progress, no_progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.measure import ClipSample, Predictor
from vjepa2_ac.evaluation.result import Row
from vjepa2_ac.intervals import Estimate
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.reporter import INDEXING, SILENT, Reporter
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
        """Whether the best stride is certainly better than the next, which were both chosen on these clips."""
        difference, needed = self.difference, _EPISODES_TO_BE_SURE
        return difference is not None and is_certainly_better(difference, self.best.episodes, needed=needed)

    def verdict(self) -> str:
        """Return as text the best stride, and how certain it is."""
        best, difference = self.best, self.difference
        words = (
            f"Best: stride {best.stride} ({best.seconds_per_step:.2f} s per model step), error/persistence {best.ratio}"
        )
        if difference is None:
            words += "; there is no other to compare with"
        else:
            words += f"; {-difference.value:.3f} below stride {self.runner_up}"
            if difference.has_interval:
                words += f" (95 % interval {-difference.high:.3f} to {-difference.low:.3f})"
            words += "" if self.is_certain else f": not certain on {best.episodes} episodes, try more"
        if best.ratio.value >= 1:
            return f"{words}. At no stride is the model better than doing nothing: does it fit this data at all?"
        return f"{words}."

    def lines(self) -> list[str]:
        """Return the results as lines of text, the verdict last."""
        results = [
            f"  stride {one.stride} ({one.seconds_per_step:.2f} s): error/persistence {one.ratio},"
            f" {one.clips} clips of {one.episodes} episodes"
            for one in self.results
        ]
        return [*results, *(f"  stride {n}: not possible: {why}" for n, why in self.impossible.items()), self.verdict()]

    def rows(self, model: str) -> list[Row]:
        """Return the error at each stride as rows of an evaluation."""
        group = "One-step L1 error / persistence by stride"
        impossible = [
            Row(group, f"stride {stride}", f"strides.{stride}", model, math.nan, note=why, detail=True)
            for stride, why in self.impossible.items()
        ]
        return impossible + [
            Row(
                group, f"stride {one.stride} ({one.seconds_per_step:.2f} s)", f"strides.{one.stride}", model,
                one.ratio.value, one.ratio.low, one.ratio.high, chance=1.0, detail=True,
            )
            for one in self.results
        ]  # fmt: skip

    def as_dict(self) -> dict[str, Any]:
        """Return all metrics as plain values, for `calibration.json`."""
        names = ("stride", "seconds_per_step", "error", "persistence", "moved_cm", "clips", "episodes")
        strides = [
            {**{name: getattr(one, name) for name in names}, "error_over_persistence": one.ratio.as_dict()}
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


def calibrate_config(
    config: Config, sample: ClipSample, *, model: str | None = None, reporter: Reporter = SILENT
) -> Calibration:
    """Calibrate the model of a config, or another one, on the config's data.

    A latent cache has the frames of one stride's clips only, so frames are encoded on the fly.

    Args:
        config: The data, the model, the device and the precision.
        sample: The clips at each stride.
        model: Another model: what `model.base` takes, or the folder of a run.
        reporter: Shows the progress of indexing and measuring.

    Raises:
        InputError: The data or the model cannot be used.
    """
    accelerator = make_accelerator(config)
    dataset = open_dataset(config.data, progress=reporter.task(INDEXING))
    world_model = load_named(config, dataset, model).to(accelerator.device)
    return calibrate_model(world_model, dataset, config, accelerator, sample, reporter.task("measuring clips"))


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
    frames, split, rate = sample.frames_of(dataset.config), sample.split, dataset.control_rate_hz
    settings = dataset.config.model_copy(update={"frames": frames, "short_episodes": "skip"})
    strides = sorted(set(dataset.config.strides_to_try(rate)))
    views = {stride: replace(dataset, config=settings.with_stride(stride)) for stride in strides}
    possible, impossible = _possible(views, split)
    windows = validation_windows(views[possible[-1]], split, clips=sample.clips)
    variants = [Variant(str(stride), partial(_at_stride, views[stride])) for stride in reversed(possible)]
    clips = SameClips(dataset, windows, sample.batch_size)
    measured = measure_variants(model, encode, clips, variants, progress)
    ratios = ratios_by_name(measured)
    best, *others = sorted(possible, key=lambda stride: ratios[str(stride)])
    space = dataset.spaces.action
    return Calibration(
        tuple(_result(measured[str(stride)], stride, stride / rate, space) for stride in possible),
        impossible,
        frames,
        split,
        others[0] if others else None,
        measured[str(best)].minus(measured[str(others[0])]) if others else None,
    )


def _at_stride(view: Dataset, dataset: Dataset) -> Dataset:
    return replace(view, source=dataset.source)


def _result(measured: VariantErrors, stride: int, seconds_per_step: float, space: ActionSpace) -> StrideResult:
    moved_cm = None
    if space.position is not None:
        moved_cm = float(np.median(space.shown_size(measured.actions.reshape(-1, measured.actions.shape[-1]))))
    return StrideResult(
        stride=stride,
        seconds_per_step=seconds_per_step,
        ratio=measured.ratio,
        error=float(measured.errors.mean()),
        persistence=float(measured.persistence.mean()),
        moved_cm=moved_cm,
        clips=len(measured.clips),
        episodes=len(set(measured.episode_ids)),
    )


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
