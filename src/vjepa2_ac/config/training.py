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
    LocalPath,
    LocalPathOrBuiltin,
    NonNegative,
    PathOrUrl,
    Positive,
    PositiveInt,
    Section,
    ZeroToOne,
)
from vjepa2_ac.registry import LOSSES, TRACKERS

DecoderSize = Literal["tiny", "small", "medium"]


def default_warmup_steps(values: dict[str, Any]) -> int:
    """Return the default of `training.warmup_steps` for the values of the section `training`."""
    return min(1_000, int(values.get("steps", 0)) // 10)


class TrainingConfig(Section):
    """Optimization, losses and computation."""

    steps: PositiveInt = 100_000
    """Number of optimizer steps."""
    batch_size: PositiveInt = 2
    """Number of clips per process and micro-batch."""
    accumulation: PositiveInt = 16
    """Number of micro-batches per process and optimizer step. A run that resumes with another number of processes keeps
    the number of clips per step, and accumulation changes accordingly."""
    rollout_steps: Annotated[int, Field(ge=1, le=64)] = 2
    """Number of predictions in the rollout loss; the first is teacher-forced, each further one uses the previous
    prediction."""
    loss: Annotated[Component, ComponentOf(LOSSES, "l1")] = Component("l1")
    """Difference between predicted and true latents. l1: absolute (released). l2: squared. smooth_l1: squared below its
    option beta, absolute above. Or the name of your loss (docs/extending.md)."""
    learning_rate: Annotated[float, Field(gt=0.0, le=1.0)] = 1e-4
    """Peak learning rate."""
    schedule: Literal["cosine", "warmup_stable_decay"] = "cosine"
    """Both start with a linear warm-up from 0. cosine: then half a cosine down to 0. warmup_stable_decay: then
    constant, with a linear decay to 0 in the last decay_steps."""
    warmup_steps: Count = Field(default_factory=default_warmup_steps)
    """Number of optimizer steps of the linear warm-up. Default: the smaller of 1,000 and a tenth of the steps."""
    decay_steps: Count = 0
    """Number of optimizer steps of the final decay, for warmup_stable_decay only; 0: the rate stays constant."""
    optimizer: Literal["adamw", "adamw_8bit"] = "adamw"
    """adamw_8bit stores the moments of matrices with at least 4,096 elements in 8 bits. Needs bitsandbytes (extra
    8bit)."""
    weight_decay: ZeroToOne = 0.04
    """Weight decay of AdamW; biases and norms are excluded."""
    max_grad_norm: Positive | None = 1.0
    """Gradients are clipped to this norm; null: no clipping (the released recipe)."""
    precision: Annotated[Literal["bf16", "fp16", "fp32"], Affects.LATENTS | Affects.RUN] = "bf16"
    """Precision of the computation (autocast). On CUDA bf16 needs compute capability 8.0; fp16 needs CUDA."""
    gradient_checkpointing: bool = False
    """Recompute each predictor block in the backward pass instead of storing its activations."""
    compile: Annotated[Literal["off", "blocks"], OFF] = "off"
    """blocks: torch.compile for the predictor's blocks, in training steps only. Needs a C compiler, and a minute before
    the first step. Losses and gradients are equal up to rounding; dropout draws other masks."""
    cuda_graph: bool = False
    """Launch a micro-batch as one CUDA graph: faster if Python is slower than the GPU. Dropout must be 0."""
    attention: Literal["auto", "per_step"] = "auto"
    """auto: FlexAttention in training steps on CUDA, compiled for each batch size. per_step: plain attention for each
    model step, without compilation. Losses and gradients are equal up to rounding."""
    device: Annotated[Literal["auto", "cpu", "cuda"], Affects.RUN | Affects.PLAN] = "auto"
    """auto: CUDA if available, otherwise the CPU."""
    allow_weak_base: Annotated[bool, Affects.NOTHING] = False
    """Train even if the base model is not better than persistence (copying the last frame) on the validation clips."""
    patience: Annotated[PositiveInt | None, Affects.NOTHING] = None
    """Number of consecutive validations without improvement (`checkpoint.keep_best`) after which training ends; null:
    training ends after all steps."""
    log_every: Annotated[PositiveInt, Affects.NOTHING] = 10
    """Number of optimizer steps between two lines in metrics.jsonl."""

    @model_validator(mode="after")
    def _parts_fit(self) -> TrainingConfig:
        warmup, decay = self.warmup_steps, self.decay_steps
        return self.check_rules(
            (warmup + decay > self.steps, f"warmup_steps {warmup} and decay_steps {decay} exceed steps {self.steps}"),
            (decay and self.schedule == "cosine", "decay_steps is only for schedule: warmup_stable_decay"),
        )


class ValidationConfig(Section):
    """Validation before the first step and during training."""

    every: PositiveInt = 1_000
    """Number of optimizer steps between validations."""
    clips: PositiveInt = 64
    """Number of clips of held-out episodes; the same clips in every validation."""
    batch_size: Annotated[int, Field(ge=2)] = 4
    """Number of clips per batch."""
    ranking_clips: Annotated[int, Field(ge=0), Affects.MEASURED] = 32
    """Number of these clips on which the action-ranking error is measured (docs/evaluation.md). In each clip, the
    largest motion that a planner could choose in one step is used, forwards and backwards. 0: none."""
    ranking_samples: Annotated[PositiveInt, Affects.MEASURED] = 32
    """Number of alternative actions per motion, drawn twice: from a box of 7.5 cm to each side, and with the length of
    the true action in random directions."""
    decoder: Annotated[LocalPathOrBuiltin | None, Affects.NOTHING] = None
    """Folder of a decoder (docs/decoding.md), or builtin:sim-tiny: each validation then draws the frames that base
    model and trained model predict for the validation clip with the most motion, in RUN/imagined and in the trackers.
    null: no images."""


class CheckpointConfig(Section):
    """Checkpoints, and their copies on remote storage."""

    every: PositiveInt = 1_000
    """Number of optimizer steps between checkpoints. A checkpoint is also saved when the last one is 15 minutes old."""
    keep: PositiveInt = 5
    """Number of newest checkpoints that are kept."""
    keep_best: Annotated[Literal["ranking", "error", "off"], OFF, Affects.MEASURED] = "ranking"
    """The criterion for the best checkpoint. The best checkpoint is saved and kept, and is the default for evaluation,
    export and planning. ranking: the lowest action-ranking error (`validation.ranking_clips`), and among those within
    half a percentage point of it the lowest rollout error. The base model is a candidate, because a lower error may
    come with worse plans; a later checkpoint is a candidate if the 95 % interval of its action-ranking error is below
    chance (50 %). error: the rollout error relative to persistence at the last horizon. off: no best checkpoint, the
    default is the newest."""
    remote: PathOrUrl | None = None
    """Where the run is copied during training: gs://bucket/folder, another writable fsspec URL, or a folder. A start
    with an empty run_dir resumes from the copy. `keep` and `keep_best` also apply to the copy. null: no copy."""
    remote_every_minutes: NonNegative = 30.0
    """Minutes between uploads to `remote`. The run is also uploaded at the end and on preemption."""
    remote_wait_seconds: NonNegative = 120.0
    """How long a preempted run waits for the upload, in seconds; shorter than the notice period of the machine."""


class TrackingConfig(Section):
    """Experiment trackers that receive the metrics in addition to metrics.jsonl in the run folder."""

    tensorboard: bool = True
    """TensorBoard event files in RUN/tensorboard (extra tensorboard). Without the extra a run prints how to install
    it."""
    wandb: Literal["disabled", "online", "offline"] = "disabled"
    """Weights & Biases (extra wandb). offline: files in RUN/wandb, which `wandb sync` uploads later."""
    trackio: bool = False
    """trackio (extra trackio): stored in trackio's folder (TRACKIO_DIR), shown by `trackio show`."""
    others: Annotated[dict[str, dict[str, Any]], TRACKERS.options_schema] = {}
    """Your trackers (docs/extending.md): name -> options, {} for none."""

    @model_validator(mode="after")
    def _trackers_are_registered(self) -> TrackingConfig:
        for name, options in self.others.items():
            TRACKERS.options(TRACKERS.require_registered(name), options, at=("others", name))
        return self


class DecoderConfig(Section):
    """The decoder that `vjepa2-ac decoder` trains, to display latents as frames."""

    folder: Annotated[LocalPath | None, Affects.NOTHING] = None
    """Folder of the decoder; null: the folder `decoder` next to run_dir. A decoder belongs to an encoder and a camera,
    not to a run."""
    size: DecoderSize = "small"
    """Size of the decoder; with the released encoder tiny (for small encoders) has 2 M parameters, small 27 M, medium
    96 M."""
    frames: PositiveInt = 40_000
    """Maximum number of training frames, spread over the training episodes; each is encoded once. With the released
    encoder each takes 0.9 MB of disk with data.cache_dtype bf16, 0.6 MB with int8, until training ends."""
    steps: PositiveInt = 20_000
    """Number of optimizer steps."""
    batch_size: PositiveInt = 64
    """Number of frames per step."""
    learning_rate: Annotated[float, Field(gt=0.0, le=1.0)] = 5e-4
    """Peak learning rate, followed by half a cosine down to 0."""
