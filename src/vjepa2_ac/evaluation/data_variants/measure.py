"""Comparison of data variants: under which does a trained model predict best: unchanged, mirrored, shifted, ...?

A model's one-step error is lowest where actions and states match the frames. So the same clips are measured unchanged
and with one thing changed at a time; a variant that is certainly better is most likely the true reading of the data.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.loader import batches_of, validation_windows
from vjepa2_ac.data.windows import spread
from vjepa2_ac.episode import Batch, LatentBatch, Progress, no_progress
from vjepa2_ac.evaluation.data_variants.variants import ChangedSource, RememberingSource, Variant, variants_of
from vjepa2_ac.evaluation.measure import ClipSample, OneStepErrors, Predictor, one_step_errors
from vjepa2_ac.intervals import Estimate, ratio, ratio_difference

SHIFTS = (1, 2, 4, 8)  # control steps
_CANDIDATES_PER_CLIP = 8  # windows checked per clip, since shifts need room on both sides
_EPISODES_TO_BE_SURE = 5
_MARGIN = 2.0  # half-widths of the 95 % interval: one of a dozen variants is easily better by chance
_GAIN = 0.01  # of persistence: smaller gains are irrelevant


@dataclass(frozen=True)
class VariantResult:
    """The prediction error of a model under a variant."""

    name: str
    repair: str
    ratio: Estimate  # one-step error over persistence
    difference: Estimate  # to the unchanged data, on the same clips; below 0: fits better


@dataclass(frozen=True)
class VariantProbe:
    """The results of all variants."""

    ratio: Estimate  # one-step error over persistence, of the unchanged data
    results: tuple[VariantResult, ...]
    clips: int
    episodes: int

    @property
    def better(self) -> VariantResult | None:
        """The variant that fits best, if it certainly fits better than the unchanged data."""
        certain = [one for one in self.results if self._is_certainly_better(one)]
        return min(certain, key=lambda one: one.difference.value) if certain else None

    def _is_certainly_better(self, one: VariantResult) -> bool:
        difference = one.difference
        if not difference.has_interval or self.episodes < _EPISODES_TO_BE_SURE:
            return False
        limit = difference.value + _MARGIN * (difference.high - difference.value)
        return difference.value < -_GAIN and limit < 0 and one.ratio.high < 1  # else it only fails less

    def verdict(self) -> str:
        """Return as text whether the unchanged data fit the model best."""
        text = f"error / persistence {self.ratio} on {self.clips} clips of {self.episodes} episodes"
        if (better := self.better) is not None:
            less = f"{-better.difference.value:.3f} [{-better.difference.high:.3f}, {-better.difference.low:.3f}]"
            return f"{text}, and {less} less with {better.name}: {better.repair}"
        if self.episodes < _EPISODES_TO_BE_SURE:
            return f"{text}: too few episodes to compare, {_EPISODES_TO_BE_SURE} are needed"
        if self.ratio.value >= 1:
            return f"{text}: the model predicts none of this better than persistence, so the result is unknown"
        return f"{text}; no variant certainly fits better"


def rows_of(probe: VariantProbe) -> Iterator[tuple[str, str, str]]:
    """Yield name, error over persistence, and difference, for a table; the unchanged data first."""
    yield "as they are", str(probe.ratio), ""
    for one in probe.results:
        yield one.name, str(one.ratio), str(one.difference)


def probe_variants(
    model: Predictor,
    encode: Callable[[Batch], LatentBatch],
    dataset: Dataset,
    sample: ClipSample,
    progress: Progress = no_progress,
) -> VariantProbe:
    """Measure a model's one-step error on unchanged clips, and under each variant.

    Args:
        model: The predictor.
        encode: Turns a batch of pixels into latents on the model's device.
        dataset: The source of clips, at a fixed stride.
        sample: The clips.
        progress: Called with (clips done, clips in total).

    Raises:
        InputError: The split is empty, or a clip cannot be read.
    """
    # Of whole clips, as a cache has them.
    candidates = validation_windows(dataset, sample.split, clips=sample.clips * _CANDIDATES_PER_CLIP)
    frames = sample.frames_of(dataset.config)
    dataset = replace(dataset, config=dataset.config.model_copy(update={"frames": frames}))
    windows, shifts = _with_room(dataset, candidates, sample.clips)
    variants = variants_of(dataset.config, shifts)
    measured: list[list[OneStepErrors]] = []
    ids: list[str] = []
    for batch in batches_of(dataset, windows, batch_size=sample.batch_size):
        latents = encode(batch)
        here = _of_batch(dataset, batch)
        changed = [_under(one, model, encode, *here, latents) for one in variants]
        measured.append([one_step_errors(model, latents), *changed])
        ids += batch.episode_ids
        progress(len(ids), len(windows))
    plain, *others = [
        OneStepErrors(*map(np.concatenate, zip(*of_one, strict=True))) for of_one in zip(*measured, strict=True)
    ]
    results = [
        VariantResult(variant.name, variant.repair, ratio(*one, ids), ratio_difference(one, plain, ids))
        for variant, one in zip(variants, others, strict=True)
    ]
    return VariantProbe(ratio(*plain, ids), tuple(results), len(ids), len(set(ids)))


def _of_batch(dataset: Dataset, batch: Batch) -> tuple[Dataset, list[tuple[int, int]]]:
    """Return a data set that reads each episode once for all variants, and the windows of a batch."""
    config = dataset.config.model_copy(update={"workers": 0})  # workers would not share episodes that were read
    places = [dataset.table.find(name) for name in batch.episode_ids]
    windows = [(place, start) for place, start in zip(places, batch.starts, strict=True) if place is not None]
    return replace(dataset, config=config, source=RememberingSource(dataset.source)), windows


def _under(
    variant: Variant,
    model: Predictor,
    encode: Callable[[Batch], LatentBatch],
    dataset: Dataset,
    windows: list[tuple[int, int]],
    plain: LatentBatch,
) -> OneStepErrors:
    """Return the errors of the same clips under a variant; frames are encoded again only if it changes them."""
    source = ChangedSource(dataset.source, variant)
    changed = next(iter(batches_of(replace(dataset, source=source), windows, batch_size=len(windows))))
    if variant.changes_frames:
        return one_step_errors(model, encode(changed))
    device = plain.states.device
    return one_step_errors(model, replace(plain, states=changed.states.to(device), actions=changed.actions.to(device)))


def _with_room(
    dataset: Dataset, candidates: list[tuple[int, int]], clips: int
) -> tuple[list[tuple[int, int]], tuple[int, ...]]:
    """Return the starts of clips, and the shifts for which each has states before and after it."""
    steps, length = dataset.table.num_steps, dataset.config.clip_steps
    enough = max(1, min(clips, len(candidates) // 4))
    fitting: list[tuple[int, int]] = candidates
    shifts: tuple[int, ...] = ()
    for count in range(1, len(SHIFTS) + 1):
        room = SHIFTS[count - 1]
        wider = [(episode, start) for episode, start in fitting if room <= start <= steps[episode] - length - room]
        if len(wider) < enough:
            break
        fitting, shifts = wider, SHIFTS[:count]
    return [fitting[place] for place in spread(len(fitting), clips)], shifts
