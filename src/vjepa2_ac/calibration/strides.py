"""Stride calibration: the stride with the lowest prediction error relative to persistence.

The step length of the released weights is unknown (see IMPLEMENTATION_NOTES), and robots differ in their control rate.
At each candidate stride, the same clips begin at the same control steps of the same held-out episodes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from accelerate import Accelerator

from vjepa2_ac.calibration.variants import Variant, VariantResult, load_named, measure_variants
from vjepa2_ac.config import Config
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.loader import validation_windows
from vjepa2_ac.distributed.processes import make_accelerator
from vjepa2_ac.encoding.batch import encode_batch
from vjepa2_ac.episode import Batch, LatentBatch, Progress, no_progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.measure import ClipSample, Predictor
from vjepa2_ac.evaluation.result import Row
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.reporter import INDEXING, SILENT, Reporter

_EPISODES_NEEDED = 2  # for an interval
_EPISODES_TO_BE_SURE = 10  # an interval from fewer is too narrow


@dataclass(frozen=True)
class Calibration:
    """The results at each stride, and the best one."""

    results: Mapping[int, VariantResult]  # that of the best one is compared with the runner-up
    impossible: Mapping[int, str]  # stride -> why it could not be measured
    frames: int
    split: Split
    rate_hz: float  # control steps per second

    @property
    def stride(self) -> int:
        """The stride with the lowest ratio of error and persistence."""
        return _by_ratio(self.results)[0]

    @property
    def best(self) -> VariantResult:
        """Its result."""
        return self.results[self.stride]

    @property
    def is_certain(self) -> bool:
        """Whether the best stride is certainly better than the next, which were both chosen on these clips."""
        return self.best.is_certainly_better(needed=_EPISODES_TO_BE_SURE)

    def verdict(self) -> str:
        """Return as text the best stride, and how certain it is."""
        best, difference = self.best, self.best.difference
        seconds = self.stride / self.rate_hz
        words = f"Best: stride {self.stride} ({seconds:.2f} s per model step), error/persistence {best.ratio}"
        if difference is None:
            words += "; there is no other to compare with"
        else:
            words += f"; {-difference.value:.3f} below stride {_by_ratio(self.results)[1]}"
            if difference.has_interval:
                words += f" (95 % interval {-difference.high:.3f} to {-difference.low:.3f})"
            words += "" if self.is_certain else f": not certain on {best.episodes} episodes, try more"
        if best.ratio.value >= 1:
            return f"{words}. At no stride is the model better than doing nothing: does it fit this data at all?"
        return f"{words}."

    def lines(self) -> list[str]:
        """Return the results as lines of text, the verdict last."""
        results = [
            f"  {one.name}: error/persistence {one.ratio}, {one.clips} clips of {one.episodes} episodes"
            for one in self.results.values()
        ]
        return [*results, *(f"  stride {n}: not possible: {why}" for n, why in self.impossible.items()), self.verdict()]

    def rows(self, model: str) -> list[Row]:
        """Return the error at each stride as rows of an evaluation."""
        group = "One-step L1 error / persistence by stride"
        rows = [
            Row(group, f"stride {stride}", f"strides.{stride}", model, math.nan, note=why, detail=True)
            for stride, why in self.impossible.items()
        ]
        for stride, one in self.results.items():
            numbers = one.ratio.value, one.ratio.low, one.ratio.high
            rows.append(Row(group, one.name, f"strides.{stride}", model, *numbers, chance=1.0, detail=True))
        return rows

    def as_dict(self) -> dict[str, Any]:
        """Return all metrics as plain values, for `calibration.json`."""
        names, difference = ("error", "persistence", "moved_cm", "clips", "episodes"), self.best.difference
        return {
            "stride": self.stride,
            "certain": self.is_certain,
            "verdict": self.verdict(),
            "split": self.split,
            "frames": self.frames,
            "strides": [
                {
                    "stride": stride,
                    "seconds_per_step": stride / self.rate_hz,
                    **{name: getattr(one, name) for name in names},
                    "error_over_persistence": one.ratio.as_dict(),
                }
                for stride, one in self.results.items()
            ],
            "impossible": {str(stride): why for stride, why in self.impossible.items()},
            "runner_up": _by_ratio(self.results)[1] if len(self.results) > 1 else None,
            "difference": None if difference is None else difference.as_dict(),
        }


def _by_ratio(results: Mapping[int, VariantResult]) -> list[int]:
    """Return the strides, the best first."""
    return sorted(results, key=lambda stride: results[stride].ratio.value)


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
    widest_first = possible[::-1]
    variants = [Variant(str(stride), partial(_at_stride, views[stride])) for stride in widest_first]
    found = measure_variants(model, encode, dataset, windows, variants, batch_size=sample.batch_size, progress=progress)
    measured, space = dict(zip(widest_first, found, strict=True)), dataset.spaces.action
    results = {
        stride: measured[stride].result(f"stride {stride} ({stride / rate:.2f} s)", space) for stride in possible
    }
    if len(results) > 1:
        best, second, *_ = _by_ratio(results)
        results[best] = measured[best].result(results[best].name, space, beside=measured[second])
    return Calibration(results, impossible, frames, split, rate)


def _at_stride(view: Dataset, dataset: Dataset) -> Dataset:
    return replace(view, source=dataset.source)


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
