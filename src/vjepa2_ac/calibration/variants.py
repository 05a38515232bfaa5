"""Variants: the same clips of a data set, read in several ways and measured with a model, compared pair by pair.

A model's one-step error over persistence is lowest where frames, states and actions are those that it knows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from vjepa2_ac.config import Config, ModelConfig
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.loader import batches_of
from vjepa2_ac.encoding.batch import require_same_encoder, require_widths
from vjepa2_ac.episode import Batch, Episode, EpisodeInfo, EpisodeSource, LatentBatch, Progress, StepRanges, no_progress
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.measure import Predictor, one_step_errors
from vjepa2_ac.intervals import Estimate, ratio, ratio_difference
from vjepa2_ac.model.checkpoints.loading import load_base
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.runs.folder import is_run
from vjepa2_ac.runs.loading import load_run

_MARGIN = 2.0  # half-widths of the 95 % interval: the best of several is easily better by chance


@dataclass(frozen=True)
class SameClips:
    """The clips on which variants are compared."""

    dataset: Dataset
    windows: Sequence[tuple[int, int]]  # episode and first control step
    batch_size: int  # clips that are computed together


@dataclass(frozen=True)
class Variant:
    """One way to read a data set."""

    name: str
    view: Callable[[Dataset], Dataset]
    has_frames: bool = True  # False: they are those of the first variant, whose latents are taken


@dataclass(frozen=True)
class VariantErrors:
    """What was measured of one variant, clip by clip."""

    errors: Float[np.ndarray, " clips"]  # one-step, teacher-forced L1
    persistence: Float[np.ndarray, " clips"]
    actions: Float[np.ndarray, "clips steps action_dim"]
    clips: tuple[tuple[str, int], ...]  # episode and first control step

    @classmethod
    def joined(cls, parts: Sequence[VariantErrors]) -> VariantErrors:
        """Return all clips of some batches."""
        return cls(
            np.concatenate([one.errors for one in parts]),
            np.concatenate([one.persistence for one in parts]),
            np.concatenate([one.actions for one in parts]),
            tuple(clip for one in parts for clip in one.clips),
        )

    @property
    def episode_ids(self) -> tuple[str, ...]:
        """The episode of each clip."""
        return tuple(episode for episode, _ in self.clips)

    @property
    def ratio(self) -> Estimate:
        """The error over persistence."""
        return ratio(self.errors, self.persistence, self.episode_ids)

    def minus(self, other: VariantErrors) -> Estimate:
        """Return the ratio minus another variant's, paired by clip; below 0 is better."""
        places = {clip: place for place, clip in enumerate(other.clips)}
        pairs = [(place, places[clip]) for place, clip in enumerate(self.clips) if clip in places]
        mine, theirs = (np.array(side, dtype=np.int64) for side in zip(*pairs, strict=True))
        ids = [self.episode_ids[place] for place in mine]
        return ratio_difference(
            (self.errors[mine], self.persistence[mine]), (other.errors[theirs], other.persistence[theirs]), ids
        )


def is_certainly_better(difference: Estimate, episodes: int, *, needed: int) -> bool:
    """Return whether a difference of ratios is below 0 by twice its interval: the variant was chosen on these clips.

    Args:
        difference: As of `VariantErrors.minus`.
        episodes: From how many it is.
        needed: With fewer, an interval is too narrow.
    """
    limit = difference.value + _MARGIN * (difference.high - difference.value)
    return difference.has_interval and episodes >= needed and limit < 0


def measure_variants(
    model: Predictor,
    encode: Callable[[Batch], LatentBatch],
    clips: SameClips,
    variants: Sequence[Variant],
    progress: Progress = no_progress,
) -> dict[str, VariantErrors]:
    """Measure a model's one-step error on the same clips under each variant; each episode is read once for all.

    Args:
        model: The predictor.
        encode: Turns a batch of pixels into latents on the model's device.
        clips: What to measure on.
        variants: The first one decides which clips can be read.
        progress: Called with (clips done, clips in total), of all variants.

    Raises:
        InputError: A clip cannot be read; or, by `data.broken_episodes`, none of them.
    """
    first, *others = variants
    dataset, windows = clips.dataset, clips.windows
    parts: dict[str, list[VariantErrors]] = {variant.name: [] for variant in variants}
    done = 0
    for batch in batches_of(first.view(dataset), windows, batch_size=clips.batch_size):
        latents, here = encode(batch), _windows_of(dataset, batch)
        read = replace(dataset, source=_RememberingSource(dataset.source))
        for variant, found in (
            (first, [latents]),
            *((one, _read(one, read, here, encode, latents)) for one in others),
        ):
            parts[variant.name] += [_measured(model, each) for each in found]
            done += len(batch.starts)
            progress(done, len(windows) * len(variants))
    return {name: VariantErrors.joined(found) for name, found in parts.items()}


def _read(
    variant: Variant,
    dataset: Dataset,
    windows: Sequence[tuple[int, int]],
    encode: Callable[[Batch], LatentBatch],
    latents: LatentBatch,
) -> Iterable[LatentBatch]:
    """Yield a batch of clips under a variant; frames are encoded only if it has some of its own."""
    for batch in batches_of(variant.view(dataset), windows, batch_size=len(windows)):
        if variant.has_frames:
            yield encode(batch)
        else:
            device = latents.states.device
            yield replace(latents, states=batch.states.to(device), actions=batch.actions.to(device))


def _measured(model: Predictor, latents: LatentBatch) -> VariantErrors:
    clips = tuple(zip(latents.episode_ids, latents.starts, strict=True))
    return VariantErrors(*one_step_errors(model, latents), latents.actions.cpu().numpy().astype(np.float64), clips)


def _windows_of(dataset: Dataset, batch: Batch) -> list[tuple[int, int]]:
    places = [dataset.table.find(name) for name in batch.episode_ids]
    return [(place, start) for place, start in zip(places, batch.starts, strict=True) if place is not None]


@dataclass(frozen=True)
class _RememberingSource:
    """A source that reads each episode once: a remote one, or one in a large record, takes long."""

    source: EpisodeSource
    episodes: dict[tuple[int, str | None], Episode] = field(default_factory=dict)

    def infos(self, progress: Progress | None = None) -> Sequence[EpisodeInfo]:
        return self.source.infos(progress)

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:
        if (index, camera) not in self.episodes:
            self.episodes[index, camera] = self.source.read(index, camera, needed)
        return self.episodes[index, camera]


def load_named(config: Config, dataset: Dataset, model: str | None) -> WorldModel:
    """Return the model of a run's folder, or of what `model.base` takes; None: the config's own. It fits the data.

    Raises:
        InputError: There is none, it cannot be read, is randomly initialized, or does not fit the data.
    """
    if model is not None and is_run(model):
        loaded = load_run(Path(model)).world_model
    else:
        chosen = config.model if model is None else config.model.with_base(model)
        require_learned(chosen)
        loaded = load_base(chosen, seed=config.seed)
    require_widths(loaded, dataset.widths, where=model or f"model.base: {config.model.base}")
    require_same_encoder(loaded, dataset, config)
    return loaded.eval()


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


def ratios_by_name(measured: Mapping[str, VariantErrors]) -> dict[str, float]:
    """Return the error over persistence of each variant, without intervals."""
    return {name: float(one.errors.sum() / one.persistence.sum()) for name, one in measured.items()}
