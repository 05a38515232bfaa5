"""The training steps that `train_step.py` times: this package's and the official one, with the same weights."""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any
from unittest import mock

import torch
from accelerate import Accelerator
from memory import release_memory
from official_predictor import PREDICTOR, OfficialStep, compare_with_official
from random_models import add_random_adapter, random_model
from rows import describe_failure
from torch import Tensor
from torch.nn.functional import layer_norm

from vjepa2_ac.config import (
    AdapterConfig,
    Config,
    DataConfig,
    EncoderSizes,
    ModelConfig,
    ModelSizes,
    PredictorSizes,
    TrainingConfig,
)
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.transforms import pixels_to_input
from vjepa2_ac.distributed import make_accelerator
from vjepa2_ac.episode import Batch, LatentBatch
from vjepa2_ac.model.checkpoints import to_official
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.runs.checkpoint import RunState
from vjepa2_ac.training.cost import ALLOWANCE, estimate_memory
from vjepa2_ac.training.cuda_graph import GraphedMicroStep
from vjepa2_ac.training.flops import clip_flops
from vjepa2_ac.training.optim import make_optimizer
from vjepa2_ac.training.step import Objective, Run, micro_step, training_step

OFFICIAL = "official"
OFFICIAL_FULL = "official_full"  # full fine-tuning of the official predictor
COMPILED, GRAPH = "+compile", "+graph"  # suffixes of this package's variants, in this order
PRECISIONS = {"float32": "fp32", "bfloat16": "bf16"}
_TINY_LEARNING_RATE = 1e-30  # keeps the weights, so that all steps have the loss and gradients of the first step
_STEP_AFTER_WARM_UP = 1001  # number of a step after the warm-up of the learning rate


@dataclass(frozen=True)
class Setting:
    """The setting of a line: clip length, batch size, and what is computed in the step."""

    frames: int
    batch: int
    checkpointing: bool
    encoder: bool = False  # whether latents are computed in the step


@dataclass(frozen=True)
class WarmUp:
    """The result of a variant's first two steps."""

    step: Callable[[], object] | None  # None: a step failed
    first_s: float | None  # duration of the first step
    problem: str | None  # why a step failed
    metrics: dict[str, float] = field(default_factory=dict)  # loss and gradient norm; empty for the official code


def our_variants(attention: Sequence[str], *, compiled: bool) -> list[str]:
    """Return the variants of this package: kinds of attention, and with `compiled` the same with compiled blocks."""
    return [*attention, *(variant + COMPILED for variant in attention if compiled)]


def apply_variant(model: WorldModel, variant: str) -> None:
    """Set the attention and the compilation of a variant of this package."""
    model.set_attention(variant.split("+", maxsplit=1)[0])  # type: ignore[arg-type]  # checked when it is used
    model.set_compiled("with gradients" if COMPILED in variant else "never")


def has_checkout(options: argparse.Namespace) -> bool:
    """Return whether the official code is at --official."""
    return bool((options.official / PREDICTOR).is_file())


class Bench:
    """The models of this package and of the official code, in one precision and with equal weights."""

    _official_class = OfficialStep

    def __init__(self, options: argparse.Namespace, dtype: str) -> None:
        self.options, self.precision = options, PRECISIONS[dtype]
        self.dtype, self.device = getattr(torch, dtype), torch.device(options.device)
        self.sizes = ModelSizes(
            image_size=options.image_size,
            encoder=EncoderSizes(
                width=options.latent_dim, heads=options.latent_dim // 64, depth=options.encoder_layers
            ),
            predictor=PredictorSizes(width=options.width, heads=options.width // 64, depth=options.layers),
        )
        self._weights: dict[str, Any] | None = None  # for the official code; None without a checkout

    @cached_property
    def model(self) -> WorldModel:
        """The model of this package, in float32 until its first step."""
        return self._model().train()

    @cached_property
    def official(self) -> OfficialStep:
        """The official step; must be built before the first step of this package, which casts the weights."""
        return self._build_official()

    @cached_property
    def official_full(self) -> OfficialStep:
        """The official step with full fine-tuning, as released. It needs 5 GB."""
        return self._build_official(is_full=True)

    def compare(self) -> str | None:
        """Return how the loss and the gradients of the official code differ on a short clip in float32; None: not."""
        # By default PyTorch rounds the inputs of convolutions on CUDA to TF32.
        with torch.backends.cudnn.flags(allow_tf32=False):
            return self._compare()

    def _compare(self) -> str | None:
        setting = Setting(
            min(max(4, self.options.rollout_steps + 1), *self.options.frames), 1, False, "pixels" in self.options.source
        )
        objective = Objective(self.model, self.config(setting).training)
        latents = self.latents(setting)
        if setting.encoder:
            pixels = pixels_to_input(self.frames(setting), self.options.image_size)
            gap = (self.model.encode(pixels) - self.official.encode(pixels.transpose(1, 2))).abs().max()
            if not gap < 1e-3:  # the latents have variance 1
                return f"latents differ by {float(gap):.2g}"
        return compare_with_official(objective, self.official, latents)

    def frames(self, setting: Setting) -> Tensor:
        """Return the frames of a batch, on the device."""
        frames = self.batch(setting).frames
        if frames is None:
            raise ValueError("the batch has latents instead of frames")
        return frames.to(self.device)

    def config(self, setting: Setting, *, is_full: bool = False, graph: bool = False) -> Config:
        """Return the config of a run, with LoRA or full fine-tuning. Its data and base model are never opened."""
        options = self.options
        return Config(
            run_dir="benchmark",
            data=DataConfig(path="none", frames=setting.frames, source="rlds" if setting.encoder else "latents"),
            adapter=AdapterConfig(kind="none" if is_full else "lora"),
            model=ModelConfig(base="none", dtype="bfloat16" if self.precision == "bf16" else "float32"),
            training=TrainingConfig(
                batch_size=setting.batch, accumulation=1, rollout_steps=options.rollout_steps,
                learning_rate=_TINY_LEARNING_RATE, cuda_graph=graph,
                device="cpu" if self.device.type == "cpu" else "cuda",
                precision="bf16" if self.precision == "bf16" else "fp32", gradient_checkpointing=setting.checkpointing,
            ),
        )  # fmt: skip

    def flops_per_clip(self, setting: Setting, variant: str = "") -> int:
        """Return the model FLOPs of a clip."""
        flops = clip_flops(self.config(setting, is_full=variant == OFFICIAL_FULL), self.sizes)
        return flops.total if setting.encoder else flops.predictor

    def estimated_gb(self, setting: Setting) -> float:
        """Return the GPU memory that `doctor` estimates, without the allowance for memory outside of PyTorch."""
        config = self.config(setting)
        config = config.model_copy(update={"validation": config.validation.model_copy(update={"batch_size": 1})})
        estimate = estimate_memory(config, self.sizes)
        return (estimate.total(checkpointing=setting.checkpointing) - ALLOWANCE) / 1e9

    def step(self, setting: Setting, variant: str) -> Callable[[], object]:
        """Return a function that computes one optimizer step of a variant and waits for the device."""
        latents, pixels = self.latents(setting), None
        if variant in {OFFICIAL, OFFICIAL_FULL}:
            if setting.encoder:
                frames = self.frames(setting)
                pixels = pixels_to_input(frames, self.options.image_size).transpose(1, 2).contiguous()
            official = self.official if variant == OFFICIAL else self.official_full
            return partial(
                official.step, latents, pixels, self.dtype, checkpointing=setting.checkpointing
            )  # waits for the loss, as in the official training
        for parameter in self.model.parameters():
            if not parameter.requires_grad:
                parameter.data = parameter.data.to(self.dtype)
        run, batches = self.run(setting, graph=variant.endswith(GRAPH)), itertools.repeat(self.batch(setting))
        return partial(self._our_step, run, batches, None if setting.encoder else latents, variant)

    def _our_step(self, run: Run, batches: Any, latents: LatentBatch | None, variant: str) -> dict[str, float]:
        apply_variant(self.model, variant)
        self.model.set_gradient_checkpointing(run.config.training.gradient_checkpointing)
        if latents is None:
            return training_step(run, batches, step=_STEP_AFTER_WARM_UP)
        with mock.patch("vjepa2_ac.training.step.encode", return_value=latents):  # as cached latents
            return training_step(run, batches, step=_STEP_AFTER_WARM_UP)

    def warm_up(self, setting: Setting, variant: str) -> WarmUp:
        """Run the first two steps of a variant, which include compilation. A lack of memory is reported."""
        began = time.perf_counter()
        try:
            step = self.step(setting, variant)
            step()
            first_s = time.perf_counter() - began
            all_metrics = step()  # some graphs are compiled again in the second step
            names = ("loss", "grad_norm")
            metrics = {name: all_metrics[name] for name in names} if isinstance(all_metrics, dict) else {}
            return WarmUp(step, first_s, None, metrics)
        except Exception as error:
            problem = describe_failure(error)
        self.clear_failed_step()
        return WarmUp(None, None, problem)

    def clear_failed_step(self) -> None:
        """Release the gradients and the memory of a step that failed."""
        attributes = vars(self)  # a cached property that was not used is missing
        modules = [attributes["model"]] if "model" in attributes else []
        modules += [attributes[name].predictor for name in (OFFICIAL, OFFICIAL_FULL) if name in attributes]
        for module in modules:
            module.zero_grad(set_to_none=True)
        release_memory(self.options.device)

    def keep_only(self, variant: str) -> None:
        """Delete the models that a variant does not need; its step must have been created."""
        self._weights = None
        needed = variant if variant in {OFFICIAL, OFFICIAL_FULL} else "model"
        for name in {"model", OFFICIAL, OFFICIAL_FULL} - {needed}:
            vars(self).pop(name, None)

    def _model(self) -> WorldModel:
        model = random_model(self.sizes, self.dtype, self.device)
        if has_checkout(self.options):  # both models have values that `dtype` can represent
            official = to_official(model)
            self._weights = {part: _cast_weights(official[part], self.dtype) for part in ("encoder", "predictor")}
        add_random_adapter(model)
        return model

    def _draw(self, shape: tuple[int, ...]) -> Tensor:
        return torch.randn(shape, generator=torch.Generator(self.device).manual_seed(0), device=self.device)

    def _accelerator(self, config: Config) -> Accelerator:
        return make_accelerator(config)

    def _build_official(self, *, is_full: bool = False) -> OfficialStep:
        _ = self.model  # building it sets `_weights`
        assert self._weights is not None, "no checkout"
        config = self.config(Setting(max(self.options.frames), 1, checkpointing=False))
        return self._official_class(
            self.options.official, self._weights, self.sizes, None if is_full else config.adapter, config.training,
            frames=max(self.options.frames), encoder="pixels" in self.options.source, device=self.device,
        )  # fmt: skip

    def run(self, setting: Setting, *, graph: bool = False) -> Run:
        """Return the run that `training_step` needs."""
        config = self.config(setting, graph=graph)
        return Run(
            config=config,
            accelerator=self._accelerator(config),
            world_model=self.model,
            objective=Objective(self.model, config.training),
            micro_step=GraphedMicroStep() if graph else micro_step,
            optimizer=make_optimizer(self.model, config.training),
            scaler=torch.amp.GradScaler(self.device.type, enabled=False),
            dataset=Dataset.__new__(Dataset),  # never opened, because the batches are random
            state=RunState(step=0),
            micro_batches=1,
        )

    def latents(self, setting: Setting) -> LatentBatch:
        """Return random clips."""
        tokens = (self.sizes.image_size // self.sizes.patch_size) ** 2
        shape = (setting.batch, setting.frames, tokens, self.sizes.encoder.width)
        latents = layer_norm(self._draw(shape), shape[-1:])
        states, actions = (value.to(self.device) for value in _states_and_actions(setting))
        return LatentBatch(latents, states, actions, None, ("a",) * setting.batch, (0,) * setting.batch)

    def batch(self, setting: Setting) -> Batch:
        """Return the same clips as a batch of the loader; for cached latents with images of one pixel."""
        side = self.options.image_size if setting.encoder else 1
        shape = (setting.batch, setting.frames, side, side, 3)
        frames = torch.randint(256, shape, dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
        states, actions = _states_and_actions(setting)
        batch = Batch(frames, states, actions, None, ("a",) * setting.batch, (0,) * setting.batch)
        # The copy to the device is part of the step. The fake GPU does not support pinned memory.
        return batch.pin_memory() if self.device.type == "cuda" and torch.cuda.is_available() else batch


def _states_and_actions(setting: Setting) -> tuple[Tensor, Tensor]:
    """Return random poses and their differences: [batch, time, 7] and [batch, time-1, 7]."""
    generator = torch.Generator().manual_seed(1)
    poses = torch.randn(setting.batch, setting.frames, 7, generator=generator) * 0.3
    return poses, poses[:, 1:] - poses[:, :-1]


def _cast_weights(weights: Mapping[str, Tensor], dtype: torch.dtype) -> dict[str, Tensor]:
    return {name: value.to(dtype) for name, value in weights.items()}
