"""Compare the error of a trained model on a data set with its errors on mirrored, shifted or otherwise changed data.

The same clips are measured unchanged and with one change at a time, which applies to all episodes. No file is changed.
If the error is certainly lower with a change, the data are most likely recorded or configured wrongly in this respect.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float

from vjepa2_ac.config import Config, DataConfig
from vjepa2_ac.config.data import Split
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.loader import validation_windows
from vjepa2_ac.data.windows import spread_indices
from vjepa2_ac.distributed import make_accelerator
from vjepa2_ac.encoding.batch import encode_batch
from vjepa2_ac.episode import Episode, Progress, no_progress
from vjepa2_ac.errors import InputError, counted
from vjepa2_ac.evaluation.measure import ClipSample, Predictor
from vjepa2_ac.inspection.variants import (
    Encode,
    ReadOnce,
    SameClips,
    Variant,
    VariantResult,
    compute_result,
    load_named,
    measure_variants,
)
from vjepa2_ac.intervals import MIN_EPISODES
from vjepa2_ac.spaces import POSE, euler_from_matrices, matrices_from_euler

SHIFTS = (1, 2, 4, 8)  # control steps
UNCHANGED = "unchanged"
_CANDIDATES_PER_CLIP = 8  # candidate starts per clip, because many have too few states on both sides for a shift
_GAIN = 0.01  # smaller gains, relative to persistence, are irrelevant


@dataclass(frozen=True)
class VariantProbe:
    """The results of all variants, each compared with the unchanged data."""

    plain: VariantResult  # the result on unchanged data
    results: tuple[VariantResult, ...]

    @property
    def better(self) -> VariantResult | None:
        """The best variant that is certainly better than the unchanged data and better than persistence; None: none."""
        certain = [result for result in self.results if result.is_certainly_better(min_episodes=MIN_EPISODES)]
        gains = {result: -result.difference.value for result in certain if result.difference and result.ratio.high < 1}
        better = [result for result, gain in gains.items() if gain > _GAIN]
        return max(better, key=lambda result: gains[result], default=None)

    @property
    def is_decided(self) -> bool:
        """Whether there is a verdict: a variant is better, or the model beats persistence on enough episodes."""
        return self.better is not None or (self.plain.episodes >= MIN_EPISODES and self.plain.ratio.value < 1)

    def verdict(self) -> str:
        """Return as text whether the model predicts the unchanged data best."""
        plain, better = self.plain, self.better
        text = f"one-step error relative to persistence {plain.ratio} on {counted(plain.clips, 'clip')}"
        text += f" from {counted(plain.episodes, 'episode')}"
        if better is not None and (difference := better.difference) is not None:
            less = f"{-difference.value:.3f} [{-difference.high:.3f}, {-difference.low:.3f}]"
            return f"{text}; {less} lower for the variant '{better.name}'. To fix the data, {better.repair}"
        if plain.episodes < MIN_EPISODES:
            return f"needs at least {MIN_EPISODES} episodes, found {plain.episodes} ({text})"
        if plain.ratio.value >= 1:
            return f"needs a model that predicts these data better than persistence ({text})"
        return f"{text}; no variant is significantly better"


def probe_config(
    config: Config, dataset: Dataset, *, model: str, clips: int = 64, progress: Progress = no_progress
) -> VariantProbe:
    """Compare a data set with changed variants by the error of a model.

    Args:
        config: The config, for device and precision.
        dataset: The data set, at a fixed stride.
        model: A model in a form that `model.base` accepts, or the folder of a run.
        clips: Maximum number of clips, from the validation split, or from the training split if there is none.
        progress: Called with the number of measured clips and the total number.

    Raises:
        InputError: The data or the model cannot be used.
    """
    accelerator = make_accelerator(config)
    world_model = load_named(config, dataset, model).to(accelerator.device)
    encode = partial(encode_batch, world_model, device=accelerator.device)
    split: Split = "validation"
    try:
        dataset.windows(split)
    except InputError:
        split = "train"
    with accelerator.autocast(), torch.no_grad():
        sample = ClipSample(split, clips, batch_size=config.validation.batch_size)
        return probe_variants(world_model, encode, dataset, sample, progress)


def probe_variants(
    model: Predictor, encode: Encode, dataset: Dataset, sample: ClipSample, progress: Progress = no_progress
) -> VariantProbe:
    """Measure a model's one-step error on unchanged clips and on each variant.

    Args:
        model: The predictor.
        encode: Encodes the frames.
        dataset: The data set, at a fixed stride.
        sample: The clips.
        progress: Called with the number of measured clips and the total number.

    Raises:
        InputError: The split is empty, or a clip cannot be read.
    """
    # The candidates are starts of clips with `data.frames` frames, because a latent cache contains only these.
    candidates = validation_windows(dataset, sample.split, clips=sample.clips * _CANDIDATES_PER_CLIP)
    frames = sample.num_frames(dataset.config)
    dataset = replace(dataset, config=dataset.config.model_copy(update={"frames": frames}))
    windows, shifts = _select_shiftable(dataset, candidates, sample.clips)
    variants = [Variant(UNCHANGED, lambda unchanged: unchanged), *make_variants(dataset.config, shifts)]
    clips = SameClips(dataset, windows, sample.batch_size)
    plain, *changed = measure_variants(model, encode, clips, variants, progress)
    results = [
        compute_result(errors, variant.name, reference=plain, repair=variant.repair)
        for variant, errors in zip(variants[1:], changed, strict=True)
    ]
    return VariantProbe(compute_result(plain, UNCHANGED), tuple(results))


def _select_shiftable(
    dataset: Dataset, candidates: list[tuple[int, int]], clips: int
) -> tuple[list[tuple[int, int]], list[int]]:
    """Return the windows of clips, and the shifts for which each clip has enough states before and after it."""
    num_steps, length = dataset.table.num_steps, dataset.config.clip_steps
    min_clips = max(1, min(clips, len(candidates) // 4))
    fitting, shifts = candidates, list[int]()
    for shift in SHIFTS:
        remaining = [
            (episode, start) for episode, start in fitting if shift <= start <= num_steps[episode] - length - shift
        ]
        if len(remaining) < min_clips:
            break
        fitting = remaining
        shifts.append(shift)
    return [fitting[index] for index in spread_indices(len(fitting), clips)], shifts


def make_variants(config: DataConfig, shifts: Sequence[int]) -> list[Variant]:
    """Return the variants that apply to a data set.

    Args:
        config: The data config.
        shifts: Control steps by which to shift frames relative to states.
    """
    variants = [
        _make_variant(
            f"frames {_format_steps(shift)} {'late' if shift > 0 else 'early'}",
            f"give each frame the state of {_format_steps(shift)} {'before' if shift > 0 else 'after'}",
            partial(shift_states, late=shift),
        )
        for size in shifts
        for shift in (size, -size)
    ]
    if config.actions == "difference":  # recorded commands cannot be reversed
        backwards = _change_states(lambda states: np.ascontiguousarray(states[::-1]))
        variants.append(_make_variant("states reversed", "reverse the order of the frames", backwards))
    if config.states == "pose":
        for axis, name in enumerate("xy"):
            repair = f"negate {name} and mirror the rotation"
            variants.append(_make_variant(f"{name} negated", repair, _change_states(partial(mirror_poses, axis=axis))))
        inverted = _change_states(lambda states: np.append(states[:, :-1], 1 - states[:, -1:], axis=1))
        section, fields = config.pose_fields
        repair = f"exchange data.{section}.gripper_open and gripper_closed" if fields else "write 1 - gripper"
        variants.append(_make_variant("gripper inverted", repair, inverted))
    if not config.is_cache:
        exchanged, flipped = (
            _change_frames(lambda frames: frames[..., ::-1]),
            _change_frames(lambda frames: frames[:, :, ::-1]),
        )
        repair = "exchange red and blue (OpenCV reads and writes BGR) where the data is written"
        variants.append(_make_variant("red and blue exchanged", repair, exchanged, changes_frames=True))
        repair = "flip the frames, left to right, where the data is written"
        variants.append(_make_variant("frames mirrored", repair, flipped, changes_frames=True))
    return variants


def _make_variant(
    name: str, repair: str, change: Callable[[Episode], Episode], *, changes_frames: bool = False
) -> Variant:
    """Return a variant that changes each episode. Without `changes_frames` the frames are not read."""

    def no_frames(steps: Sequence[int]) -> np.ndarray:
        return np.zeros((len(steps), 1, 1, 3), np.uint8)

    def change_episode(episode: Episode) -> Episode:
        changed = change(episode)
        return changed if changes_frames else replace(changed, read_frames=no_frames, read_latents=None)

    def view(dataset: Dataset) -> Dataset:
        return replace(dataset, source=ReadOnce(dataset.source, change_episode))

    return Variant(name, view, changes_frames, repair)


def mirror_poses(states: Float[np.ndarray, "steps 7"], axis: int) -> Float[np.ndarray, "steps 7"]:
    """Mirror poses by negating one coordinate and the rotations about the two other axes."""
    mirror = np.ones(3)
    mirror[axis] = -1
    rotations = matrices_from_euler(states[:, POSE.rotation]) * mirror[:, None] * mirror
    return np.concatenate([states[:, POSE.position] * mirror, euler_from_matrices(rotations), states[:, -1:]], axis=1)


def _format_steps(shift: int) -> str:
    return counted(abs(shift), "step")


def shift_states(episode: Episode, *, late: int) -> Episode:
    """Give each step the state and the command of `late` steps before; at the ends, the first or last step repeats."""
    steps = np.clip(np.arange(len(episode.states)) - late, 0, len(episode.states) - 1)
    commands = None if episode.commands is None else episode.commands[steps]
    return replace(episode, states=episode.states[steps], commands=commands)


def _change_states(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Episode], Episode]:
    return lambda episode: replace(episode, states=change(episode.states))


def _change_frames(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Episode], Episode]:
    def change_episode(episode: Episode) -> Episode:
        return replace(episode, read_frames=lambda steps: np.ascontiguousarray(change(episode.read_frames(steps))))

    return change_episode
