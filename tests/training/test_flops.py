"""FLOP formulas equal PyTorch's counter for a tiny model, and approximately the known values of the released model."""

from typing import Any

import pytest
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from paths import ROOT
from sized_runs import built, run_config
from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.config.loading import load_config
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.training.flops import clip_flops, frame_flops
from vjepa2_ac.training.step import Objective

SIZES = ModelSizes.model_validate({
    "image_size": 64, "patch_size": 16, "encoder": {"width": 36, "depth": 2, "heads": 2, "mlp_ratio": 2.0},
    "predictor": {"width": 48, "depth": 3, "heads": 2, "mlp_ratio": 3.0},
})  # fmt: skip
LORA: dict[str, Any] = {"rank": 4, "alpha": 8, "dropout": 0.0}
ADAPTERS: dict[str, dict[str, Any]] = {
    "value only": {**LORA, "targets": ["v"]},
    "heads": {**LORA, "modules_to_save": ["action_encoder"]},
    "none": {"kind": "none"}, "ends": {**LORA, "modules_to_save": ["predictor_embed", "predictor_proj"]},
    "ranks": {**LORA, "peft": {"rank_pattern": {"fc1": 8, "blocks.0.attn.q": 2}}},
}  # fmt: skip


def count_flops(config: Config, clips: int = 2) -> tuple[int, int]:
    """Return PyTorch's FLOP counts for one clip: forward and backward pass."""
    model = built(config, SIZES)
    frames, objective = config.data.frames, Objective(model, config.training)
    batch = LatentBatch(
        latents=torch.randn(clips, frames, model.num_tokens, model.latent_dim), states=torch.randn(clips, frames, 7),
        actions=torch.randn(clips, frames - 1, 7), extrinsics=None, episode_ids=("a",) * clips, starts=(0,) * clips,
    )  # fmt: skip
    with sdpa_kernel(SDPBackend.MATH):  # the only CPU kernel whose matrix products PyTorch counts
        with FlopCounterMode(display=False) as forward:
            loss = sum(objective(batch))
        with FlopCounterMode(display=False) as backward:
            loss.backward()
    return forward.get_total_flops() // clips, backward.get_total_flops() // clips


@pytest.mark.parametrize("adapter", ADAPTERS)
def test_clip_flops_equal_pytorchs_counter(adapter: str) -> None:
    config = run_config(ADAPTERS[adapter], training__rollout_steps=3, model__dtype="float32")
    flops = clip_flops(config, SIZES)
    assert (flops.forward, flops.backward) == count_flops(config)


def test_frame_flops_equal_pytorchs_counter() -> None:
    model = WorldModel.random(SIZES, seed=0)
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        model.encode(torch.randn(1, 1, 3, 64, 64))
    assert frame_flops(SIZES) == counter.get_total_flops()


def test_flops_of_the_default_run_equal_a_calculation_by_hand() -> None:
    flops = clip_flops(load_config(ROOT / "configs/default.yaml"), ModelSizes())
    assert flops.encoder == pytest.approx(8.5e12, rel=0.01)
    assert flops.predictor == pytest.approx(7.5e12, rel=0.05)
    assert flops.total == pytest.approx(16e12, rel=0.02)
