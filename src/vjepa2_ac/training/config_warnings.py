"""Warnings about a config with which fine-tuning is likely to make planning worse; they need no model and no frames.

A public run with the released weights made energy landscapes worse (docs/predecessor.md). It used the wrist camera and
few steps within the warm-up, and nothing was measured during training. `init`, `train --check` and `train` print these
warnings.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from vjepa2_ac.config import Config
from vjepa2_ac.model.model_files import OFFICIAL
from vjepa2_ac.storage.paths import BUILTIN

_WRIST = re.compile(r"wrist|hand|eih|gripper", re.I)
_TOLERANCE = 0.3  # relative difference between model steps that is accepted; control rates rarely allow equal steps
_PAGE = "docs/predecessor.md"


@dataclass(frozen=True)
class TrainingData:
    """What is known about the data with which a base model was trained."""

    model: str  # description of the base model
    cameras: str  # description of its cameras, all of them exterior
    shortest_step_s: float  # duration of a model step, in seconds
    longest_step_s: float  # larger than the shortest one if the duration is not known exactly


_RELEASED = TrainingData("the released model", "DROID's exterior camera exterior_1_left", 4 / 15, 1.0)
_TINY = TrainingData("the tiny model", "exterior cameras", 4 / 15, 4 / 15)


def is_wrist_camera(name: str) -> bool:
    """Return whether the name of a camera suggests that it is mounted on the hand."""
    return _WRIST.search(name) is not None


def find_training_data(config: Config) -> TrainingData | None:
    """Return what is known about the training data of a config's base model; None for an unknown or a new model."""
    base = config.model.base
    if base == f"{BUILTIN}sim-tiny":
        return _TINY
    return _RELEASED if Path(base).stem == OFFICIAL else None


def list_config_warnings(config: Config, control_rate_hz: float | None) -> list[str]:
    """Return the warnings about camera, model step, schedule and validation, as sentences.

    Camera and model step are compared only with a base model whose training data are known.

    Args:
        config: The config of the run.
        control_rate_hz: Control steps per second of the data; None: unknown.
    """
    known = find_training_data(config)
    warnings = list[str]()
    if known is not None:
        warnings += _check_cameras(config, known)
        if control_rate_hz is not None and config.data.stride != "auto":
            warnings += _check_model_step(config.data.model_stride, control_rate_hz, known)
    warnings += _check_schedule(config)
    if not config.model.is_random:
        warnings += _check_validation(config)
    return warnings


def _check_cameras(config: Config, known: TrainingData) -> Iterator[str]:
    if names := [name for name in config.data.cameras if is_wrist_camera(name)]:
        yield (
            f"data.camera: {', '.join(names)} seems to be a camera on the hand, and {known.model} was trained with"
            f" {known.cameras}. A public fine-tuning with such a camera made the energy landscapes worse ({_PAGE}). Use"
            " an exterior camera if there is one"
        )


def _check_model_step(stride: int, control_rate_hz: float, known: TrainingData) -> Iterator[str]:
    step_s = stride / control_rate_hz
    low, high = known.shortest_step_s, known.longest_step_s
    if low * (1 - _TOLERANCE) <= step_s <= high * (1 + _TOLERANCE):
        return
    trained = f"{low:.2f} s" if low == high else f"{low:.2f} to {high:.2f} s (the duration is not known exactly)"
    nearest_s = low if step_s < low else high
    best = max(1, round(nearest_s * control_rate_hz))
    fix = f"Set data.stride={best}" if best != stride else "The control rate allows no closer step"
    yield (
        f"data.stride: {stride} gives model steps of {step_s:.2f} s, and {known.model} was trained with {trained}."
        f" {fix}, or compare strides with `vjepa2-ac data calibrate`"
    )


def _check_schedule(config: Config) -> Iterator[str]:
    warmup, steps = config.training.warmup_steps, config.training.steps
    if warmup >= steps:
        yield (
            f"training.warmup_steps: {warmup:,} is not below training.steps {steps:,}, so the learning rate still rises"
            f" at the last step. Set training.warmup_steps={steps // 10}, or train longer"
        )


def _check_validation(config: Config) -> Iterator[str]:
    every, steps = config.validation.every, config.training.steps
    if config.checkpoint.keep_best == "off":
        yield (
            "checkpoint.keep_best: off selects the newest checkpoint, even if it plans worse than the base model"
            f" ({_PAGE}). Set checkpoint.keep_best=ranking"
        )
    elif config.validation.ranking_clips == 0:
        yield (
            "validation.ranking_clips: 0 measures no action ranking, and the prediction error may fall while planning"
            f" gets worse ({_PAGE}). Set validation.ranking_clips=32"
        )
    elif every >= steps:
        yield (
            f"validation.every: {every:,} is not below training.steps {steps:,}, so only the base model and the last"
            f" step are validated. Set validation.every={max(1, steps // 10):,}"
        )
