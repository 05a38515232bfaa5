"""Compare variants of reading the same clips of a data set, by the prediction error of a model.

A model's one-step error relative to persistence is lowest if frames, states and actions are as in its training. This is
used to calibrate the stride: the step length of the released weights is unknown (see IMPLEMENTATION_NOTES), and robots
differ in their control rate. At each candidate stride, clips start at the same control steps of the same held-out
episodes. Other variants are in `inspection.probe`.
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

_MARGIN = 2.0  # required half-widths of the 95 % interval, because the best of several variants is selected
_EPISODES_NEEDED = 2  # for an interval
_EPISODES_TO_BE_SURE = 10  # an interval from fewer is too narrow


@dataclass(frozen=True)
class Variant:
    """One variant of reading a data set."""

    name: str
    view: Callable[[Dataset], Dataset]
    has_frames: bool = True  # False: the frames equal those of the first variant, so its latents are used
    repair: str = ""  # the fix if this variant is better


@dataclass(frozen=True)
class VariantResult:
    """The one-step, teacher-forced error of a model under a variant."""

    name: str
    ratio: Estimate  # error relative to persistence
    error: float  # mean over clips
    persistence: float
    clips: int
    episodes: int
    difference: Estimate | None = None  # ratio minus that of another variant on the same clips; below 0: better
    repair: str = ""

    def is_certainly_better(self, *, needed: int) -> bool:
        """Return whether the difference is below 0 by more than twice the half-width of its interval.

        The margin is larger than usual, because the variant was selected on the same clips.

        Args:
            needed: Minimum number of episodes; with fewer, intervals are too narrow.
        """
        if self.difference is None or not self.difference.has_interval or self.episodes < needed:
            return False
        return self.difference.value + _MARGIN * (self.difference.high - self.difference.value) < 0


# The one-step, teacher-forced L1 errors of the model and of persistence, by clip (episode, first control step).
VariantErrors = dict[tuple[str, int], Float[np.ndarray, " 2"]]


def result_of(
    errors: VariantErrors, name: str, *, reference: VariantErrors | None = None, repair: str = ""
) -> VariantResult:
    """Return the result of a variant from its errors, compared with the reference on their common clips."""
    ids, difference = [episode for episode, _ in errors], None
    if reference is not None:
        common = [clip for clip in errors if clip in reference]
        variant, other = (np.array([part[clip] for clip in common]).T.copy() for part in (errors, reference))
        difference = estimate_ratio_difference(
            (variant[0], variant[1]), (other[0], other[1]), [name for name, _ in common]
        )
    of_model, of_persistence = np.array(list(errors.values())).T.copy()
    means, counts = (float(of_model.mean()), float(of_persistence.mean())), (len(ids), len(set(ids)))
    return VariantResult(name, estimate_ratio(of_model, of_persistence, ids), *means, *counts, difference, repair)


@dataclass(frozen=True)
class SameClips:
    """The clips on which variants are compared."""

    dataset: Dataset
    windows: Sequence[tuple[int, int]]  # episode and first control step of each
    batch_size: int  # clips per batch


def measure_variants(
    model: Predictor, encode: Encode, clips: SameClips, variants: Sequence[Variant], progress: Progress = no_progress
) -> list[VariantErrors]:
    """Measure a model's one-step error on the same clips under each variant; each episode is read only once.

    Args:
        model: The predictor.
        encode: Encodes the frames.
        clips: The clips.
        variants: The variants. The first one determines which clips can be read.
        progress: Called with (clips done, clips in total), over all variants.

    Raises:
        InputError: A clip cannot be read, or no clip can be read although `data.broken_episodes` skips broken ones.
    """
    first, done, dataset, windows = variants[0], 0, clips.dataset, clips.windows
    parts: list[VariantErrors] = [{} for _ in variants]
    for batch in read_batches(first.view(dataset), windows, batch_size=clips.batch_size):
        latents, read = encode(batch), replace(dataset, source=ReadOnce(dataset.source))
        indices = [dataset.table.find(name) for name in batch.episode_ids]
        starts = [(index, start) for index, start in zip(indices, batch.starts, strict=True) if index is not None]
        for variant, errors in zip(variants, parts, strict=True):
            batches = [latents] if variant is first else _read(variant, read, starts, encode, latents)
            for latent_batch in batches:
                errors |= _measured(model, latent_batch)
            done += len(batch.starts)
            progress(done, len(windows) * len(variants))
    return parts


def _read(
    variant: Variant, dataset: Dataset, windows: Sequence[tuple[int, int]], encode: Encode, latents: LatentBatch
) -> Iterable[LatentBatch]:
    """Yield a batch of clips under a variant; frames are encoded only if the variant changes them."""
    for batch in read_batches(variant.view(dataset), windows, batch_size=len(windows)):
        if variant.has_frames:
            yield encode(batch)
        else:
            device = latents.states.device
            yield replace(latents, states=batch.states.to(device), actions=batch.actions.to(device))


def _measured(model: Predictor, latents: LatentBatch) -> VariantErrors:
    result = measure_errors(model, latents, ONE_STEP_PREDICTIONS, (L1,))
    errors = np.stack([result.of("teacher_forced", L1, kind).mean(axis=1) for kind, _ in ONE_STEP_PREDICTIONS], axis=1)
    return dict(zip(zip(latents.episode_ids, latents.starts, strict=True), errors, strict=True))


@dataclass(frozen=True)
class ReadOnce:
    """A source that changes episodes, and keeps them in memory, because reading remote or large episodes is slow.

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
        """Return a changed episode; read it at the first call only."""
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
        needed = "a trained model, because its error determines the stride"
        fix = "Set data.stride to a number, or set model.base to a trained model (data calibrate: --model)"
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

    results: Mapping[int, VariantResult]  # by stride; the best one is compared with the second best
    impossible: Mapping[int, str]  # by stride: the reason for which it could not be measured
    frames: int
    split: Split
    rate_hz: float  # control steps per second

    @property
    def stride(self) -> int:
        """The stride with the lowest error relative to persistence."""
        return _by_ratio(self.results)[0]

    @property
    def best(self) -> VariantResult:
        """The result at the best stride."""
        return self.results[self.stride]

    @property
    def is_certain(self) -> bool:
        """Whether the best stride is certainly better than the second best."""
        return self.best.is_certainly_better(needed=_EPISODES_TO_BE_SURE)

    def verdict(self) -> str:
        """Return a sentence with the best stride and its certainty."""
        best, difference = self.best, self.best.difference
        seconds = self.stride / self.rate_hz
        text = (
            f"Best stride: {self.stride} ({seconds:.2f} s per model step), error relative to persistence {best.ratio}"
        )
        if difference is None:
            text += "; no other stride was measured"
        else:
            text += f"; {-difference.value:.3f} lower than at stride {_by_ratio(self.results)[1]}"
            if difference.has_interval:
                text += f" (95 % interval {-difference.high:.3f} to {-difference.low:.3f})"
            text += (
                ""
                if self.is_certain
                else f", not significant with {counted(best.episodes, 'episode')}; measure more episodes"
            )
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


def _by_ratio(results: Mapping[int, VariantResult]) -> list[int]:
    """Return the strides, the best one first."""
    return sorted(results, key=lambda stride: results[stride].ratio.value)


def calibrate_config(
    config: Config, sample: ClipSample, *, model: str | None = None, reporter: Reporter = SILENT
) -> Calibration:
    """Calibrate the model of a config, or another one, on the config's data.

    A latent cache contains only the frames of clips at one stride, so frames are encoded here.

    Args:
        config: The config with data, model, device and precision.
        sample: The clips at each stride.
        model: Another model in a form that `model.base` accepts, or the folder of a run.
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
    """Calibrate the stride for a model that is on the accelerator's device, in the run's precision.

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

    A stride is possible if its clips fit into at least two episodes (or one, if no stride fits into two). All possible
    strides are measured at the starts from which a clip of the largest stride fits.

    Args:
        model: The predictor.
        encode: Encodes the frames.
        dataset: The data set; its own stride is ignored.
        sample: The clips at each stride.
        progress: Called with (clips done, clips in total).

    Raises:
        InputError: The split is empty, no stride fits into any of its episodes, or a clip cannot be read.
    """
    frames, split, rate = sample.num_frames(dataset.config), sample.split, dataset.control_rate_hz
    settings = dataset.config.model_copy(update={"frames": frames})
    strides = sample.strides or candidate_strides(rate)
    views = {stride: replace(dataset, config=settings.with_stride(stride)) for stride in strides}
    possible, impossible = _possible(views, split)
    windows = validation_windows(views[possible[-1]], split, clips=sample.clips)
    widest_first = possible[::-1]
    variants = [Variant(str(stride), partial(_at_stride, views[stride])) for stride in widest_first]
    clips = SameClips(dataset, windows, sample.batch_size)
    errors = dict(zip(widest_first, measure_variants(model, encode, clips, variants, progress), strict=True))
    names = {stride: f"stride {stride} ({stride / rate:.2f} s)" for stride in possible}
    results = {stride: result_of(errors[stride], name) for stride, name in names.items()}
    if len(results) > 1:
        best, second, *_ = _by_ratio(results)
        results[best] = result_of(errors[best], names[best], reference=errors[second])
    return Calibration(results, impossible, frames, split, rate)


def _at_stride(view: Dataset, dataset: Dataset) -> Dataset:
    return replace(view, source=dataset.source)


def _possible(views: dict[int, Dataset], split: Split) -> tuple[list[int], dict[int, str]]:
    """Return the strides whose clips fit into enough episodes, and the reasons for all other strides."""
    fitting, reasons = {}, {}
    for stride, dataset in views.items():
        try:
            fitting[stride] = len(np.unique(dataset.windows(split).episodes))
        except InputError as error:
            reasons[stride] = f"{error.found}. Expected {error.needed}" if error.needed else error.found
            if len(reasons) == len(views):
                raise
    needed = min(_EPISODES_NEEDED, max(fitting.values()))
    for stride, episodes in fitting.items():
        if episodes < needed:
            steps = counted(views[stride].config.clip_steps, "control step")
            reasons[stride] = f"a clip of {steps} fits into 1 episode only"
    return [stride for stride in fitting if stride not in reasons], dict(sorted(reasons.items()))


def choose_stride(
    config: Config, dataset: Dataset, accelerator: Accelerator, reporter: Reporter
) -> tuple[WorldModel, Calibration]:
    """Load the base model of a run whose `data.stride` is auto, and calibrate the stride.

    Only candidates whose clips fit into the episodes are measured. The result is the same in all processes.

    Raises:
        InputError: The base model is random, no candidate fits, or as for `calibrate_model`.
    """
    world_model = load_named(config, dataset, None).to(accelerator.device)
    reporter.note("data.stride is auto: measuring the model at each candidate stride")
    fitting, errors = [], []
    for stride in candidate_strides(dataset.control_rate_hz):
        view = dataset.with_stride(stride)
        try:
            view.windows("train"), view.windows("validation")
        except InputError as error:
            errors.append(error)
            reporter.note(f"  stride {stride}: not possible: no clip of {dataset.config.frames} frames fits")
        else:
            fitting.append(stride)
    if not fitting:
        raise errors[0]
    sample = ClipSample(clips=config.validation.clips, strides=tuple(fitting))
    calibration = calibrate_model(world_model, dataset, config, accelerator, sample)
    for result in calibration.results.values():
        reporter.note(f"  {result.name}: error relative to persistence {result.ratio:.3f}")
    reporter.note(calibration.verdict())
    return world_model, broadcast_object(accelerator, calibration)
