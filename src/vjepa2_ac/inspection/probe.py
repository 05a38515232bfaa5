"""Data variants: under which does a trained model predict best: unchanged, mirrored, shifted, ...?

The same clips are measured unchanged and with one thing changed at a time, of every episode and nothing on disk; a
variant that is certainly better is most likely the true reading of the data.
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
from vjepa2_ac.data.windows import spread
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
    load_named,
    measure_variants,
    result_of,
)
from vjepa2_ac.intervals import ENOUGH_EPISODES
from vjepa2_ac.spaces import POSE, euler_from_matrices, matrices_from_euler

SHIFTS = (1, 2, 4, 8)  # control steps
AS_THEY_ARE = "as they are"
_CANDIDATES_PER_CLIP = 8  # windows checked per clip, since shifts need room on both sides
_GAIN = 0.01  # of persistence: smaller gains are irrelevant


@dataclass(frozen=True)
class VariantProbe:
    """The results of all variants, each compared with the unchanged data."""

    plain: VariantResult  # of these
    results: tuple[VariantResult, ...]

    @property
    def better(self) -> VariantResult | None:
        """The variant that fits best, if it certainly fits better than the unchanged data."""
        certain = [one for one in self.results if one.is_certainly_better(needed=ENOUGH_EPISODES)]
        gains = {one: -one.difference.value for one in certain if one.difference and one.ratio.high < 1}
        better = [one for one, gain in gains.items() if gain > _GAIN]  # with a ratio above 1 it only fails less
        return max(better, key=lambda one: gains[one], default=None)

    @property
    def is_decided(self) -> bool:
        """Whether the model can tell variants apart: on enough episodes it predicts better than persistence."""
        return self.better is not None or (self.plain.episodes >= ENOUGH_EPISODES and self.plain.ratio.value < 1)

    def verdict(self) -> str:
        """Return as text whether the unchanged data fit the model best."""
        plain, better = self.plain, self.better
        text = f"one-step error / persistence {plain.ratio} on {counted(plain.clips, 'clip')}"
        text += f" of {counted(plain.episodes, 'episode')}"
        if better is not None and (found := better.difference) is not None:
            less = f"{-found.value:.3f} [{-found.high:.3f}, {-found.low:.3f}]"
            return f"{text}, lower by {less} with {better.name}: {better.repair}"
        if plain.episodes < ENOUGH_EPISODES:
            return f"needs at least {ENOUGH_EPISODES} episodes, found {plain.episodes} ({text})"
        if plain.ratio.value >= 1:
            return f"needs a model that predicts these data better than persistence ({text})"
        return f"{text}; no variant fits better with certainty"


def probe_config(
    config: Config, dataset: Dataset, *, model: str, clips: int = 64, progress: Progress = no_progress
) -> VariantProbe:
    """Probe the data of a config, opened at a fixed stride, with a model.

    Args:
        config: The device and the precision.
        dataset: The data.
        model: What `model.base` takes, or the folder of a run.
        clips: Number of clips, of the validation episodes; of training episodes if there are no others.
        progress: Called with the number of measured clips.

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
    """Measure a model's one-step error on unchanged clips, and under each variant.

    Args:
        model: The predictor.
        encode: Makes the latents.
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
    variants = [Variant(AS_THEY_ARE, lambda same: same), *variants_of(dataset.config, shifts)]
    clips = SameClips(dataset, windows, sample.batch_size)
    plain, *measured = measure_variants(model, encode, clips, variants, progress)
    results = [
        result_of(found, one.name, reference=plain, repair=one.repair)
        for one, found in zip(variants[1:], measured, strict=True)
    ]
    return VariantProbe(result_of(plain, AS_THEY_ARE), tuple(results))


def _with_room(
    dataset: Dataset, candidates: list[tuple[int, int]], clips: int
) -> tuple[list[tuple[int, int]], list[int]]:
    """Return the starts of clips, and the shifts for which each has states before and after it."""
    steps, length = dataset.table.num_steps, dataset.config.clip_steps
    enough = max(1, min(clips, len(candidates) // 4))
    fitting, shifts = candidates, list[int]()
    for room in SHIFTS:
        wider = [(episode, start) for episode, start in fitting if room <= start <= steps[episode] - length - room]
        if len(wider) < enough:
            break
        fitting = wider
        shifts.append(room)
    return [fitting[place] for place in spread(len(fitting), clips)], shifts


def variants_of(config: DataConfig, shifts: Sequence[int]) -> list[Variant]:
    """Return the variants that apply to this data.

    Args:
        config: The data.
        shifts: Control steps by which to shift frames against states.
    """
    found = [
        _variant(
            f"frames {_steps(shift)} {'late' if shift > 0 else 'early'}",
            f"give each frame the state of {_steps(shift)} {'before' if shift > 0 else 'after'}",
            partial(shifted, late=shift),
        )
        for size in shifts
        for shift in (size, -size)
    ]
    if config.actions == "difference":  # a command has no opposite
        turned = _of_states(lambda states: np.ascontiguousarray(states[::-1]))
        found.append(_variant("the states backwards", "reverse the order of the frames", turned))
    if config.states == "pose":
        for axis, name in enumerate("xy"):
            repair = f"negate {name}, with the rotation (as of a mirror)"
            found.append(_variant(f"{name} negated", repair, _of_states(partial(mirrored, axis=axis))))
        inverted = _of_states(lambda states: np.append(states[:, :-1], 1 - states[:, -1:], axis=1))
        section, fields = config.pose_fields
        repair = f"exchange data.{section}.gripper_open and gripper_closed" if fields else "write 1 - gripper"
        found.append(_variant("the gripper inverted", repair, inverted))
    if not config.is_cache:
        exchanged, flipped = _of_frames(lambda frames: frames[..., ::-1]), _of_frames(lambda frames: frames[:, :, ::-1])
        repair = "exchange red and blue (OpenCV reads and writes BGR) where the data is written"
        found.append(_variant("red and blue exchanged", repair, exchanged, has_frames=True))
        repair = "flip the frames, left to right, where the data is written"
        found.append(_variant("frames mirrored", repair, flipped, has_frames=True))
    return found


def _variant(name: str, repair: str, change: Callable[[Episode], Episode], *, has_frames: bool = False) -> Variant:
    """Return a variant of changed episodes; without frames where they are the same."""

    def no_frames(steps: Sequence[int]) -> np.ndarray:
        return np.zeros((len(steps), 1, 1, 3), np.uint8)

    def changed(episode: Episode) -> Episode:
        found = change(episode)
        return found if has_frames else replace(found, read_frames=no_frames, read_latents=None)

    def view(dataset: Dataset) -> Dataset:
        return replace(dataset, source=ReadOnce(dataset.source, changed))

    return Variant(name, view, has_frames, repair)


def mirrored(states: Float[np.ndarray, "steps 7"], axis: int) -> Float[np.ndarray, "steps 7"]:
    """Return poses mirrored across the plane of two axes: one coordinate and two rotations negated."""
    mirror = np.ones(3)
    mirror[axis] = -1
    rotations = matrices_from_euler(states[:, POSE.rotation]) * mirror[:, None] * mirror
    return np.concatenate([states[:, POSE.position] * mirror, euler_from_matrices(rotations), states[:, -1:]], axis=1)


def _steps(shift: int) -> str:
    return counted(abs(shift), "step")


def shifted(episode: Episode, *, late: int) -> Episode:
    """Give each step the state, and the command, of `late` steps before; beyond the ends, the first or the last."""
    steps = np.clip(np.arange(len(episode.states)) - late, 0, len(episode.states) - 1)
    commands = None if episode.commands is None else episode.commands[steps]
    return replace(episode, states=episode.states[steps], commands=commands)


def _of_states(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Episode], Episode]:
    return lambda episode: replace(episode, states=change(episode.states))


def _of_frames(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Episode], Episode]:
    def changed(episode: Episode) -> Episode:
        return replace(episode, read_frames=lambda steps: np.ascontiguousarray(change(episode.read_frames(steps))))

    return changed
