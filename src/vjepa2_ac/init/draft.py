"""A whole config: its sections, a batch that fits on the GPU, and what the run will cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vjepa2_ac.config import Config, EncoderConfig, ModelConfig
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.config.model import ModelSizes
from vjepa2_ac.init.choices import (
    CLIPS_A_STEP,
    ModelChoice,
    adapter_knobs,
    data_knobs,
    following_knobs,
    model_knobs,
    training_knobs,
)
from vjepa2_ac.init.found import FoundData, Knob, Knobs, as_yaml, guesses, plain
from vjepa2_ac.init.machine import Machine, duration
from vjepa2_ac.model.checkpoints.loading import base_sizes
from vjepa2_ac.places import BUILTIN
from vjepa2_ac.training.cost.flops import clip_flops, frame_flops
from vjepa2_ac.training.cost.memory import GIGABYTE, estimate_memory

RELEASED = "checkpoints/vjepa2-ac-vitg.pt"
SCRATCH_ENCODER = "checkpoints/vjepa2.1-vitb-384.pt"
TINY = f"{BUILTIN}sim-tiny"
_UTILIZATION = 0.4  # of the speed of one large product: assumed
_LARGEST_BATCH = 16


@dataclass(frozen=True)
class Draft:
    """A config with its reasons, and what it costs."""

    knobs: Knobs
    config: Config
    memory_bytes: int | None  # at the peak; None: of the tiny model
    fits: bool
    hours: float | None  # None: there is no GPU
    encoding_hours: float  # of them, before the first step
    cache_bytes: int | None

    def text(self, found: FoundData, machine: Machine) -> str:
        """Return the config as a person reads it."""
        head = [
            f"Written by `vjepa2-ac init` for {found.path}: {'; '.join(found.about)}.",
            f"Machine: {machine.about}.",
            *self.costs(machine),
            "Every other knob has its default: `vjepa2-ac config show` prints all, and docs/training.md explains them.",
            "(sim): measured on the simulated arm with its tiny model, not on your robot.",
        ]
        if unsure := guesses(self.knobs):
            head.append(f"Look at what is marked GUESSED: {', '.join(unsure)}.")
        return as_yaml(head, self.knobs)

    def costs(self, machine: Machine) -> list[str]:
        """Return what the run is expected to take, a line each."""
        lines = []
        if self.memory_bytes is not None:
            word = "fits on" if self.fits else "does NOT fit on"
            needed = f"{self.memory_bytes / GIGABYTE:.1f} GB"
            lines.append(f"Memory, as `vjepa2-ac doctor` counts: {needed}; {word} {machine.room}.")
        if self.cache_bytes is not None:
            lines.append(f"Disk: at most {max(0.1, self.cache_bytes / GIGABYTE):,.1f} GB of cached latents.")
        if self.hours is not None:
            speed = f"{(machine.flops or 0) / 1e12:.0f} TFLOP/s measured here for one product"
            lines.append(f"Time: {duration(self.hours)}, if a step reaches {_UTILIZATION:.0%} (assumed) of {speed}.")
        elif machine.gpu is None and self.memory_bytes is not None:
            lines.append(
                "Time: not known without the GPU; run `vjepa2-ac init` on the machine that has it: batch and precision"
                " are then its own."
            )
        return lines

    def time_of(self, steps: int) -> str | None:
        """Return about how long so many optimizer steps take, with encoding before the first; None: not known."""
        if self.hours is None:
            return None
        share = steps / self.config.training.steps
        return duration(self.encoding_hours + (self.hours - self.encoding_hours) * share)


def choose_model(kind: str, path: str | None) -> ModelChoice:
    """Return the model to train.

    Args:
        kind: released, or scratch: a fresh predictor on an encoder.
        path: What `model.base` or `model.encoder.path` takes; None: the released one.

    Raises:
        InputError: There is a folder, and it is no model.
    """
    path = path or (SCRATCH_ENCODER if kind == "scratch" else RELEASED)
    is_tiny = path.startswith(BUILTIN)
    if kind == "scratch" and not is_tiny:
        config = ModelConfig(encoder=EncoderConfig(path=path, frame="tubelet"), random=ModelSizes())
    else:
        config = ModelConfig(base=path)
    sizes = base_sizes(config)
    return ModelChoice("tiny" if is_tiny and kind != "scratch" else kind, path, sizes)


def make_draft(found: FoundData, machine: Machine, model: ModelChoice, *, run_dir: str) -> Draft:
    """Return the config for a data set on a machine.

    Raises:
        InputError: The values found do not make a config.
    """
    training = training_knobs(found, machine, model)
    knobs: Knobs = {
        "run_dir": Knob(run_dir),
        "seed": Knob(0),
        "data": data_knobs(found, machine, model),
        "model": model_knobs(model, machine),
        "adapter": adapter_knobs(model, found),
        "training": training,
        **following_knobs(int(plain(training)["steps"])),
    }
    config = _config_of(knobs)
    if model.is_tiny:
        return Draft(
            knobs,
            config,
            None,
            fits=True,
            hours=None,
            encoding_hours=0.0,
            cache_bytes=_cache_bytes(config, found, model),
        )
    sizes = base_sizes(config.model)
    batch, checkpointing, needed = _fit(config, sizes, machine)
    fits = needed <= machine.gpu_bytes
    fitted = _batch_knobs(batch, machine, checkpointing=checkpointing, fits=fits)
    knobs = {**knobs, "training": {**training, **fitted}}
    config = _config_of(knobs)
    hours, encoding = _hours(config, sizes, found, machine)
    return Draft(knobs, config, needed, fits, hours, encoding, _cache_bytes(config, found, model))


def _config_of(knobs: Knobs) -> Config:
    return parse_config(plain(knobs), where="vjepa2-ac init")


def _fit(config: Config, sizes: ModelSizes, machine: Machine) -> tuple[int, bool, int]:
    """Return batch size, whether with checkpointing, and bytes at the peak: the largest batch that fits, 4 at first."""
    room = machine.gpu_bytes

    def needed(batch: int, *, checkpointing: bool) -> int:
        if batch not in estimates:
            training = config.training.model_copy(update={"batch_size": batch})
            estimates[batch] = estimate_memory(config.model_copy(update={"training": training}), sizes)
        return int(estimates[batch].total(checkpointing=checkpointing))

    estimates: dict[int, Any] = {}
    batch = config.training.batch_size
    if needed(batch, checkpointing=False) <= room:
        while machine.gpu and batch < _LARGEST_BATCH and needed(2 * batch, checkpointing=False) <= room:
            batch *= 2
        return batch, False, needed(batch, checkpointing=False)
    while batch > 1 and needed(batch, checkpointing=True) > room:
        batch //= 2
    return batch, True, needed(batch, checkpointing=True)


def _batch_knobs(batch: int, machine: Machine, *, checkpointing: bool, fits: bool) -> Mapping[str, Knob]:
    why = f"{'does not fit' if checkpointing else 'fits'} without on {machine.room}"
    return {
        "batch_size": Knob(
            batch, f"the largest tried that fits on {machine.room}" if fits else f"does not fit on {machine.room}"
        ),
        "accumulation": Knob(max(1, CLIPS_A_STEP // batch), f"{CLIPS_A_STEP} clips a step"),
        "gradient_checkpointing": Knob(checkpointing, why),
    }


def _hours(config: Config, sizes: ModelSizes, found: FoundData, machine: Machine) -> tuple[float | None, float]:
    """Return the hours of a run, and those of them that are for encoding before the first step."""
    if machine.flops is None:
        return None, 0.0
    clip, training = clip_flops(config, sizes), config.training
    clips = training.steps * training.batch_size * training.accumulation
    an_hour = machine.flops * _UTILIZATION * 3600
    if not config.data.takes_latents:
        return clips * clip.total / an_hour, 0.0
    encoding = (found.steps or 0) * frame_flops(sizes) / an_hour
    return encoding + clips * clip.predictor / an_hour, encoding


def _cache_bytes(config: Config, found: FoundData, model: ModelChoice) -> int | None:
    return (found.steps or 0) * model.bytes_a_frame if config.data.takes_latents else None
