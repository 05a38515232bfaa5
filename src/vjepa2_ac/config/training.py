"""Config keys of training, validation, checkpoints and logging, and of the training of the decoder."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from vjepa2_ac.config.section import (
    OFF,
    Affects,
    Component,
    ComponentOf,
    Count,
    Local,
    LocalOrBuiltin,
    NonNegative,
    Place,
    Positive,
    PositiveInt,
    Section,
    ZeroToOne,
)
from vjepa2_ac.registry import LOSSES, TRACKERS

DecoderSize = Literal["tiny", "small", "medium"]


def usual_warmup(values: dict[str, Any]) -> int:
    """Return the default of `training.warmup_steps` for these values of `training`."""
    return min(1_000, int(values.get("steps", 0)) // 10)


class TrainingConfig(Section):
    """How the weights change."""

    steps: PositiveInt = 100_000
    """Optimizer steps."""
    batch_size: PositiveInt = 2
    """Clips per process and micro-batch."""
    accumulation: PositiveInt = 16
    """Micro-batches of each process per optimizer step. A run resumed with another number of processes keeps the
    clips of a step: accumulation then follows from that."""
    rollout_steps: Annotated[int, Field(ge=1, le=64)] = 2
    """Predictions of the rollout loss; the first is teacher-forced, each further one uses the previous prediction."""
    loss: Annotated[Component, ComponentOf(LOSSES, "l1")] = Component("l1")
    """Distance of predicted and true latents. l1: absolute (released). l2: squared. smooth_l1: squared only below its
    option beta. Or a loss of your own (docs/extending.md)."""
    learning_rate: Annotated[float, Field(gt=0.0, le=1.0)] = 1e-4
    """Peak learning rate."""
    schedule: Literal["cosine", "warmup_stable_decay"] = "cosine"
    """Both begin with a linear warm-up from 0. cosine: then half a cosine to 0. warmup_stable_decay: then constant, and
    a linear decay to 0 in the last decay_steps."""
    warmup_steps: Count = Field(default_factory=usual_warmup)
    """Optimizer steps of the linear warm-up; unless given 1,000, or a tenth of the steps where that is less."""
    decay_steps: Count = 0
    """Optimizer steps of the final decay, warmup_stable_decay only; 0: the rate stays constant to the end."""
    optimizer: Literal["adamw", "adamw_8bit"] = "adamw"
    """adamw_8bit stores the moments of matrices of 4,096 elements and more in 8 bits: bitsandbytes, extra 8bit."""
    weight_decay: ZeroToOne = 0.04
    """AdamW's decay; biases and norms are exempt."""
    max_grad_norm: Positive | None = 1.0
    """Gradients are clipped to this norm; null: never (the released recipe)."""
    precision: Annotated[Literal["bf16", "fp16", "fp32"], Affects.LATENTS | Affects.RUN] = "bf16"
    """Arithmetic of the networks (autocast). bf16 needs compute capability 8.0 on CUDA; fp16 needs CUDA, too."""
    gradient_checkpointing: bool = False
    """Compute each predictor block again in the backward pass instead of keeping its activations."""
    compile: Annotated[Literal["off", "blocks"], OFF] = "off"
    """blocks: torch.compile for the predictor's blocks, in training steps only; needs a C compiler, and a minute before
    the first step. The same losses and gradients to rounding; dropout draws other masks."""
    cuda_graph: bool = False
    """Launch a micro-batch as one CUDA graph: faster where Python is slower than the GPU. Dropout must be 0."""
    attention: Literal["auto", "per_step"] = "auto"
    """auto: FlexAttention in training steps on CUDA, which is compiled for each size of a batch. per_step: one plain
    attention for each model step, which compiles nothing. The same losses and gradients to rounding."""
    device: Annotated[Literal["auto", "cpu", "cuda"], Affects.RUN | Affects.PLAN] = "auto"
    """auto: CUDA where there is one."""
    allow_weak_base: Annotated[bool, Affects.NOTHING] = False
    """Train even if the base is no better than persistence (copy the last frame) on the validation clips."""
    patience: Annotated[PositiveInt | None, Affects.NOTHING] = None
    """Validations without a better one (`checkpoint.keep_best`) after which training ends; null: all steps are done."""
    log_every: Annotated[PositiveInt, Affects.NOTHING] = 10
    """Optimizer steps between lines in metrics.jsonl."""

    @model_validator(mode="after")
    def _parts_fit(self) -> TrainingConfig:
        warmup, decay = self.warmup_steps, self.decay_steps
        return self.refused(
            (warmup + decay > self.steps, f"warmup_steps {warmup} and decay_steps {decay} exceed steps {self.steps}"),
            (decay and self.schedule == "cosine", "decay_steps belongs to schedule warmup_stable_decay, not cosine"),
        )


class ValidationConfig(Section):
    """Validation before the first step and during training."""

    every: PositiveInt = 1_000
    """Optimizer steps between validations."""
    clips: PositiveInt = 64
    """Clips of held-out episodes, always the same ones."""
    batch_size: Annotated[int, Field(ge=2)] = 4
    """Clips that are evaluated at once."""
    ranking_clips: Annotated[int, Field(ge=0), Affects.MEASURED] = 32
    """Of these clips, how many have the true action of a move ranked among others: what planning needs (docs/
    evaluation.md). Two moves each, as large as planned ones, forwards and backwards. 0: none."""
    ranking_samples: Annotated[PositiveInt, Affects.MEASURED] = 32
    """Other actions per move, drawn in each of two ways: in a box of 7.5 cm to each side, and of the same length in any
    direction."""
    decoder: Annotated[LocalOrBuiltin | None, Affects.NOTHING] = None
    """Folder of a decoder (docs/decoding.md), or builtin:sim-tiny: with it each validation draws what base and model
    imagine of one validation clip, the one with the most motion: in RUN/imagined and in the trackers. null: none."""


class CheckpointConfig(Section):
    """Checkpoints, here and elsewhere."""

    every: PositiveInt = 1_000
    """Optimizer steps between checkpoints; one is also written when the last one is 15 minutes old."""
    keep: PositiveInt = 5
    """Number of newest checkpoints that are kept."""
    keep_best: Annotated[Literal["ranking", "error", "off"], OFF, Affects.MEASURED] = "ranking"
    """By what the best checkpoint is selected; it is written and kept, and evaluated, exported and planned with unless
    another is asked for. ranking: the lowest action-ranking error (`validation.ranking_clips`); among those within half
    a percentage point, the lowest error; the base is a candidate, because a lower error may go with worse plans. error:
    the rollout error over persistence at the last horizon. off: the newest counts."""
    remote: Place | None = None
    """Where the run is copied to during training: gs://bucket/folder, another URL of fsspec that can be written, or a
    folder. A start with an empty run_dir resumes from there; null: nowhere. Same keep and best as here."""
    remote_every_minutes: NonNegative = 30.0
    """Minutes between uploads to remote; there is also one at the end and on preemption."""
    remote_wait_seconds: NonNegative = 120.0
    """How long a preempted run waits for that; shorter than the notice period of the machine."""


class TrackingConfig(Section):
    """Where metrics go, besides metrics.jsonl in the run folder."""

    tensorboard: bool = True
    """Event files in RUN/tensorboard, extra tensorboard. Without the extra a run prints how to install it."""
    wandb: Literal["disabled", "online", "offline"] = "disabled"
    """Weights & Biases, extra wandb. offline: files in RUN/wandb, which `wandb sync` sends later."""
    trackio: bool = False
    """trackio, extra trackio: stored where trackio stores its runs (TRACKIO_DIR), shown by `trackio show`."""
    others: Annotated[dict[str, dict[str, Any]], TRACKERS.things_in_schema] = {}
    """Trackers of your own (docs/extending.md), by name, each with its options: {} where it has none."""

    @model_validator(mode="after")
    def _others_are_known(self) -> TrackingConfig:
        for name, options in self.others.items():
            TRACKERS.options(TRACKERS.known(name), options, at=("others", name))
        return self


class DecoderConfig(Section):
    """The decoder that `vjepa2-ac decoder` trains: it shows what the encoder's latents hold."""

    folder: Annotated[Local | None, Affects.NOTHING] = None
    """Folder of the decoder; null: `decoder`, beside run_dir. It is made for an encoder and a camera, not for a run."""
    size: DecoderSize = "small"
    """Parameters at the released sizes: tiny 2 M, for small encoders; small 27 M; medium 96 M."""
    frames: PositiveInt = 40_000
    """Frames to learn from, at most, spread over the training episodes; each is encoded once. They take 0.9 MB of disk
    each at the released sizes with data.cache_dtype bf16, 0.6 MB with int8, until training ends."""
    steps: PositiveInt = 20_000
    """Optimizer steps."""
    batch_size: PositiveInt = 64
    """Frames of a step."""
    learning_rate: Annotated[float, Field(gt=0.0, le=1.0)] = 5e-4
    """Peak learning rate; it falls to none by half a cosine."""
