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
from memory import let_go
from official_predictor import PREDICTOR, Official, difference
from random_models import add_random_adapter, random_model
from rows import problem_of
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
OFFICIAL_FULL = "official_full"  # every weight of its predictor is trained
COMPILED, GRAPH = "+compile", "+graph"  # at the end of a way of ours, in this order
PRECISIONS = {"float32": "fp32", "bfloat16": "bf16"}
_NEXT_TO_NOTHING = 1e-30  # as fast as any learning rate, and every step has the loss and the gradients of the first
_PAST_WARM_UP = 1001  # a step at which the learning rate is what it mostly is


@dataclass(frozen=True)
class Setting:
    """What a line is about."""

    frames: int
    batch: int
    checkpointing: bool
    encoder: bool = False  # whether latents are computed in the step


@dataclass(frozen=True)
class Started:
    """A way that has done its first steps, or what came in between."""

    step: Callable[[], object] | None
    first_s: float | None
    problem: str | None
    found: dict[str, float] = field(default_factory=dict)  # loss and norm of the gradients; none of an official way


def our_ways(attention: Sequence[str], *, compiled: bool) -> list[str]:
    """Return ways of ours: kinds of attention, each once more compiled, if that is asked for."""
    return [*attention, *(way + COMPILED for way in attention if compiled)]


def take_way(model: WorldModel, way: str) -> None:
    """Let a model train in one of our ways."""
    model.set_attention(way.split("+", maxsplit=1)[0])  # type: ignore[arg-type]  # checked when it is used
    model.set_compiled("with gradients" if COMPILED in way else "never")


def has_checkout(options: argparse.Namespace) -> bool:
    """Return whether the official code is where it is looked for."""
    return bool((options.official / PREDICTOR).is_file())


class Bench:
    """Our model and the official one in one precision, with the same weights; neither is there until it is needed."""

    _kind_of_official = Official

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
        self._weights: dict[str, Any] | None = None  # where the official code is to get them

    @cached_property
    def model(self) -> WorldModel:
        """Ours, in float32 until its first step."""
        return self._model().train()

    @cached_property
    def official(self) -> Official:
        """The official step; to be asked for before ours takes its own type."""
        return self._official()

    @cached_property
    def official_full(self) -> Official:
        """The same, trained whole, as it is released; made when it is first timed, for it needs 5 GB."""
        return self._official(whole=True)

    def compare(self) -> str | None:
        """Return how the official predictor's loss and gradients differ from ours, on a short clip, in float32.

        Its convolution, too: PyTorch rounds those to TF32 on CUDA unless told otherwise.
        """
        with torch.backends.cudnn.flags(allow_tf32=False):
            return self._compared()

    def _compared(self) -> str | None:
        setting = Setting(
            min(max(4, self.options.rollout_steps + 1), *self.options.frames), 1, False, "pixels" in self.options.source
        )
        objective = Objective(self.model, self.config(setting).training)
        latents = self.latents(setting)
        if setting.encoder:
            pixels = pixels_to_input(self.frames(setting), self.options.image_size)
            gap = (self.model.encode(pixels) - self.official.encode(pixels.transpose(1, 2))).abs().max()
            if not gap < 1e-3:  # of values of variance 1
                return f"latents differ by {float(gap):.2g}"
        return difference(objective, self.official, latents)

    def frames(self, setting: Setting) -> Tensor:
        """Return the frames of a batch, on the device."""
        frames = self.batch(setting).frames
        if frames is None:
            raise ValueError("a batch of latents")
        return frames.to(self.device)

    def config(self, setting: Setting, *, whole: bool = False, graph: bool = False) -> Config:
        """Return what a run of a setting is (`whole`: without an adapter); its data and base are never opened."""
        options = self.options
        return Config(
            run_dir="benchmark",
            data=DataConfig(path="none", frames=setting.frames, source="rlds" if setting.encoder else "latents"),
            adapter=AdapterConfig(kind="none" if whole else "lora"),
            model=ModelConfig(base="none", dtype="bfloat16" if self.precision == "bf16" else "float32"),
            training=TrainingConfig(
                batch_size=setting.batch, accumulation=1, rollout_steps=options.rollout_steps,
                learning_rate=_NEXT_TO_NOTHING, cuda_graph=graph,
                device="cpu" if self.device.type == "cpu" else "cuda",
                precision="bf16" if self.precision == "bf16" else "fp32", gradient_checkpointing=setting.checkpointing,
            ),
        )  # fmt: skip

    def flops_per_clip(self, setting: Setting, way: str = "") -> int:
        """Return the model FLOPs of a clip."""
        flops = clip_flops(self.config(setting, whole=way == OFFICIAL_FULL), self.sizes)
        return flops.total if setting.encoder else flops.predictor

    def estimated_gb(self, setting: Setting) -> float:
        """Return what `doctor` says of the run's GPU memory, less what it allows for and PyTorch does not count."""
        config = self.config(setting)
        config = config.model_copy(update={"validation": config.validation.model_copy(update={"batch_size": 1})})
        estimate = estimate_memory(config, self.sizes)
        return (estimate.total(checkpointing=setting.checkpointing) - ALLOWANCE) / 1e9

    def step(self, setting: Setting, way: str) -> Callable[[], object]:
        """Return what does one optimizer step and waits for it: an official one, or ours with a kind of attention."""
        latents, pixels = self.latents(setting), None
        if way in {OFFICIAL, OFFICIAL_FULL}:
            if setting.encoder:
                frames = self.frames(setting)
                pixels = pixels_to_input(frames, self.options.image_size).transpose(1, 2).contiguous()
            official = self.official if way == OFFICIAL else self.official_full
            return partial(
                official.step, latents, pixels, self.dtype, checkpointing=setting.checkpointing
            )  # it waits for its loss, as it does in training
        for parameter in self.model.parameters():
            if not parameter.requires_grad:
                parameter.data = parameter.data.to(self.dtype)
        run, batches = self.run(setting, graph=way.endswith(GRAPH)), itertools.repeat(self.batch(setting))
        return partial(self._our_step, run, batches, None if setting.encoder else latents, way)

    def _our_step(self, run: Run, batches: Any, latents: LatentBatch | None, way: str) -> dict[str, float]:
        take_way(self.model, way)
        self.model.set_gradient_checkpointing(run.config.training.gradient_checkpointing)
        if latents is None:
            return training_step(run, batches, step=_PAST_WARM_UP)
        with mock.patch("vjepa2_ac.training.step.encode", return_value=latents):  # they are there already
            return training_step(run, batches, step=_PAST_WARM_UP)

    def start(self, setting: Setting, way: str) -> Started:
        """Do the first two steps of a way: what is compiled is compiled here, and what does not fit shows."""
        began = time.perf_counter()
        try:
            step = self.step(setting, way)
            step()
            first_s = time.perf_counter() - began
            metrics = step()  # what is compiled for the second time
            found = {name: metrics[name] for name in ("loss", "grad_norm")} if isinstance(metrics, dict) else {}
            return Started(step, first_s, None, found)
        except Exception as error:
            problem = problem_of(error)
        self.let_go_of_a_step()
        return Started(None, None, problem)

    def let_go_of_a_step(self) -> None:
        """Let go of what a step has left that did not end."""
        there = vars(self)
        modules = [there["model"]] if "model" in there else []
        modules += [there[name].predictor for name in (OFFICIAL, OFFICIAL_FULL) if name in there]
        for module in modules:
            module.zero_grad(set_to_none=True)
        let_go(self.options.device)

    def keep_only(self, way: str) -> None:
        """Let go of what a way does not need, once its step is there."""
        self._weights = None
        kept = way if way in {OFFICIAL, OFFICIAL_FULL} else "model"
        for name in {"model", OFFICIAL, OFFICIAL_FULL} - {kept}:
            vars(self).pop(name, None)

    def _model(self) -> WorldModel:
        model = random_model(self.sizes, self.dtype, self.device)
        if has_checkout(self.options):  # in half the memory; both keep the same
            official = to_official(model)
            self._weights = {part: _in_type(official[part], self.dtype) for part in ("encoder", "predictor")}
        add_random_adapter(model)
        return model

    def _drawn(self, shape: tuple[int, ...]) -> Tensor:
        return torch.randn(shape, generator=torch.Generator(self.device).manual_seed(0), device=self.device)

    def _accelerator(self, config: Config) -> Accelerator:
        return make_accelerator(config)

    def _official(self, *, whole: bool = False) -> Official:
        _ = self.model  # which gives the weights
        assert self._weights is not None, "no checkout"
        config = self.config(Setting(max(self.options.frames), 1, checkpointing=False))
        return self._kind_of_official(
            self.options.official, self._weights, self.sizes, None if whole else config.adapter, config.training,
            frames=max(self.options.frames), encoder="pixels" in self.options.source, device=self.device,
        )  # fmt: skip

    def run(self, setting: Setting, *, graph: bool = False) -> Run:
        """Return the run that `training_step` works on."""
        config = self.config(setting, graph=graph)
        return Run(
            config=config,
            accelerator=self._accelerator(config),
            world_model=self.model,
            objective=Objective(self.model, config.training),
            micro_step=GraphedMicroStep() if graph else micro_step,
            optimizer=make_optimizer(self.model, config.training),
            scaler=torch.amp.GradScaler(self.device.type, enabled=False),
            dataset=Dataset.__new__(Dataset),  # never opened: batches are given
            state=RunState(step=0),
            micro_batches=1,
        )

    def latents(self, setting: Setting) -> LatentBatch:
        """Return random clips."""
        tokens = (self.sizes.image_size // self.sizes.patch_size) ** 2
        shape = (setting.batch, setting.frames, tokens, self.sizes.encoder.width)
        drawn = layer_norm(self._drawn(shape), shape[-1:])
        states, actions = (value.to(self.device) for value in _states_and_actions(setting))
        return LatentBatch(drawn, states, actions, None, ("a",) * setting.batch, (0,) * setting.batch)

    def batch(self, setting: Setting) -> Batch:
        """Return the same clips as the loader gives them; without pixels where nobody looks at them."""
        side = self.options.image_size if setting.encoder else 1
        shape = (setting.batch, setting.frames, side, side, 3)
        frames = torch.randint(256, shape, dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
        states, actions = _states_and_actions(setting)
        batch = Batch(frames, states, actions, None, ("a",) * setting.batch, (0,) * setting.batch)
        # Its way to the device is part of the step. A device that is but imagined pins nothing.
        return batch.pin_memory() if self.device.type == "cuda" and torch.cuda.is_available() else batch


def _states_and_actions(setting: Setting) -> tuple[Tensor, Tensor]:
    """Return poses of random clips and the steps between them: [batch, time, 7] and [batch, time-1, 7]."""
    generator = torch.Generator().manual_seed(1)
    poses = torch.randn(setting.batch, setting.frames, 7, generator=generator) * 0.3
    return poses, poses[:, 1:] - poses[:, :-1]


def _in_type(weights: Mapping[str, Tensor], dtype: torch.dtype) -> dict[str, Tensor]:
    return {name: value.to(dtype) for name, value in weights.items()}
