"""Variants: the same clips of a data set, read in several ways and measured with a model, compared pair by pair.

A model's one-step error over persistence is lowest where frames, states and actions are those that it knows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
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
from vjepa2_ac.evaluation.measure import ONE_STEP, Predictor, measured
from vjepa2_ac.evaluation.result import L1
from vjepa2_ac.intervals import Estimate, ratio, ratio_difference
from vjepa2_ac.model.checkpoints.loading import load_base
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.runs.folder import is_run
from vjepa2_ac.runs.loading import load_run
from vjepa2_ac.spaces import ActionSpace

_MARGIN = 2.0  # half-widths of the 95 % interval: the best of several is easily better by chance


@dataclass(frozen=True)
class Variant:
    """One way to read a data set."""

    name: str
    view: Callable[[Dataset], Dataset]
    has_frames: bool = True  # False: they are those of the first variant, whose latents are taken
    repair: str = ""  # the fix, if it fits better


@dataclass(frozen=True)
class VariantResult:
    """The one-step, teacher-forced error of a model under a variant."""

    name: str
    ratio: Estimate  # of the error to that of copying the frame before
    error: float  # mean over clips
    persistence: float
    moved_cm: float | None  # median distance of the flange per model step; None: the states are no poses
    clips: int
    episodes: int
    difference: Estimate | None = None  # of the ratio to another variant's on the same clips; below 0: fits better
    repair: str = ""

    @property
    def gain(self) -> float:
        """By how much the ratio is below the other variant's."""
        return 0.0 if self.difference is None else -self.difference.value

    def is_certainly_better(self, *, needed: int) -> bool:
        """Return whether the difference is below 0 by twice its interval: the variant was chosen on these clips.

        Args:
            needed: Episodes; with fewer, an interval is too narrow.
        """
        if self.difference is None or not self.difference.has_interval or self.episodes < needed:
            return False
        return self.difference.value + _MARGIN * (self.difference.high - self.difference.value) < 0


@dataclass(frozen=True)
class VariantErrors:
    """What was measured of one variant, clip by clip."""

    errors: Float[np.ndarray, "2 clips"]  # one-step, teacher-forced L1 of the model and of persistence
    actions: Float[np.ndarray, "clips steps action_dim"]
    clips: tuple[tuple[str, int], ...]  # episode and first control step

    def result(
        self, name: str, space: ActionSpace, *, beside: VariantErrors | None = None, repair: str = ""
    ) -> VariantResult:
        """Return what it comes to, compared with another variant."""
        ids, moved_cm = [episode for episode, _ in self.clips], None
        if space.position is not None:
            moved_cm = float(np.median(space.shown_size(self.actions.reshape(-1, self.actions.shape[-1]))))
        error, persistence = (float(one.mean()) for one in self.errors)
        difference = None if beside is None else self._minus(beside)
        of_model, of_nothing = self.errors
        return VariantResult(
            name, ratio(of_model, of_nothing, ids), error, persistence, moved_cm, len(ids), len(set(ids)), difference,
            repair,
        )  # fmt: skip

    def _minus(self, other: VariantErrors) -> Estimate:
        """Return the ratio minus another variant's, paired by clip."""
        places = {clip: place for place, clip in enumerate(other.clips)}
        pairs = [(place, places[clip]) for place, clip in enumerate(self.clips) if clip in places]
        mine, theirs = (np.array(side, dtype=np.int64) for side in zip(*pairs, strict=True))
        ids = [self.clips[place][0] for place in mine]
        one, persistence = self.errors[:, mine]
        return ratio_difference((one, persistence), (other.errors[0, theirs], other.errors[1, theirs]), ids)


def measure_variants(
    model: Predictor,
    encode: Callable[[Batch], LatentBatch],
    dataset: Dataset,
    windows: Sequence[tuple[int, int]],
    variants: Sequence[Variant],
    *,
    batch_size: int,
    progress: Progress = no_progress,
) -> list[VariantErrors]:
    """Measure a model's one-step error on the same clips under each variant; each episode is read once for all.

    Args:
        model: The predictor.
        encode: Turns a batch of pixels into latents on the model's device.
        dataset: The source of clips.
        windows: Episode and first control step of each.
        variants: The first one decides which clips can be read.
        batch_size: Clips that are computed together.
        progress: Called with (clips done, clips in total), of all variants.

    Raises:
        InputError: A clip cannot be read; or, by `data.broken_episodes`, none of them.
    """
    first = variants[0]
    parts: list[list[VariantErrors]] = [[] for _ in variants]
    done = 0
    for batch in batches_of(first.view(dataset), windows, batch_size=batch_size):
        latents, read = encode(batch), replace(dataset, source=ReadOnce(dataset.source))
        places = [dataset.table.find(name) for name in batch.episode_ids]
        here = [(place, start) for place, start in zip(places, batch.starts, strict=True) if place is not None]
        for variant, found in zip(variants, parts, strict=True):
            seen = [latents] if variant is first else _read(variant, read, here, encode, latents)
            found += [_measured(model, each) for each in seen]
            done += len(batch.starts)
            progress(done, len(windows) * len(variants))
    return [
        VariantErrors(
            np.concatenate([one.errors for one in found], axis=1),
            np.concatenate([one.actions for one in found]),
            tuple(clip for one in found for clip in one.clips),
        )
        for found in parts
    ]


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
    found = measured(model, latents, ONE_STEP, (L1,))
    errors = np.stack([found.of("teacher_forced", L1, way).mean(axis=1) for way, _ in ONE_STEP])
    clips = tuple(zip(latents.episode_ids, latents.starts, strict=True))
    return VariantErrors(errors, latents.actions.cpu().numpy().astype(np.float64), clips)


@dataclass(frozen=True)
class ReadOnce:
    """A source of which each episode is read once: a remote one, or one in a large record, takes long. It is changed.

    Args:
        source: The source.
        change: What is done to each episode.
        episodes: Those that were read.
    """

    source: EpisodeSource
    change: Callable[[Episode], Episode] = lambda episode: episode
    episodes: dict[tuple[int, str | None], Episode] = field(default_factory=dict)

    def infos(self, progress: Progress | None = None) -> Sequence[EpisodeInfo]:
        """Return the infos of the source."""
        return self.source.infos(progress)

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:
        """Return an episode, changed."""
        if (index, camera) not in self.episodes:
            self.episodes[index, camera] = self.change(self.source.read(index, camera, needed))
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
