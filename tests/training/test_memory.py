"""The estimate counts what is really there: parameters exactly, and what autograd keeps nearly."""

import subprocess
import sys
from typing import Any

import pytest
import torch

from vjepa2_ac.cli import main
from vjepa2_ac.config import Config, ModelSizes
from vjepa2_ac.config_file import parse_config
from vjepa2_ac.console_doctor import memory_lines
from vjepa2_ac.episode import LatentBatch
from vjepa2_ac.model.lora import add_adapter, trainable_report
from vjepa2_ac.model.positions import rotary_tables
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.training.assembly import make_accelerator
from vjepa2_ac.training.kept import Kept
from vjepa2_ac.training.loss import Objective
from vjepa2_ac.training.memory import USUAL_GPU, count_parameters, estimate_memory, ways_to_fit

SMALL = {
    "image_size": 64, "patch_size": 16,
    "encoder": {"width": 48, "depth": 1, "heads": 2, "mlp_ratio": 2.0},
    "predictor": {"width": 48, "depth": 2, "heads": 2},
}  # fmt: skip
WIDER = {
    "image_size": 96, "patch_size": 16,
    "encoder": {"width": 96, "depth": 1, "heads": 2, "mlp_ratio": 48 / 11},
    "predictor": {"width": 128, "depth": 5, "heads": 4, "mlp_ratio": 3.0},
}  # fmt: skip
LORA = {"rank": 4, "alpha": 8}
EVERYWHERE = [
    "q", "k", "v", "o", "fc1", "fc2", "predictor_embed", "predictor_proj", "action_encoder", "state_encoder",
]  # fmt: skip
ADAPTERS: dict[str, dict[str, Any]] = {
    "lora": LORA, "attention only": {**LORA, "targets": ["q", "v"]}, "no dropout": {**LORA, "dropout": 0.0},
    "everywhere": {**LORA, "targets": EVERYWHERE}, "none": {"kind": "none"},
}  # fmt: skip


def run_config(adapter: dict[str, Any] | None = None, **changes: Any) -> Config:
    """Return a run; its base and data are never opened."""
    values: dict[str, Any] = {
        "run_dir": "run", "data": {"path": "set", "frames": 6}, "model": {"base": "base"}, "adapter": adapter or LORA,
        "training": {"device": "cpu", "batch_size": 2, "rollout_steps": 2},
    }  # fmt: skip
    for key, value in changes.items():
        section, name = key.split("__")
        values[section] = {**values[section], name: value}
    return parse_config(values, where="test")


def built(config: Config, sizes: ModelSizes) -> WorldModel:
    dtype = torch.bfloat16 if config.model.dtype == "bfloat16" else torch.float32
    model = WorldModel.random(sizes, seed=0, dtype=dtype)
    add_adapter(model, config.adapter, seed=0)
    model.set_gradient_checkpointing(config.training.gradient_checkpointing)
    return model.train()  # type: ignore[return-value]


class Keeping(torch.autograd.graph.saved_tensors_hooks):
    """Sums the bytes that autograd saves, each storage once; weights are not activations."""

    def __init__(self, model: WorldModel) -> None:
        self.storages: dict[int, torch.Tensor] = {}
        self.weights = {value.untyped_storage().data_ptr() for value in model.parameters()}
        super().__init__(self._pack, lambda saved: saved)

    def _pack(self, saved: torch.Tensor) -> torch.Tensor:
        self.storages[saved.untyped_storage().data_ptr()] = saved
        return saved

    @property
    def bytes(self) -> int:
        return sum(s.untyped_storage().nbytes() for place, s in self.storages.items() if place not in self.weights)


def kept_by_autograd(config: Config, sizes: ModelSizes) -> int:
    """Return what PyTorch keeps of the objective of one micro-batch, in the arithmetic of a run."""
    model, accelerator = built(config, sizes), make_accelerator(config)
    objective = accelerator.prepare(Objective(model, config.training))
    clips, frames = config.training.batch_size, config.data.frames
    batch = LatentBatch(
        latents=torch.randn(clips, frames, model.num_tokens, model.latent_dim),
        actions=torch.randn(clips, frames - 1, 7), states=torch.randn(clips, frames, 7), extrinsics=None,
        episode_ids=("a",) * clips, starts=(0,) * clips,
    )  # fmt: skip
    keeping = Keeping(model)
    with keeping:
        forced, rollout = objective(batch)
    kept = keeping.bytes
    accelerator.backward(forced + rollout)
    return kept


def kept_by_one_block(config: Config, sizes: ModelSizes) -> int:
    """Return what PyTorch keeps of one block: what is there while checkpointing computes it again."""
    model, accelerator = built(config, sizes), make_accelerator(config)
    predictor = model.base_predictor
    layout = predictor._assemble(
        torch.zeros(config.training.batch_size, config.data.frames - 1, model.num_tokens, model.latent_dim),
        *[torch.zeros(config.training.batch_size, config.data.frames - 1, 7)] * 2, None,
    )[1]  # fmt: skip
    tables = rotary_tables(layout, sizes.predictor.width // sizes.predictor.heads, torch.device("cpu"))
    dtype = torch.bfloat16 if config.training.precision == "bf16" else torch.float32
    tokens = torch.randn(config.training.batch_size, layout.length, sizes.predictor.width, dtype=dtype)
    keeping = Keeping(model)
    with accelerator.autocast(), keeping:
        predictor.blocks[1](tokens.requires_grad_(), tables, layout.tokens_per_step)
    return keeping.bytes


# Two shapes, and every kind of adapter and arithmetic at one of them.
CASES = [
    (SMALL, 6, 2, "bf16", "bfloat16", "lora"), (WIDER, 5, 3, "bf16", "bfloat16", "lora"),
    (WIDER, 5, 1, "fp32", "float32", "lora"), (SMALL, 5, 3, "bf16", "float32", "lora"),
    (SMALL, 6, 2, "bf16", "bfloat16", "none"), (WIDER, 5, 3, "bf16", "float32", "none"),
]  # fmt: skip
OTHER_ADAPTERS = [
    (WIDER, 5, 2, "bf16", "bfloat16", "attention only"), (SMALL, 6, 2, "bf16", "bfloat16", "everywhere"),
    (SMALL, 6, 3, "fp32", "float32", "no dropout"),
]  # fmt: skip
NAMES = ("shape", "frames", "rollout", "precision", "dtype", "adapter")


def case(shape: Any, frames: int, rollout: int, precision: str, dtype: str, adapter: str) -> tuple[Config, ModelSizes]:
    config = run_config(
        ADAPTERS[adapter], data__frames=frames, training__rollout_steps=rollout, training__precision=precision,
        model__dtype=dtype,
    )  # fmt: skip
    return config, ModelSizes.model_validate(shape)


@pytest.mark.parametrize(NAMES, CASES + OTHER_ADAPTERS)
def test_estimate_is_what_autograd_keeps(shape, frames, rollout, precision, dtype, adapter) -> None:
    config, sizes = case(shape, frames, rollout, precision, dtype, adapter)
    measured = kept_by_autograd(config, sizes)
    assert Kept(config, sizes, "cpu").without_checkpointing() == pytest.approx(measured, rel=0.15)


@pytest.mark.parametrize(NAMES, CASES)
def test_estimate_is_what_autograd_keeps_with_checkpointing(shape, frames, rollout, precision, dtype, adapter) -> None:
    config, sizes = case(shape, frames, rollout, precision, dtype, adapter)
    training = config.training.model_copy(update={"gradient_checkpointing": True})
    config = config.model_copy(update={"training": training})
    measured = kept_by_autograd(config, sizes) + kept_by_one_block(config, sizes)
    assert Kept(config, sizes, "cpu").with_checkpointing() == pytest.approx(measured, rel=0.15)


@pytest.mark.parametrize("adapter", ADAPTERS)
@pytest.mark.parametrize("shape", [SMALL, WIDER], ids=["small", "wider"])
def test_parameters_are_those_of_a_model_that_was_built(shape, adapter) -> None:
    config, sizes = run_config(ADAPTERS[adapter]), ModelSizes.model_validate(shape)
    model = built(config, sizes)
    counts, report = count_parameters(config, sizes), trainable_report(model)
    assert (counts.predictor, counts.encoder) == (report.predictor, report.total - report.predictor)
    assert counts.trained == report.trained


@pytest.mark.parametrize("rank", [1, 16])
def test_parameters_of_the_released_model_are_the_known_ones(rank: int) -> None:
    counts = count_parameters(run_config({"rank": rank}), ModelSizes())
    assert counts.encoder == 1_012_173_952
    assert counts.trained == rank * 442_368


def test_nothing_is_kept_for_a_rollout_that_does_not_count() -> None:
    config = run_config(training__rollout_steps=3, training__rollout_weight=0.0)
    estimate = estimate_memory(config, ModelSizes())
    assert estimate.rollout == 0
    assert estimate.losses < estimate_memory(run_config(training__rollout_steps=3), ModelSizes()).losses


def test_a_run_that_fits_needs_no_knob_and_a_large_one_is_told_which() -> None:
    sizes = ModelSizes()
    small, large = run_config(data__frames=16), run_config(data__frames=16, training__batch_size=8)
    assert ways_to_fit(small, sizes, USUAL_GPU) == []
    knobs = ways_to_fit(large, sizes, USUAL_GPU)
    assert knobs == ["training.gradient_checkpointing=true"]
    checked = run_config(data__frames=16, training__batch_size=8, training__gradient_checkpointing=True)
    assert estimate_memory(checked, sizes).total(checkpointing=True) <= USUAL_GPU
    assert ways_to_fit(large, sizes, 10**9) is None


def test_the_arithmetic_does_without_torch() -> None:
    code = "import sys, vjepa2_ac.training.memory; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(("batch", "status", "word"), [(2, 0, "It fits on"), (8, 1, "gradient_checkpointing=true")])
def test_doctor_says_whether_it_fits_and_what_it_has_not_been_compared_with(
    tmp_path, capsys, monkeypatch, batch: int, status: int, word: str
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    path = tmp_path / "run.yaml"
    path.write_text("run_dir: run\ndata: {path: set, frames: 16}\nmodel: {base: not-here.pt}\n")
    assert main(["doctor", str(path), f"training.batch_size={batch}"]) == status
    said = capsys.readouterr().out
    assert word in said
    assert "not been compared with a GPU's measured peak" in said
    assert f"vjepa2-ac data check {path}" in said


def test_doctor_says_what_it_does_not_count() -> None:
    plain, dora = run_config(), run_config({**LORA, "dora": True})
    assert not any("adapter.dora" in line for line in memory_lines(plain, estimate_memory(plain, ModelSizes())))
    assert any("adapter.dora" in line for line in memory_lines(dora, estimate_memory(dora, ModelSizes())))
