"""The memory of a step on fake tensors equals that of a real step, for each kind of training."""

import contextlib
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from sized_runs import LORA, built, model_sizes, run_config
from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.distributed import PRECISIONS
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model.attention import rotary_tables
from vjepa2_ac.model.low_rank import CastMatrices
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.training import cost as cost_step
from vjepa2_ac.training.cost import LiveStorages, measure_step
from vjepa2_ac.training.step import Objective

TOLERANCE = 0.015
ENDS = ["predictor_embed", "predictor_proj", "action_encoder", "state_encoder"]
FLOAT32_BASE = {"model__dtype": "float32"}
CASES = {  # adapter, other keys, sizes
    "LoRA, fp16, smooth loss": (
        {**LORA, "dropout": 0.0},
        {**FLOAT32_BASE, "training__precision": "fp16", "training__loss": "smooth_l1", "training__rollout_steps": 4},
        model_sizes(latent=12, heads=8, mlp=0.25),
    ),
    "LoRA of one layer, L2, no rollout": (
        {**LORA, "targets": ["fc1"], "dropout": 0.1},
        {**FLOAT32_BASE, "training__loss": "l2", "training__rollout_steps": 1},
        model_sizes(latent=12, width=96, image=16, depth=4),
    ),
    "DoRA, extrinsics": (
        {**LORA, "dora": True, "dropout": 0.1}, {}, model_sizes(latent=960, width=12, depth=1, extrinsics=True),
    ),
    "LoRA everywhere, heads whole, fp32": (
        {**LORA, "targets": ["mlp", "attention"], "modules_to_save": ENDS},
        {**FLOAT32_BASE, "training__precision": "fp32"},
        model_sizes(),
    ),
    "everything, no states": (
        {"kind": "none"}, {"training__loss": "smooth_l1", "training__rollout_steps": 4}, model_sizes(states=False),
    ),
}  # fmt: skip


class StorageCounter(TorchDispatchMode):
    """Counts the bytes of real tensors that are allocated at the same time."""

    def __init__(self) -> None:
        super().__init__()
        self.storages = LiveStorages()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        outputs = func(*args, **(kwargs or {}))
        for leaf in tree_leaves(outputs):
            if isinstance(leaf, Tensor):
                self.storages.count(leaf)
        return outputs


def clips(config: Config, model: WorldModel) -> LatentBatch:
    batch, frames = config.training.batch_size, config.data.frames
    cameras = torch.randn(batch, frames, 6) if model.sizes.predictor.use_extrinsics else None
    latents = torch.randn(batch, frames, model.num_tokens, model.latent_dim)
    poses = torch.randn(batch, frames, 7)
    return LatentBatch(latents, poses, poses[:, 1:].clone(), cameras, ("a",) * batch, (0,) * batch)


def measured_peaks(config: Config, sizes: ModelSizes) -> tuple[int, ...]:
    """Return the peak bytes of a forward and backward pass, without and with checkpointing."""
    rotary_tables.cache_clear()
    dtype, peaks = PRECISIONS[config.training.precision], []
    precision = contextlib.nullcontext() if dtype == torch.float32 else torch.autocast("cpu", dtype)
    with StorageCounter() as counter:
        model = built(config, sizes)
        for parameter in model.parameters():
            parameter.grad = torch.zeros_like(parameter) if parameter.requires_grad else None
        batch, matrices = clips(config, model), CastMatrices(model, dtype)
        for checkpointing in (False, True):
            model.set_gradient_checkpointing(checkpointing)
            with matrices.use():
                counter.storages.forget()
                with precision:
                    loss = torch.stack(Objective(model, config.training)(batch)).sum()
                loss.backward()
            del loss
            peaks.append(counter.storages.peak)
    return tuple(peaks)


@pytest.mark.parametrize("name", CASES)
def test_estimated_step_memory_equals_the_peak_on_a_cpu(name: str) -> None:
    adapter, changes, sizes = CASES[name]
    config = run_config(adapter, **changes)
    step = measure_step(config, sizes, "cpu")
    assert (step.stored, step.checkpointed) == pytest.approx(measured_peaks(config, sizes), rel=TOLERANCE)


def test_memory_of_all_blocks_follows_from_two_and_three(monkeypatch: pytest.MonkeyPatch) -> None:
    config, sizes = run_config({**LORA, "dropout": 0.0}, training__rollout_steps=2), model_sizes(depth=5)
    inferred = measure_step(config, sizes)
    monkeypatch.setattr(cost_step, "_BLOCKS", (5, 5))
    cost_step._measured.clear()
    measured_bytes = measure_step(config, sizes)
    cost_step._measured.clear()
    assert inferred == pytest.approx(measured_bytes, rel=0.005)  # the step of the peak may change with depth


@pytest.mark.parametrize(("changes", "has_copies"), [({}, False), (FLOAT32_BASE, True)])
def test_norms_on_cuda_keep_a_float32_copy_under_autocast(changes: dict[str, Any], has_copies: bool) -> None:
    config, sizes = run_config(LORA, **changes, training__attention="per_step"), model_sizes()
    cpu, cuda = (measure_step(config, sizes, device) for device in ("cpu", "cuda"))
    assert (cuda.stored > cpu.stored) == has_copies
