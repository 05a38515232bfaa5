"""Compare variants of a data set, such as other strides, by the prediction error of a model on the same clips.

A model's one-step error relative to persistence is lowest if frames, states and actions are as in its training. The
stride is calibrated by this error, because the step length of the released weights is unknown (see
IMPLEMENTATION_NOTES), and robots differ in their control rate. At each candidate stride, clips start at the same
control steps of the same held-out episodes. `inspection.probe` defines other variants.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from accelerate import Accelerator
from jaxtyping import Float

from vjepa2_ac.config import Config
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import Dataset, open_dataset
from vjepa2_ac.data.loader import read_batches, validation_windows
from vjepa2_ac.data.windows import candidate_strides
from vjepa2_ac.distributed import broadcast_object, make_accelerator
from vjepa2_ac.encoding.batch import encode_batch, require_same_encoder, require_widths
from vjepa2_ac.episode import Batch, Episode, EpisodeInfo, EpisodeSource, LatentBatch, Progress, StepRanges, no_progress
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.evaluation.measure import ONE_STEP_PREDICTIONS, ClipSample, Predictor, measure_errors
from vjepa2_ac.evaluation.result import L1
from vjepa2_ac.intervals import Estimate, estimate_ratio, estimate_ratio_difference
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.reporter import INDEXING, LOADING, SILENT, Reporter
from vjepa2_ac.runs.folder import is_run
from vjepa2_ac.runs.subject import load_subject
from vjepa2_ac.storage.structured import to_plain

Encode = Callable[[Batch], LatentBatch]  # encodes pixels into latents, on the model's device

_MARGIN = 2.0  # a difference must be below 0 by this many half-widths of its interval: the best of several is selected
_MIN_EPISODES_FOR_INTERVAL = 2
_MIN_EPISODES_TO_BE_CERTAIN = 10  # intervals from fewer episodes are too narrow


@dataclass(frozen=True)
class Variant:
    """A changed data set with the same clips."""

    name: str
    view: Callable[[Dataset], Dataset]  # returns the changed data set
    changes_frames: bool = True  # False: the frames equal those of the first variant, so its latents are used
    repair: str = ""  # how to correct the data if the model predicts this variant better


@dataclass(frozen=True)
class VariantResult:
    """The one-step, teacher-forced error of a model under a variant."""

    name: str
    ratio: Estimate  # error relative to persistence
    error: float  # mean over clips
    persistence: float  # error of persistence, mean over clips
    clips: int
    episodes: int
    difference: Estimate | None = None  # ratio minus the ratio of another variant on the same clips; below 0: better
    repair: str = ""

    def is_certainly_better(self, *, min_episodes: int) -> bool:
        """Return whether the difference is below 0 by more than twice the half-width of its interval.

        The margin is larger than usual, because the variant was selected on the same clips.

        Args:
            min_episodes: Minimum number of episodes, because intervals from few episodes are too narrow.
        """
        if self.difference is None or not self.difference.has_interval or self.episodes < min_episodes:
            return False
        return self.difference.value + _MARGIN * (self.difference.high - self.difference.value) < 0


# Clip (episode, first control step) -> one-step, teacher-forced L1 errors of the model and of persistence.
VariantErrors = dict[tuple[str, int], Float[np.ndarray, " 2"]]


def compute_result(
    errors: VariantErrors, name: str, *, reference: VariantErrors | None = None, repair: str = ""
) -> VariantResult:
    """Compute the result of a variant from its errors; `difference` is relative to `reference`, on common clips."""
    ids, difference = [episode for episode, _ in errors], None
    if reference is not None:
        common = [clip for clip in errors if clip in reference]
        variant, other = (np.array([each[clip] for clip in common]).T.copy() for each in (errors, reference))
        difference = estimate_ratio_difference(
            (variant[0], variant[1]), (other[0], other[1]), [name for name, _ in common]
        )
    model, persistence = np.array(list(errors.values())).T.copy()
    means, counts = (float(model.mean()), float(persistence.mean())), (len(ids), len(set(ids)))
    return VariantResult(name, estimate_ratio(model, persistence, ids), *means, *counts, difference, repair)


@dataclass(frozen=True)
class SameClips:
    """The clips on which variants are compared."""

    dataset: Dataset
    windows: Sequence[tuple[int, int]]  # episode and first control step of each clip
    batch_size: int  # clips per batch


def measure_variants(
    model: Predictor, encode: Encode, clips: SameClips, variants: Sequence[Variant], progress: Progress = no_progress
) -> list[VariantErrors]:
    """Measure a model's one-step error on the same clips of each variant. Each episode is read only once.

    Args:
        model: The predictor.
        encode: Encodes the frames.
        clips: The clips.
        variants: The variants. The first one determines which clips can be read.
        progress: Called with the number of measured clips and the total number, over all variants.

    Raises:
        InputError: A clip cannot be read, or no clip remains because `data.broken_episodes` skips all episodes.
    """
    first, num_measured, dataset, windows = variants[0], 0, clips.dataset, clips.windows
    errors_by_variant: list[VariantErrors] = [{} for _ in variants]
    for batch in read_batches(first.view(dataset), windows, batch_size=clips.batch_size):
        latents, with_memory = encode(batch), replace(dataset, source=ReadOnce(dataset.source))
        indices = [dataset.table.find(name) for name in batch.episode_ids]
        starts = [(index, start) for index, start in zip(indices, batch.starts, strict=True) if index is not None]
        for variant, errors in zip(variants, errors_by_variant, strict=True):
            batches = [latents] if variant is first else _read_variant(variant, with_memory, starts, encode, latents)
            for latent_batch in batches:
                errors |= _measure_errors(model, latent_batch)
            num_measured += len(batch.starts)
            progress(num_measured, len(windows) * len(variants))
    return errors_by_variant


def _read_variant(
    variant: Variant, dataset: Dataset, windows: Sequence[tuple[int, int]], encode: Encode, latents: LatentBatch
) -> Iterable[LatentBatch]:
    """Yield the batch of a variant's clips. Frames are encoded only if the variant changes them."""
    for batch in read_batches(variant.view(dataset), windows, batch_size=len(windows)):
        if variant.changes_frames:
            yield encode(batch)
        else:
            device = latents.states.device
            yield replace(latents, states=batch.states.to(device), actions=batch.actions.to(device))


def _measure_errors(model: Predictor, latents: LatentBatch) -> VariantErrors:
    result = measure_errors(model, latents, ONE_STEP_PREDICTIONS, (L1,))
    errors = np.stack([result.of("teacher_forced", L1, kind).mean(axis=1) for kind, _ in ONE_STEP_PREDICTIONS], axis=1)
    return dict(zip(zip(latents.episode_ids, latents.starts, strict=True), errors, strict=True))


@dataclass(frozen=True)
class ReadOnce:
    """A source that reads each episode once, changes it, and keeps it in memory, because reading may be slow.

    Args:
        source: The source.
        change: Changes an episode after reading.
        episodes: The episodes that were read.
    """

    source: EpisodeSource
    change: Callable[[Episode], Episode] = lambda episode: episode
    episodes: dict[tuple[int, str | None], Episode] = field(default_factory=dict)

    def infos(self, progress: Progress | None = None) -> Sequence[EpisodeInfo]:
        """Return the infos of the source."""
        return self.source.infos(progress)

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:
        """Return a changed episode, which is read at the first call only."""
        if (index, camera) not in self.episodes:
            self.episodes[index, camera] = self.change(self.source.read(index, camera, needed))
        return self.episodes[index, camera]


def load_named(config: Config, dataset: Dataset, model: str | None) -> WorldModel:
    """Load a model and check that it fits the data.

    Args:
        config: The config with the data.
        dataset: The data set.
        model: Folder of a run, or a model in a form that `model.base` accepts; None: the model of the config.

    Raises:
        InputError: There is no such model, it cannot be read, it is random, or it does not fit the data.
    """
    if model is None and config.model.is_random:
        needed = "a trained model, because the stride is selected by its error"
        fix = "Set data.stride to a number, or set model.base to a trained model (for data calibrate: --model MODEL)"
        raise InputError(where="model.base: random", found="a random model", needed=needed, fix=fix)
    if model is None:
        loaded = load_base(config.model, seed=config.seed)
    else:
        loaded = load_subject(model, config=None if is_run(model) else config).world_model
    require_widths(loaded, dataset.widths, where=model or f"model.base: {config.model.base}")
    require_same_encoder(loaded, dataset, config)
    return loaded


@dataclass(frozen=True)
class Calibration:
    """The results at each stride, and the best stride."""

    results: Mapping[int, VariantResult]  # by stride; the best stride is compared with the second best
    impossible: Mapping[int, str]  # stride -> why it cannot be measured
    frames: int  # number of frames of a clip
    split: Split
    rate_hz: float  # control steps per second

    @property
    def stride(self) -> int:
        """The stride with the lowest error relative to persistence."""
        return _sort_by_ratio(self.results)[0]

    @property
    def best(self) -> VariantResult:
        """The result at the best stride."""
        return self.results[self.stride]

    @property
    def is_certain(self) -> bool:
        """Whether the best stride is certainly better than the second best."""
        return self.best.is_certainly_better(min_episodes=_MIN_EPISODES_TO_BE_CERTAIN)

    def verdict(self) -> str:
        """Return a text that names the best stride and states whether it is certain."""
        best, difference = self.best, self.best.difference
        seconds = self.stride / self.rate_hz
        text = (
            f"Best stride: {self.stride} ({seconds:.2f} s per model step), error relative to persistence {best.ratio}"
        )
        if difference is None:
            text += "; no other stride was measured"
        else:
            text += f"; {-difference.value:.3f} lower than at stride {_sort_by_ratio(self.results)[1]}"
            if difference.has_interval:
                text += f" (95 % interval {-difference.high:.3f} to {-difference.low:.3f})"
            if not self.is_certain:
                text += f", uncertain with {counted(best.episodes, 'episode')}; measure more episodes"
        if best.ratio.value >= 1:
            return f"{text}. The model is not better than persistence at any stride. Check that it fits these data."
        return f"{text}."

    def as_dict(self) -> dict[str, Any]:
        """Return all metrics as plain values, for `calibration.json`."""
        return {
            "stride": self.stride,
            "certain": self.is_certain,
            "verdict": self.verdict(),
            "split": self.split,
            "frames": self.frames,
            "strides": [to_plain(asdict(result)) | {"stride": stride} for stride, result in self.results.items()],
            "impossible": {str(stride): why for stride, why in self.impossible.items()},
        }


def _sort_by_ratio(results: Mapping[int, VariantResult]) -> list[int]:
    """Return the strides, sorted by their error relative to persistence, the lowest first."""
    return sorted(results, key=lambda stride: results[stride].ratio.value)


def calibrate_config(
    config: Config, sample: ClipSample, *, model: str | None = None, reporter: Reporter = SILENT
) -> Calibration:
    """Calibrate the stride for the model of a config, or another model, on the data of the config.

    Frames are encoded here, because a latent cache contains only the clips at one stride.

    Args:
        config: The config for data, model, device and precision.
        sample: The clips at each stride.
        model: Another model in a form that `model.base` accepts, or the folder of a run; None: the config's model.
        reporter: Shows the progress of indexing and measuring.

    Raises:
        InputError: The data or the model cannot be used.
    """
    accelerator = make_accelerator(config)
    dataset = open_dataset(config.data, progress=reporter.task(INDEXING))
    reporter.task(LOADING)
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
    """Calibrate the stride for a loaded model, on the accelerator's device and in its precision.

    Raises:
        InputError: As for `calibrate`, or the data are a latent cache.
    """
    if dataset.config.is_cache:
        cached = f"latents that were encoded for clips at stride {dataset.config.stride}"
        needed, fix = "frames at every candidate stride", "Calibrate on the data set itself, with data.cache: off"
        raise InputError(where=f"data.path: {dataset.config.path}", found=cached, needed=needed, fix=fix)
    sample = replace(sample, batch_size=config.validation.batch_size)
    encode = partial(encode_batch, world_model, device=accelerator.device)
    with accelerator.autocast(), torch.no_grad():
        return calibrate(world_model, encode, dataset, sample, progress=progress)


def calibrate(
    model: Predictor, encode: Encode, dataset: Dataset, sample: ClipSample, *, progress: Progress = no_progress
) -> Calibration:
    """Measure a model's one-step error relative to persistence at each stride.

    A stride is possible if its clips fit into at least two episodes, or into one if no stride fits into two. All
    possible strides are measured at the same starts: those from which a clip at the largest possible stride fits.

    Args:
        model: The predictor.
        encode: Encodes the frames.
        dataset: The data set; its own stride is ignored.
        sample: The clips at each stride.
        progress: Called with the number of measured clips and the total number.

    Raises:
        InputError: The split is empty, no stride fits into any of its episodes, or a clip cannot be read.
    """
    frames, split, rate = sample.num_frames(dataset.config), sample.split, dataset.control_rate_hz
    settings = dataset.config.model_copy(update={"frames": frames})
    strides = sample.strides or candidate_strides(rate)
    views = {stride: replace(dataset, config=settings.with_stride(stride)) for stride in strides}
    possible, impossible = _find_possible_strides(views, split)
    windows = validation_windows(views[possible[-1]], split, clips=sample.clips)
    largest_first = possible[::-1]  # the first variant determines which clips can be read
    variants = [Variant(str(stride), partial(_with_source, views[stride])) for stride in largest_first]
    clips = SameClips(dataset, windows, sample.batch_size)
    errors = dict(zip(largest_first, measure_variants(model, encode, clips, variants, progress), strict=True))
    names = {stride: f"stride {stride} ({stride / rate:.2f} s)" for stride in possible}
    results = {stride: compute_result(errors[stride], name) for stride, name in names.items()}
    if len(results) > 1:
        best, second, *_ = _sort_by_ratio(results)
        results[best] = compute_result(errors[best], names[best], reference=errors[second])
    return Calibration(results, impossible, frames, split, rate)


def _with_source(view: Dataset, dataset: Dataset) -> Dataset:
    """Return the view with the source of the data set, which keeps episodes in memory."""
    return replace(view, source=dataset.source)


def _find_possible_strides(views: dict[int, Dataset], split: Split) -> tuple[list[int], dict[int, str]]:
    """Return the strides whose clips fit into enough episodes, and the reasons against all other strides."""
    num_episodes, reasons = {}, {}
    for stride, dataset in views.items():
        try:
            num_episodes[stride] = len(np.unique(dataset.windows(split).episodes))
        except InputError as error:
            reasons[stride] = f"{error.found}. Expected {error.needed}" if error.needed else error.found
            if len(reasons) == len(views):
                raise
    needed = min(_MIN_EPISODES_FOR_INTERVAL, max(num_episodes.values()))
    for stride, episodes in num_episodes.items():
        if episodes < needed:
            steps = counted(views[stride].config.clip_steps, "control step")
            reasons[stride] = f"a clip of {steps} fits into only 1 episode"
    return [stride for stride in num_episodes if stride not in reasons], dict(sorted(reasons.items()))


def choose_stride(
    config: Config, dataset: Dataset, accelerator: Accelerator, reporter: Reporter
) -> tuple[WorldModel, Calibration]:
    """Load the base model of a run whose `data.stride` is auto, and calibrate the stride.

    Only candidate strides whose clips fit into the episodes are measured. All processes get the same result.

    Raises:
        InputError: The base model is random, no candidate fits, or as for `calibrate_model`.
    """
    world_model = load_named(config, dataset, None).to(accelerator.device)
    reporter.note("data.stride is auto: measuring the model at each candidate stride")
    possible, errors = [], []
    for stride in candidate_strides(dataset.control_rate_hz):
        view = dataset.with_stride(stride)
        try:
            view.windows("train"), view.windows("validation")
        except InputError as error:
            errors.append(error)
            reporter.note(f"  stride {stride}: not possible: no clip of {dataset.config.frames} frames fits")
        else:
            possible.append(stride)
    if not possible:
        raise errors[0]
    sample = ClipSample(clips=config.validation.clips, strides=tuple(possible))
    calibration = calibrate_model(world_model, dataset, config, accelerator, sample)
    for result in calibration.results.values():
        reporter.note(f"  {result.name}: error relative to persistence {result.ratio:.3f}")
    reporter.note(calibration.verdict())
    return world_model, broadcast_object(accelerator, calibration)
