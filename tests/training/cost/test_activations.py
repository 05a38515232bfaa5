"""Predicted activation memory equals what PyTorch saves on a CPU: part by part, with each part dominant in turn."""

import contextlib
import weakref
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

from sized_runs import LORA, built, model_sizes, run_config
from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model.network.kv_cache import KeyValueCache
from vjepa2_ac.model.network.rotary import TokenLayout, rotary_tables
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.training.cost.activations import Activations
from vjepa2_ac.training.cost.block_activations import Setting, adapter_casts, block_bytes
from vjepa2_ac.training.loss import LOSSES, Distance, prediction_losses

TOLERANCE = 0.015


def distance_of(config: Config) -> Distance:
    return LOSSES[config.training.loss](config.training)


class Held:
    """A tensor for as long as autograd keeps it."""

    def __init__(self, tensor: Tensor) -> None:
        self.tensor = tensor


class Keeping(torch.autograd.graph.saved_tensors_hooks):
    """Counts the bytes that autograd saves, each storage once, without existing tensors such as weights."""

    def __init__(self, known: Iterable[Tensor]) -> None:
        self.held: weakref.WeakSet[Held] = weakref.WeakSet()
        self.known = {value.untyped_storage().data_ptr() for value in known}
        super().__init__(self._pack, lambda held: held.tensor)

    def _pack(self, saved: Tensor) -> Held:
        held = Held(saved)
        self.held.add(held)
        return held

    @property
    def bytes(self) -> int:
        storages = [held.tensor.untyped_storage() for held in self.held]
        sizes = {storage.data_ptr(): storage.nbytes() for storage in storages}
        return sum(size for place, size in sizes.items() if place not in self.known)


@dataclass(frozen=True)
class Measured:
    teacher_forcing: int
    rollout: int
    losses: int


def arithmetic(config: Config) -> Any:
    types = {"bf16": torch.bfloat16, "fp16": torch.float16}
    precision = config.training.precision
    return torch.autocast("cpu", types[precision]) if precision in types else contextlib.nullcontext()


def clips(config: Config, model: WorldModel) -> LatentBatch:
    batch, frames = config.training.batch_size, config.data.frames
    cameras = torch.randn(batch, frames, 6) if model.sizes.predictor.use_extrinsics else None
    latents = torch.randn(batch, frames, model.num_tokens, model.latent_dim)
    poses = torch.randn(batch, frames, 7)
    return LatentBatch(latents, poses, poses[:, 1:].clone(), cameras, ("a",) * batch, (0,) * batch)


def known(model: WorldModel, batch: LatentBatch) -> list[Tensor]:
    given = [batch.latents, batch.states, batch.actions]
    return [*model.parameters(), *given, *([] if batch.extrinsics is None else [batch.extrinsics])]


def measured_parts(config: Config, sizes: ModelSizes) -> Measured:
    """Measure teacher forcing, the rollout after it, and the losses, each on its own."""
    model = built(config, sizes)
    batch, steps, distance = (
        clips(config, model),
        config.training.rollout_steps,
        LOSSES[config.training.loss](config.training),
    )
    cameras = None if batch.extrinsics is None else batch.extrinsics[:, :-1]
    forcing, rolling, losing = (Keeping(known(model, batch)) for _ in range(3))
    cache, rest = KeyValueCache(), slice(1, steps)
    with arithmetic(config):
        with forcing:
            forced = model.predict(batch.latents[:, :-1], batch.actions, batch.states[:, :-1], cameras, cache, keep=1)
        with rolling:
            later = None if cameras is None else cameras[:, rest]
            further = model.rollout(forced[:, :1], batch.actions[:, rest], batch.states[:, rest], later, cache)
        rolled = torch.cat([forced[:, :1], further], dim=1)
        with losing:
            pairs = (forced, batch.latents[:, 1:]), (rolled, batch.latents[:, 1 : steps + 1])
            losses = [distance(*pair).mean() for pair in pairs]
        measured = Measured(forcing.bytes, rolling.bytes, losing.bytes)
    assert all(loss.requires_grad for loss in losses)  # until here everything was needed
    return measured


def measured_whole(config: Config, sizes: ModelSizes) -> int:
    model = built(config, sizes)
    batch = clips(config, model)
    keeping = Keeping(known(model, batch))
    with arithmetic(config), keeping:
        losses = prediction_losses(model, batch, config.training.rollout_steps, distance_of(config))
    kept = keeping.bytes
    losses.total.backward()
    assert keeping.bytes == 0
    return kept


def assert_same(estimate: int, measured: int) -> None:
    assert estimate == pytest.approx(measured, rel=TOLERANCE)


ENDS = ["predictor_embed", "predictor_proj", "action_encoder", "state_encoder"]
MLP_ONLY, ALL = {**LORA, "targets": ["mlp"]}, {**LORA, "targets": ["all"]}
FP32 = {"training__precision": "fp32", "model__dtype": "float32"}
FLOAT32_BASE = {"model__dtype": "float32"}
FEW_TOKENS = model_sizes(latent=12, width=96, image=16)
LITTLE_MLP = model_sizes(latent=12, width=96, mlp=0.25)
# name: sizes, adapter, changes. Each makes another term the largest.
DOMINANT: dict[str, tuple[ModelSizes, dict[str, Any], dict[str, Any]]] = {
    "query, key, value and output": (LITTLE_MLP, {**LORA, "targets": ["fc1"], "dropout": 0.0}, {}),
    "log-sum-exp": (model_sizes(latent=12, heads=8, mlp=0.25), {**LORA, "targets": ["fc1"], "dropout": 0.0}, {}),
    "norms": (model_sizes(latent=12, width=96, mlp=0.25), {**LORA, "targets": ["fc1"], "dropout": 0.0}, FP32),
    "GELU": (model_sizes(latent=12, mlp=16.0), {**LORA, "targets": ["q"]}, {}),
    "inputs of adapters": (model_sizes(mlp=16.0), {**LORA, "targets": ["fc2"], "dropout": 0.0}, {}),
    "masks": (model_sizes(mlp=16.0), {**LORA, "targets": ["fc2"]}, {}),
    "ranks": (model_sizes(width=12, depth=3), {"rank": 96}, {}),
    "a rank by pattern": (model_sizes(width=12), {**LORA, "rank_pattern": {"fc1": 96, "blocks.0.attn.q": 64}}, {}),
    "trained matrices, cast": (model_sizes(latent=12, width=96, depth=8, image=16), {"rank": 96}, {"data__frames": 4}),
    "predictions and losses": (model_sizes(latent=960, width=12, depth=1), LORA, {"training__rollout_steps": 5}),
    "adapters of the heads": (model_sizes(latent=960, width=48, depth=1), ALL, {}),
    "keys and values of the rollout": (LITTLE_MLP, {**LORA, "targets": ["fc1"], "dropout": 0.0},
                                       {"data__frames": 10, "training__rollout_steps": 9}),
    "outputs that DoRA keeps": (model_sizes(mlp=8.0), {"rank": 1, "dora": True, "dropout": 0.0}, {}),
    "weights that DoRA copies": (FEW_TOKENS, {"rank": 1, "dora": True}, {"data__frames": 4}),
    "frozen weights, cast": (FEW_TOKENS, LORA, {"data__frames": 4, **FLOAT32_BASE}),
    "trained weights, cast": (FEW_TOKENS, {"kind": "none"}, {"data__frames": 4}),
}  # fmt: skip
OTHER: dict[str, tuple[ModelSizes, dict[str, Any], dict[str, Any]]] = {
    "fp16": (model_sizes(), LORA, {"training__precision": "fp16", **FLOAT32_BASE}),  # over bfloat16: CUDA only
    "fp32": (model_sizes(), LORA, FP32),
    "fp32, no dropout": (model_sizes(), {**LORA, "dropout": 0.0}, FP32),
    "DoRA over float32, no dropout": (model_sizes(), {**LORA, "dora": True, "dropout": 0.0}, FLOAT32_BASE),
    "DoRA in fp32": (model_sizes(), {**LORA, "dora": True}, FP32),
    "PiSSA": (model_sizes(), {**LORA, "init": "pissa"}, {}),
    "heads trained whole": (model_sizes(), {**LORA, "modules_to_save": ["action_encoder", "state_encoder"]}, {}),
    "input and output trained whole": (model_sizes(), {**LORA, "modules_to_save": ENDS}, {}),
    "output trained whole, fp32": (model_sizes(), {**LORA, "modules_to_save": ENDS[1:2]}, FP32),
    "extrinsics": (model_sizes(extrinsics=True), ALL, {}),
    "MLP only": (model_sizes(), MLP_ONLY, {}),
    "attention only": (model_sizes(), {**LORA, "targets": ["attention"]}, {}),
    "L2": (model_sizes(latent=480), LORA, {"training__loss": "l2"}),
    "everything": (model_sizes(), {"kind": "none"}, {}),
    "everything in fp32": (model_sizes(), {"kind": "none"}, FP32),
}
CASES = DOMINANT | OTHER


def case(name: str, **changes: Any) -> tuple[Config, ModelSizes]:
    sizes, adapter, own = CASES[name]
    return run_config(adapter, **{"training__rollout_steps": 3, **own, **changes}), sizes


@pytest.mark.parametrize("name", CASES)
def test_each_part_is_what_autograd_keeps_of_it(name: str) -> None:
    config, sizes = case(name)
    kept, measured = Activations(config, sizes, "cpu"), measured_parts(config, sizes)
    assert_same(kept.teacher_forcing() + kept.cast_cache(), measured.teacher_forcing)
    assert_same(kept.rollout() + kept.cast_cache(), measured.rollout)
    assert kept.losses() == measured.losses


@pytest.mark.parametrize("name", ["fp32", "heads trained whole", "input and output trained whole", "everything"])
def test_all_parts_together_are_what_autograd_keeps_of_the_losses(name: str) -> None:
    config, sizes = case(name)
    assert_same(Activations(config, sizes, "cpu").without_checkpointing(), measured_whole(config, sizes))


@pytest.mark.parametrize("name", CASES)
def test_what_checkpointing_leaves_is_what_autograd_keeps(name: str) -> None:
    config, sizes = case(name, training__gradient_checkpointing=True)
    kept = Activations(config, sizes, "cpu")
    assert_same(kept.after_forward(), measured_whole(config, sizes))


@pytest.mark.parametrize("name", DOMINANT)
def test_a_block_that_is_computed_again_is_what_autograd_keeps_of_it(name: str) -> None:
    config, sizes = case(name)
    model, setting = built(config, sizes), Setting(config, sizes, "cpu")
    conditions = 2 + sizes.predictor.use_extrinsics
    layout = TokenLayout(config.data.frames - 1, model.base_predictor.grid, conditions)
    tables = rotary_tables(layout, sizes.predictor.width // sizes.predictor.heads, torch.device("cpu"))
    number = {2: torch.bfloat16 if config.training.precision == "bf16" else torch.float16, 4: torch.float32}
    tokens = torch.randn(config.training.batch_size, layout.length, setting.width, dtype=number[setting.number])
    keeping = Keeping([*model.parameters(), *tables])
    with arithmetic(config), keeping:
        output = model.base_predictor.blocks[0](tokens.requires_grad_(), tables, layout.tokens_per_step)
    casts = sum(adapter_casts(setting, layer) for layer in setting.layers if layer.startswith("blocks.0."))
    assert_same(block_bytes(setting, 0, config.data.frames - 1) + casts, keeping.bytes)
    assert output[0].requires_grad


def test_the_heaviest_block_is_the_one_computed_again() -> None:
    config = run_config({**LORA, "rank_pattern": {r"blocks\.1\..*": 64}})
    even, uneven = Activations(run_config(), model_sizes(), "cpu"), Activations(config, model_sizes(), "cpu")
    assert uneven.recomputed() > even.recomputed()
    heavier = Activations(run_config({**LORA, "rank": 64}), model_sizes(), "cpu")
    assert uneven.recomputed() == heavier.recomputed()


def test_nothing_is_kept_for_a_rollout_that_does_not_count() -> None:
    one = Activations(run_config(training__rollout_steps=3, training__rollout_weight=0.0), model_sizes())
    three = Activations(run_config(training__rollout_steps=3), model_sizes())
    assert one.rollout() == 0
    assert one.losses() < three.losses()
    assert one.with_checkpointing() < three.with_checkpointing()


def test_with_checkpointing_the_larger_of_both_moments_counts() -> None:
    config, sizes = case("predictions and losses", training__gradient_checkpointing=True)
    ends = Activations(config, sizes, "cpu")
    assert ends.with_checkpointing() == ends.after_forward()  # losses outweigh a block
    config, sizes = case("GELU", training__gradient_checkpointing=True)
    block = Activations(config, sizes, "cpu")
    assert block.with_checkpointing() == block._inputs() + block.recomputed() > block.after_forward()


@pytest.mark.parametrize(
    ("adapter", "changes", "copies"),
    [
        (LORA, {}, False),
        (LORA, FLOAT32_BASE, True),
        ({"kind": "none"}, {}, True),
        (LORA, FP32, False),
        ({"kind": "none"}, FP32, False),
    ],
)
def test_norms_have_a_copy_where_autocast_makes_one(
    adapter: dict[str, Any], changes: dict[str, Any], copies: bool
) -> None:
    config = run_config(adapter, **changes)
    assert Setting(config, model_sizes(), "cuda").copies_for_norms == copies
    assert not Setting(config, model_sizes(), "cpu").copies_for_norms
