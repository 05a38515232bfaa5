"""What is done on a fake GPU? Our training step, encoder and decision as the other benchmarks do them."""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import decision_ways
import planning_variants
import torch
import train_step_variants
from count import Count
from official_predictor import Official
from random_models import no_fingerprints
from stand_ins import FAKE, no_fake_gpu
from torch import Tensor, nn
from torch.utils._python_dispatch import _disable_current_modes

from vjepa2_ac.config import AdapterConfig, AugmentConfig, Config, DecoderConfig, ModelSizes
from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.data.transforms import draw
from vjepa2_ac.decoding.frame_pairs import Pairs
from vjepa2_ac.decoding.network import Decoder, DecoderShape
from vjepa2_ac.decoding.steps import DecoderSteps
from vjepa2_ac.episode import Batch
from vjepa2_ac.model.adapter.lora import add_adapter
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.planning.planner import Cost, Plan, Planner
from vjepa2_ac.training.cost.flops import frame_flops
from vjepa2_ac.training.cost.memory import ALLOWANCE, estimate_memory

OFFICIALS = (train_step_variants.OFFICIAL_FULL, train_step_variants.OFFICIAL)
_AUGMENT = AugmentConfig(crop_scale=(0.3, 1.0), brightness=0.4, contrast=0.4, saturation=0.4)
_PATCH = 16  # pixels
_ITERATIONS = 2  # of a decision that are computed: all after the first are alike
Doing = Callable[[Count], object]


@dataclass(frozen=True)
class Work:
    """Something to do once to warm up, and then once to be counted."""

    name: str
    settings: dict[str, Any]
    flops: int  # that the mathematics asks for
    do: Doing
    doctor_gb: float | None = None  # what `doctor` says that it needs, less its allowance
    warm_up: Doing | None = None  # None: the same


class _ImaginedOfficial(Official):
    """The official step; no scaler of gradients, which would see no numbers."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self._scaler = torch.amp.GradScaler("cuda", enabled=False)

    def _built(self, build: Callable[[], nn.Module]) -> nn.Module:
        return build()  # on the host: there is no device

    def _load(self, module: nn.Module, weights: Mapping[str, Any], part: str) -> None:
        """Leave it as it is: there are no numbers."""

    def _placed(self, module: nn.Module) -> nn.Module:
        with FAKE:
            return imagined(module, torch.float32)


class _Steps(train_step_variants.Bench):
    _kind_of_official = _ImaginedOfficial

    def _model(self) -> WorldModel:
        self._weights = {}  # without numbers
        pixels = "pixels" in self.options.source
        return imagined_model(self.sizes, self.dtype, AdapterConfig(), encoder=pixels)

    def _drawn(self, shape: tuple[int, ...]) -> Tensor:
        return torch.empty(shape, device=self.device)

    def batch(self, setting: train_step_variants.Setting) -> Batch:
        batch = super().batch(setting)
        if not (self.options.augment and setting.encoder) or batch.frames is None:
            return batch
        sizes, clips = batch.frames.shape[2:4], range(setting.batch)
        drawn = (draw(_AUGMENT, *sizes, seed=0, position=clip) for clip in clips)
        return replace(batch, augmentations=tuple(one for one in drawn if one is not None))

    def _accelerator(self, config: Config) -> Any:  # noqa: ARG002  # Accelerate's own asks the driver
        return SimpleNamespace(
            device=self.device, process_index=0, num_processes=1,
            autocast=lambda: torch.autocast("cuda", self.dtype, enabled=self.dtype != torch.float32),
        )  # fmt: skip

    def _official(self, *, whole: bool = False) -> Official:
        with _disable_current_modes():
            return super()._official(whole=whole)


class _Decisions(planning_variants.Bench):
    count: Count

    def _model(self) -> WorldModel:
        return imagined_model(self.sizes, self.dtype)

    def _adapted(self) -> WorldModel:
        model = imagined_model(self.sizes, self.dtype, AdapterConfig())
        model.requires_grad_(False)
        return model

    def _plan(self, config: PlanningConfig, cost: Cost) -> Plan:
        """Search as ever, with numbers; energies are drawn. What follows the first iteration counts for all others."""

        def energies(actions: Tensor) -> Tensor:
            with FAKE, self.count:
                cost(FAKE.from_tensor(actions))
            return torch.rand(len(actions))

        def iterated(done: int, of: int) -> None:
            if done:
                self.count.times = 1.0 if done == of else float(self.options.iterations - 1)

        with _disable_current_modes():
            return Planner(config, progress=iterated).plan(energies, torch.Generator().manual_seed(0))


def training(options: argparse.Namespace) -> Iterator[Callable[[int], Work]]:
    """Yield for each setting what makes a training step of a batch."""
    for source in options.source:
        bench = _Steps(argparse.Namespace(**vars(options) | {"source": [source]}), options.dtype)
        ways = [*options.attention, *(OFFICIALS if train_step_variants.has_checkout(options) else ())]
        for frames, again, way in itertools.product(options.frames, options.checkpointing, ways):
            yield partial(_step, bench, train_step_variants.Setting(frames, 1, again == "on", source == "pixels"), way)


def encoding(options: argparse.Namespace) -> Iterator[Work]:
    """Yield the encoder on so many frames at once."""
    bench = _Steps(argparse.Namespace(**vars(options) | {"source": ["pixels"], "layers": 1}), options.dtype)
    for frames in options.batch:
        yield _encoding(bench, frames)


def decoding(options: argparse.Namespace) -> Iterator[Work]:
    """Yield a training step of a decoder for each size and number of frames."""
    grid = options.image_size // _PATCH
    for size, frames in itertools.product(options.size, options.batch):
        shape = DecoderShape(size, options.latent_dim, grid, _PATCH)
        knobs = DecoderConfig(size=size, batch_size=frames)
        kind = getattr(torch, options.dtype)
        arithmetic = partial(torch.autocast, "cuda", dtype=kind, enabled=kind != torch.float32)
        with patch.object(Decoder, "initialise"):  # numbers are not drawn on fake tensors
            steps = DecoderSteps(shape, knobs, 0, torch.device("cuda"), arithmetic, None)
        latents = torch.empty(frames, grid**2, options.latent_dim, device="cuda")
        images = torch.empty(frames, 3, shape.image_size, shape.image_size, dtype=torch.uint8, device="cuda")
        pairs = Pairs(latents, images, ())
        name = f"{size} decoder, {frames} frames"
        yield Work(name, {"size": size, "batch": frames}, 0, partial(_decoder_step, steps, pairs))


def _decoder_step(steps: DecoderSteps, pairs: Pairs, _bench: object) -> None:
    steps.do(1, pairs)


def planning(options: argparse.Namespace) -> Iterator[Work]:
    """Yield a whole decision for each horizon and number of samples at once."""
    bench = _Decisions(options, options.dtype)
    for horizon, at_once in itertools.product(options.horizon, options.at_once):
        for adapter in (False, True) if options.adapter else (False,):
            yield _decision(bench, horizon, decision_ways.Way.ours(at_once, adapter=adapter))


def _step(bench: _Steps, setting: train_step_variants.Setting, way: str, batch: int) -> Work:
    setting = replace(setting, batch=batch)
    step = bench.step(setting, way)
    source, again = "pixels" if setting.encoder else "cache", "on" if setting.checkpointing else "off"
    with no_fake_gpu():
        flops = batch * bench.flops_per_clip(setting, way)
        doctor_gb = None if way in OFFICIALS else bench.estimated_gb(setting)
    return Work(
        f"{source}, {setting.frames} frames, batch {batch}, checkpointing {again}, {way}",
        {"source": source, "frames": setting.frames, "batch": batch, "checkpointing": again, "attention": way},
        flops,
        lambda _: step(),
        doctor_gb,
    )


def _encoding(bench: _Steps, frames: int) -> Work:
    shortest = bench.options.rollout_steps + 1  # of a clip, which is what doctor knows of
    config = bench.config(train_step_variants.Setting(max(shortest, frames), 1, checkpointing=False, encoder=True))
    config = config.model_copy(update={"model": config.model.model_copy(update={"encode_chunk": frames})})
    with no_fake_gpu():
        estimate, flops = estimate_memory(config, bench.sizes), frames * frame_flops(bench.sizes)
    pixels = torch.empty(1, frames, 3, bench.sizes.image_size, bench.sizes.image_size, device="cuda")
    model = bench.model

    def encode(_: Count) -> None:
        with bench._accelerator(config).autocast():
            model.encode(pixels, frames)

    estimated = (estimate.encoder_weights + estimate.encoding) / 1e9 if frames >= shortest else None
    return Work(f"{frames} frames", {"batch": frames}, flops, encode, estimated)


def _decision(bench: _Decisions, horizon: int, way: decision_ways.Way) -> Work:
    samples, iterations, at_once = bench.options.samples, bench.options.iterations, way.at_once
    if way.has_adapter:
        _ = bench.adapted  # what loading it takes is not counted

    with no_fake_gpu():
        flops = bench.flops(horizon)

    def decide(count: Count, samples: int = samples, iterations: int = min(_ITERATIONS, iterations)) -> None:
        bench.count = count
        config = bench.config(horizon, at_once=at_once, samples=samples, iterations=iterations)
        with torch.no_grad():
            bench._decide(way, config, bench.dtype)

    return Work(
        f"horizon {horizon}, {samples} samples x {iterations}, {at_once} at once{', adapter' * way.has_adapter}",
        {
            "horizon": horizon, "samples": samples, "iterations": iterations, "at_once": at_once,
            "adapter": way.has_adapter,
        },
        flops,
        decide,
        warm_up=lambda count: decide(count, min(samples, at_once), 1),
    )  # fmt: skip


def imagined_model(
    sizes: ModelSizes, dtype: torch.dtype, adapter: AdapterConfig | None = None, *, encoder: bool = False
) -> WorldModel:
    """Return a model on the fake GPU: frozen weights in a type, what is trained in float32.

    It is made without memory, and its weights are replaced then: `Module.to` cannot replace fake ones.
    """
    with _disable_current_modes(), no_fingerprints(), torch.device("meta"):
        model = WorldModel.empty(sizes)
        if adapter is not None:
            add_adapter(model, adapter, seed=0)
        if not encoder:
            model.set_encoder_aside()
    imagined(model, dtype)
    assert not list(model.buffers())
    return model


def imagined(module: nn.Module, frozen: torch.dtype) -> nn.Module:
    """Replace the weights of a module by ones on the fake GPU; other tensors that it holds stay on the host."""
    for part in module.modules():
        for name, old in part._parameters.items():
            if old is not None:
                new = torch.empty(old.shape, dtype=torch.float32 if old.requires_grad else frozen, device="cuda")
                part._parameters[name] = nn.Parameter(new, old.requires_grad)
        for name, value in vars(part).items():
            if isinstance(value, Tensor):
                setattr(part, name, torch.empty(value.shape, dtype=value.dtype))
    return module


def largest_batch(peak_gb: Callable[[int], float], cap_gb: float) -> int:
    """Return the largest batch that fits, with doctor's allowance for what is not counted; 0 where none does."""
    room = cap_gb - ALLOWANCE / 1e9
    peaks = {1: peak_gb(1), 2: peak_gb(2)}
    while True:
        fits = max((batch for batch, peak in peaks.items() if peak <= room), default=0)
        too_large = min((batch for batch, peak in peaks.items() if peak > room), default=math.inf)
        if too_large == fits + 1:
            return fits
        one, other = sorted(peaks, key=lambda batch: abs(peaks[batch] - room))[:2]
        guess = one + math.floor((room - peaks[one]) / (peaks[other] - peaks[one]) * (other - one))
        tried = int(min(max(guess, fits + 1), too_large - 1))
        peaks[tried] = peak_gb(tried)
