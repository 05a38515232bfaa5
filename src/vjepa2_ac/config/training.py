"""Which knobs has the way the weights change, and what is kept of it?"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from vjepa2_ac.config.section import PositiveInt, Section


class TrainingConfig(Section):
    """How the weights change."""

    steps: PositiveInt = 100_000
    """Optimizer steps."""
    batch_size: PositiveInt = 2
    """Clips per device and micro-batch."""
    accumulation: PositiveInt = 16
    """Micro-batches per optimizer step."""
    rollout_steps: Annotated[int, Field(ge=1, le=64)] = 2
    """Predictions of the rollout loss; the first is the teacher-forced one, each further one is fed back."""
    learning_rate: Annotated[float, Field(gt=0.0, le=1.0)] = 1e-4
    """Peak learning rate."""
    schedule: Literal["cosine", "warmup_stable_decay"] = "cosine"
    """cosine: linear warm-up, then half a cosine. warmup_stable_decay: linear warm-up, constant, linear decay."""
    warmup_steps: Annotated[int, Field(ge=0)] = 1_000
    """Optimizer steps of the linear warm-up."""
    decay_steps: Annotated[int, Field(ge=0)] = 0
    """Optimizer steps of the final decay; warmup_stable_decay only."""
    start_learning_rate: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """Where the warm-up starts."""
    final_learning_rate: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """Where the schedule ends."""
    weight_decay: Annotated[float, Field(ge=0.0, le=1.0)] = 0.04
    """AdamW's decay; biases and norms are exempt."""
    betas: tuple[Annotated[float, Field(ge=0.0, lt=1.0)], Annotated[float, Field(ge=0.0, lt=1.0)]] = (0.9, 0.999)
    """AdamW's decay rates of the running moments."""
    max_grad_norm: Annotated[float, Field(gt=0.0)] | None = 1.0
    """Gradients are scaled down to this norm; null: never (the released recipe)."""
    precision: Literal["bf16", "fp32"] = "bf16"
    """Arithmetic of the networks (autocast)."""
    gradient_checkpointing: bool = False
    """Compute each predictor block again in the backward pass instead of keeping its activations."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """auto: CUDA where there is one."""
    allow_weak_base: bool = False
    """Train even if the base is no better than persistence (copy the last frame) on the validation clips."""
    log_every: PositiveInt = 10
    """Optimizer steps between lines in metrics.jsonl."""

    @model_validator(mode="after")
    def _schedule_fits(self) -> TrainingConfig:
        if self.warmup_steps + self.decay_steps > self.steps:
            raise ValueError(
                f"warmup_steps {self.warmup_steps} and decay_steps {self.decay_steps} exceed steps {self.steps}"
            )
        if self.decay_steps and self.schedule != "warmup_stable_decay":
            raise ValueError(f"decay_steps belongs to schedule warmup_stable_decay, not {self.schedule}")
        return self


class ValidationConfig(Section):
    """The measurement before the first step and on the way."""

    every: PositiveInt = 1_000
    """Optimizer steps between validations."""
    clips: PositiveInt = 64
    """Clips of held-out episodes, always the same ones."""
    batch_size: Annotated[int, Field(ge=2)] = 4
    """Clips that are evaluated at once."""


class CheckpointConfig(Section):
    """What is kept of a run."""

    every: PositiveInt = 1_000
    """Optimizer steps between checkpoints."""
    keep: PositiveInt = 5
    """How many of the newest checkpoints stay."""


class TrackingConfig(Section):
    """Where figures go, besides metrics.jsonl in the run folder."""

    tensorboard: bool = True
    """Event files in RUN/tensorboard."""
