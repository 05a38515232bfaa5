"""Which reading of a data set does a model that knows robots fit best? As it is, or mirrored, shifted, reversed, ...?

A model's one-step error is lowest where actions and states are those of the pictures. So the same clips are measured as
they are and with one thing changed at a time; what surely fits better is most likely how the data really are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from vjepa2_ac.config import DataConfig
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.loader import batches_of, validation_windows
from vjepa2_ac.data.windows import Split, spread
from vjepa2_ac.episode import Batch, Episode, EpisodeInfo, EpisodeSource, LatentBatch, Progress, StepRanges
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.bootstrap import Estimate, ratio
from vjepa2_ac.evaluation.metrics import Predictor, distances
from vjepa2_ac.geometry import euler_from_matrices, matrices_from_euler

FRAMES = 8  # of a clip, at most
SHIFTS = (1, 2, 4, 8)  # control steps
_TRIED_FOR_ONE = 8  # windows that are looked at for each clip, since shifts need room on both sides
_EPISODES_TO_BE_SURE = 5
_MARGIN = 2.0  # half-widths of the 95 % interval: one of a dozen variants is soon better by chance
_GAIN = 0.01  # of persistence: what is less changes nothing


@dataclass(frozen=True)
class Variant:
    """Another reading of the same data."""

    name: str
    mend: str  # what to do where it fits better
    change: Callable[[Episode], Episode]
    changes_pictures: bool = False


@dataclass(frozen=True)
class TriedVariant:
    """How well a model predicts under a variant."""

    name: str
    mend: str
    ratio: Estimate  # one-step error over persistence
    difference: Estimate  # of this to that of the data as they are, paired by clip; below 0: fits better


@dataclass(frozen=True)
class VariantProbe:
    """What was found of each variant."""

    ratio: Estimate  # one-step error over persistence, of the data as they are
    tried: tuple[TriedVariant, ...]
    clips: int
    episodes: int

    @property
    def better(self) -> TriedVariant | None:
        """The variant that fits best, where it surely fits better than the data as they are."""
        surely = [one for one in self.tried if self._is_surely_better(one.difference)]
        return min(surely, key=lambda one: one.difference.value) if surely else None

    def _is_surely_better(self, difference: Estimate) -> bool:
        if not difference.has_interval or self.episodes < _EPISODES_TO_BE_SURE:
            return False
        return difference.value < -_GAIN and difference.value + _MARGIN * (difference.high - difference.value) < 0

    def verdict(self) -> str:
        """Say in words whether the data fit the model best as they are."""
        said = f"error / persistence {self.ratio} on {self.clips} clips of {self.episodes} episodes"
        if (better := self.better) is not None:
            less = f"{-better.difference.value:.3f} [{-better.difference.high:.3f}, {-better.difference.low:.3f}]"
            return f"{said}, and {less} less with {better.name}: {better.mend}"
        if self.episodes < _EPISODES_TO_BE_SURE:
            return f"{said}: too few episodes to compare, {_EPISODES_TO_BE_SURE} are needed"
        if self.ratio.value >= 1:
            return f"{said}: the model predicts none of this better than persistence, and cannot tell"
        return f"{said}; no variant surely fits better"

    def as_dict(self) -> dict[str, Any]:
        """Return every figure as plain values."""
        rows = [
            {"name": one.name, "error_over_persistence": one.ratio.as_dict(), "difference": one.difference.as_dict()}
            for one in self.tried
        ]
        return {
            "error_over_persistence": self.ratio.as_dict(),
            "clips": self.clips,
            "episodes": self.episodes,
            "better": None if self.better is None else self.better.name,
            "variants": rows,
        }


def variants_of(config: DataConfig, shifts: Sequence[int]) -> list[Variant]:
    """Return the variants that make sense of this data.

    Args:
        config: The data.
        shifts: Control steps by which to shift pictures against states.
    """
    found = [
        Variant(
            f"pictures {_steps(shift)} {'late' if shift > 0 else 'early'}",
            f"give each picture the state of {_steps(shift)} {'before' if shift > 0 else 'after'}",
            partial(_shifted, late=shift),
        )
        for size in shifts
        for shift in (size, -size)
    ]
    found.append(Variant("the states backwards", "turn the order of the pictures", _backwards))
    if config.states == "pose":
        for axis, name in enumerate("xy"):
            mend = f"negate {name}, with the rotation (as of a mirror); or flip the pictures"
            found.append(Variant(f"{name} negated", mend, partial(_with_mirrored_states, axis=axis)))
        found.append(Variant("the gripper inverted", _GRIPPER[config.source], _with_gripper_inverted))
    if config.source != "latents":
        mend = "exchange red and blue (OpenCV reads and writes BGR) where the data is written"
        found.append(Variant("red and blue exchanged", mend, _with_channels_exchanged, changes_pictures=True))
    return found


_GRIPPER = {
    "rlds": "set data.fields.gripper to the other convention",
    "lerobot": "exchange data.lerobot.gripper_open and gripper_closed",
    "droid_raw": "write 1 - gripper",
    "npz": "write 1 - gripper",
    "latents": "change the convention of the data set that the cache was made from",
}


def mirrored(states: Float[np.ndarray, "steps 7"], axis: int) -> Float[np.ndarray, "steps 7"]:
    """Return poses as a mirror across the plane of two axes shows them: one coordinate and two rotations negated."""
    mirror = np.ones(3)
    mirror[axis] = -1
    rotations = matrices_from_euler(states[:, 3:6]) * mirror[:, None] * mirror
    return np.concatenate([states[:, :3] * mirror, euler_from_matrices(rotations), states[:, 6:]], axis=1)


def probe_variants(
    model: Predictor,
    encode: Callable[[Batch], LatentBatch],
    dataset: Dataset,
    *,
    split: Split = "validation",
    clips: int = 64,
    batch_size: int = 8,
    progress: Progress | None = None,
) -> VariantProbe:
    """Measure a model's one-step error on clips as they are, and under each variant.

    Args:
        model: What predicts.
        encode: Turns a batch of pixels into latents on the model's device.
        dataset: Where clips come from, at a stride that is a number.
        split: Which episodes.
        clips: How many, at most.
        batch_size: Clips that are measured at once.
        progress: Told (clips done, clips in all).

    Raises:
        InputError: The split is empty, or a clip cannot be read.
    """
    dataset = replace(dataset, config=dataset.config.model_copy(update={"frames": min(dataset.config.frames, FRAMES)}))
    windows, shifts = _with_room(dataset, split, clips)
    variants = variants_of(dataset.config, shifts)
    errors: list[list[np.ndarray]] = []
    persistence: list[np.ndarray] = []
    ids: list[str] = []
    for batch in batches_of(dataset, windows, batch_size=batch_size):
        latents = encode(batch)
        again = [(dataset.table.find(name), start) for name, start in zip(batch.episode_ids, batch.starts, strict=True)]
        same = [(place, start) for place, start in again if place is not None]
        errors.append(
            [_errors(model, latents), *(_under(one, model, encode, dataset, same, latents) for one in variants)]
        )
        persistence.append(distances(latents.latents[:, :-1], latents.latents[:, 1:]).l1.mean(axis=1))
        ids += batch.episode_ids
        if progress is not None:
            progress(len(ids), len(windows))
    measured = np.concatenate([np.array(of_batch) for of_batch in errors], axis=1)
    return _compared(variants, measured, np.concatenate(persistence), ids)


def _compared(
    variants: Sequence[Variant],
    errors: Float[np.ndarray, "variants_and_plain clips"],
    persistence: Float[np.ndarray, " clips"],
    ids: Sequence[str],
) -> VariantProbe:
    tried = [
        TriedVariant(
            one.name, one.mend, ratio(error, persistence, ids), ratio(error - errors[0], persistence, ids)
        )
        for one, error in zip(variants, errors[1:], strict=True)
    ]  # fmt: skip
    return VariantProbe(ratio(errors[0], persistence, ids), tuple(tried), len(ids), len(set(ids)))


@torch.no_grad()
def _errors(model: Predictor, batch: LatentBatch) -> Float[np.ndarray, " clips"]:
    extrinsics = None if batch.extrinsics is None else batch.extrinsics[:, :-1]
    predicted = model.predict(batch.latents[:, :-1], batch.actions, batch.states[:, :-1], extrinsics)
    return np.asarray(distances(predicted, batch.latents[:, 1:]).l1.mean(axis=1))


def _under(
    variant: Variant,
    model: Predictor,
    encode: Callable[[Batch], LatentBatch],
    dataset: Dataset,
    windows: list[tuple[int, int]],
    plain: LatentBatch,
) -> Float[np.ndarray, " clips"]:
    """Return the errors of the same clips under a variant; pictures are encoded again only where it changes them."""
    source = _Changed(dataset.source, variant)
    changed = next(iter(batches_of(replace(dataset, source=source), windows, batch_size=len(windows))))
    if variant.changes_pictures:
        return _errors(model, encode(changed))
    device = plain.states.device
    return _errors(model, replace(plain, states=changed.states.to(device), actions=changed.actions.to(device)))


@dataclass(frozen=True)
class _Changed:
    """A source under a variant; without pictures where the variant leaves these as they are."""

    source: EpisodeSource
    variant: Variant

    def infos(self, progress: Progress | None = None) -> Sequence[EpisodeInfo]:
        """Return those of the source."""
        return self.source.infos(progress)

    def read(self, index: int, camera: str | None = None, needed: StepRanges | None = None) -> Episode:
        """Return an episode, changed."""
        episode = self.variant.change(self.source.read(index, camera, needed))
        if self.variant.changes_pictures:
            return episode
        return replace(episode, read_frames=_no_pictures, read_latents=None)


def _no_pictures(steps: Sequence[int]) -> np.ndarray:
    return np.zeros((len(steps), 1, 1, 3), np.uint8)


def _with_room(dataset: Dataset, split: Split, clips: int) -> tuple[list[tuple[int, int]], tuple[int, ...]]:
    """Return where clips start, and the shifts for which each has states before and behind it."""
    candidates = validation_windows(dataset, split, clips=clips * _TRIED_FOR_ONE)
    steps, length = dataset.table.num_steps, dataset.config.clip_steps
    for count in range(len(SHIFTS), -1, -1):
        room = SHIFTS[count - 1] if count else 0
        fitting = [(e, start) for e, start in candidates if room <= start <= int(steps[e]) - length - room]
        if len(fitting) >= min(clips, len(candidates) // 4) or not count:
            return [fitting[place] for place in spread(len(fitting), clips)], SHIFTS[:count]
    raise InputError(where=f"data.path: {dataset.config.path}", found="no clips")


def _steps(shift: int) -> str:
    return "1 step" if abs(shift) == 1 else f"{abs(shift)} steps"


def _shifted(episode: Episode, *, late: int) -> Episode:
    """Give each step the state of so many steps before; of those beyond the ends, the first or the last."""
    steps = np.arange(len(episode.states)) - late
    return replace(episode, states=episode.states[np.clip(steps, 0, len(episode.states) - 1)])


def _backwards(episode: Episode) -> Episode:
    return replace(episode, states=np.ascontiguousarray(episode.states[::-1]))


def _with_mirrored_states(episode: Episode, *, axis: int) -> Episode:
    return replace(episode, states=mirrored(episode.states, axis))


def _with_gripper_inverted(episode: Episode) -> Episode:
    states = episode.states.copy()
    states[:, 6] = 1 - states[:, 6]
    return replace(episode, states=states)


def _with_channels_exchanged(episode: Episode) -> Episode:
    def read(steps: Sequence[int]) -> np.ndarray:
        return np.ascontiguousarray(episode.read_frames(steps)[..., ::-1])

    return replace(episode, read_frames=read)


def rows_of(probe: VariantProbe) -> Iterator[tuple[str, str, str]]:
    """Yield name, error over persistence, and difference, for a table; the data as they are first."""
    yield "as they are", str(probe.ratio), ""
    for one in probe.tried:
        yield one.name, str(one.ratio), str(one.difference)
