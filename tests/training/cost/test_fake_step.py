"""A step on fake tensors keeps what PyTorch saves on a CPU, whatever is trained, and all of its blocks at once."""

import contextlib
import itertools
import weakref
from collections.abc import Iterable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensor

from sized_runs import LORA, built, model_sizes, run_config
from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.distributed.device import PRECISIONS
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model.adapter.lora import with_adapter
from vjepa2_ac.model.adapter.low_rank import CastMatrices
from vjepa2_ac.model.network.rotary import TokenLayout, rotary_tables
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.training.cost import step as fake_model
from vjepa2_ac.training.cost import step as fake_step
from vjepa2_ac.training.cost.step import StepBytes, measure_step
from vjepa2_ac.training.loss import Objective

TOLERANCE = 0.015
ENDS = ["predictor_embed", "predictor_proj", "action_encoder", "state_encoder"]
FLOAT32_BASE = {"model__dtype": "float32"}
KNOBS: dict[str, dict[str, Any]] = {  # of which every pair of values is tried together
    "adapter": {
        "LoRA": {**LORA, "dropout": 0.0},
        "LoRA of one layer, dropout": {**LORA, "targets": ["fc1"], "dropout": 0.1},
        "DoRA, dropout": {**LORA, "dora": True, "dropout": 0.1},
        "LoRA everywhere, heads whole": {**LORA, "targets": ["mlp", "attention"], "modules_to_save": ENDS},
        "everything": {"kind": "none"},
    },
    "arithmetic": {
        "bf16": {},
        "bf16, float32 base": FLOAT32_BASE,
        "fp16, float32 base": {**FLOAT32_BASE, "training__precision": "fp16"},  # over bfloat16: CUDA only
        "fp32": {**FLOAT32_BASE, "training__precision": "fp32"},
    },
    "sizes": {
        "small": model_sizes(),
        "wide, few tokens": model_sizes(latent=12, width=96, image=16, depth=4),
        "many heads, little MLP": model_sizes(latent=12, heads=8, mlp=0.25),
        "wide latents, extrinsics": model_sizes(latent=960, width=12, depth=1, extrinsics=True),
    },
    "loss": {
        "L1": {},
        "L2, no rollout": {"training__loss": "l2", "training__rollout_steps": 1},
        "smooth, long rollout": {"training__loss": "smooth_l1", "training__rollout_steps": 4},
    },
}


ALSO = {"no states": model_sizes(states=False)}  # which has no layer of all ENDS
WITHOUT_STATES = [
    ("LoRA", "bf16", "no states", "smooth, long rollout"),
    ("DoRA, dropout", "fp32", "no states", "L1"),
    ("everything", "bf16", "no states", "L1"),
]


def pairwise(knobs: dict[str, dict[str, Any]]) -> list[tuple[str, ...]]:
    """Return few combinations in which each two values of different knobs meet."""
    every = list(itertools.product(*knobs.values()))
    pairs = {one: set(itertools.combinations(enumerate(one), 2)) for one in every}
    left, found = set().union(*pairs.values()), []
    while left:
        found.append(max(every, key=lambda one: len(pairs[one] & left)))
        left -= pairs[found[-1]]
    return found


def case(names: tuple[str, ...], **changes: Any) -> tuple[Config, ModelSizes]:
    knobs = {**KNOBS, "sizes": KNOBS["sizes"] | ALSO}
    adapter, arithmetic, sizes, loss = (values[name] for values, name in zip(knobs.values(), names, strict=True))
    return run_config(adapter, **arithmetic, **loss, **changes), sizes


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


def clips(config: Config, model: WorldModel) -> LatentBatch:
    batch, frames = config.training.batch_size, config.data.frames
    cameras = torch.randn(batch, frames, 6) if model.sizes.predictor.use_extrinsics else None
    latents = torch.randn(batch, frames, model.num_tokens, model.latent_dim)
    poses = torch.randn(batch, frames, 7)
    return LatentBatch(latents, poses, poses[:, 1:].clone(), cameras, ("a",) * batch, (0,) * batch)


def kept_by_pytorch(config: Config, sizes: ModelSizes, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return the bytes that autograd keeps after each prediction and after the losses, as training computes them."""
    rotary_tables.cache_clear()
    model = built(config, sizes)
    batch, dtype = clips(config, model), PRECISIONS[config.training.precision]
    matrices = CastMatrices(model, dtype)
    given = [value for value in vars(batch).values() if isinstance(value, Tensor)]
    keeping, kept, predict = Keeping([*model.parameters(), *matrices._cast, *given]), [], model.predict

    def watched(*inputs: Any, **named: Any) -> Tensor:
        predicted = predict(*inputs, **named)
        kept.append(keeping.bytes)
        return predicted

    monkeypatch.setattr(model, "predict", watched)
    arithmetic = contextlib.nullcontext() if dtype == torch.float32 else torch.autocast("cpu", dtype)
    with matrices.current(), arithmetic, keeping:
        losses = sum(Objective(model, config.training)(batch))
        kept.append(keeping.bytes)
    losses.backward()
    assert keeping.bytes == 0
    return kept


@pytest.mark.parametrize("names", [*pairwise(KNOBS), *WITHOUT_STATES], ids=", ".join)
def test_each_part_is_what_autograd_keeps_of_it(names: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    config, sizes = case(names)
    step = measure_step(config, sizes, "cpu")
    kept = kept_by_pytorch(config, sizes, monkeypatch)
    first, last, all_parts = kept[0], kept[-2], kept[-1]
    assert step.stored.teacher_forcing == pytest.approx(first, rel=TOLERANCE)
    assert step.stored.rollout == pytest.approx(last - first, rel=TOLERANCE)
    assert step.stored.losses == pytest.approx(all_parts - last, rel=TOLERANCE)
    config, sizes = case(names, training__gradient_checkpointing=True)
    assert step.checkpointed.saved == pytest.approx(kept_by_pytorch(config, sizes, monkeypatch)[-1], rel=TOLERANCE)


def all_blocks(config: Config, sizes: ModelSizes, monkeypatch: pytest.MonkeyPatch) -> StepBytes:
    """Return what is measured of all blocks, none of them inferred."""
    monkeypatch.setattr(fake_step, "over_depth", lambda measure, _config, sizes: measure(sizes))
    fake_step._measured.clear()
    found = measure_step(config, sizes)
    fake_step._measured.clear()
    monkeypatch.undo()
    return found


@pytest.mark.parametrize(
    ("adapter", "rollout_steps"),
    [("LoRA", 4), ("LoRA of one layer, dropout", 2), ("DoRA, dropout", 1), ("everything", 2)],
)
def test_all_blocks_are_inferred_exactly_from_two_and_three(
    adapter: str, rollout_steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, sizes = run_config(KNOBS["adapter"][adapter], training__rollout_steps=rollout_steps), model_sizes(depth=5)
    inferred, whole = measure_step(config, sizes), all_blocks(config, sizes, monkeypatch)
    for part, other in zip(inferred[:2], whole[:2], strict=True):
        assert part[:3] == other[:3]  # what is saved, to the byte
        assert part.peak == pytest.approx(other.peak, rel=0.005)  # its place may change with depth
    assert inferred[2:] == whole[2:]


def test_ranks_of_single_blocks_are_measured_as_they_are() -> None:
    ranks = {r"blocks\.4\..*": 64}
    even, uneven = (
        measure_step(run_config({**LORA, "rank_pattern": one}), model_sizes(depth=5)) for one in ({}, ranks)
    )
    heavier = measure_step(run_config({**LORA, "rank": 64}), model_sizes(depth=5))
    assert even.stored.saved < uneven.stored.saved < heavier.stored.saved
    assert uneven.casts - even.casts == pytest.approx((heavier.casts - even.casts) / 5)


@pytest.mark.parametrize("adapter", ["LoRA", "LoRA of one layer, dropout"])
def test_plain_lora_needs_what_pefts_layers_need(adapter: str, monkeypatch: pytest.MonkeyPatch) -> None:
    config, sizes = run_config(KNOBS["adapter"][adapter]), model_sizes()
    own = measure_step(config, sizes)

    def pefts(config: Config, sizes: ModelSizes) -> torch.nn.Module:
        with torch.device("meta"):
            return with_adapter(fake_model.meta_network(sizes).requires_grad_(False), config.adapter)

    monkeypatch.setattr(fake_step, "meta_predictor", pefts)
    fake_step._measured.clear()
    assert measure_step(config, sizes) == own


def test_nothing_is_kept_for_a_rollout_that_does_not_count() -> None:
    without = measure_step(run_config(training__rollout_steps=3, training__rollout_weight=0.0), model_sizes())
    assert without.stored == measure_step(run_config(training__rollout_steps=1), model_sizes()).stored
    assert without.stored.rollout == 0


@pytest.mark.parametrize(
    ("adapter", "changes", "copies"),
    [
        (LORA, {}, False),
        (LORA, FLOAT32_BASE, True),
        ({"kind": "none"}, {}, True),
        (LORA, {**FLOAT32_BASE, "training__precision": "fp32"}, False),
    ],
)
def test_norms_have_a_float32_copy_on_cuda_where_autocast_makes_one(
    adapter: dict[str, Any], changes: dict[str, Any], copies: bool
) -> None:
    config, sizes = run_config(adapter, **changes, training__attention="per_step"), model_sizes()
    cpu, cuda = (measure_step(config, sizes, device) for device in ("cpu", "cuda"))
    assert (cuda.stored.saved > cpu.stored.saved) == copies


def test_a_mask_is_a_byte_on_cuda_and_the_size_of_a_number_on_a_cpu() -> None:
    saved = {
        (device, share): measure_step(
            run_config({**LORA, "targets": ["fc1"], "dropout": share}, training__attention="per_step"),
            model_sizes(), device,
        ).stored.teacher_forcing
        for device in ("cpu", "cuda") for share in (0.0, 0.1)
    }  # fmt: skip
    cpu, cuda = (saved[device, 0.1] - saved[device, 0.0] for device in ("cpu", "cuda"))
    assert cpu == 2 * cuda


def test_no_fake_table_is_left_for_a_run() -> None:
    layout, cpu = TokenLayout(5, 4, 2), torch.device("cpu")
    measure_step(run_config(), model_sizes(width=24, heads=1))
    assert not isinstance(rotary_tables(layout, 24, cpu).cosine, FakeTensor)
    measure_step(run_config(), model_sizes(width=24, heads=1), "cpu")
    assert not isinstance(rotary_tables(layout, 24, cpu).cosine, FakeTensor)
