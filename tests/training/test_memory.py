"""The memory estimate: parts, totals, suggested savings, parameter counts, and the output of `doctor`."""

import json
from typing import Any

import pytest
import torch

from sized_runs import LORA, built, model_sizes, run_config
from vjepa2_ac.cli import main
from vjepa2_ac.config import Config, EncoderSizes, ModelSizes
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.model.lora import trainable_report
from vjepa2_ac.training import cost
from vjepa2_ac.training.cost import MemoryEstimate, count_parameters, estimate_memory, suggest_memory_savings
from vjepa2_ac.training.optim import make_optimizer


def bytes_of_moments(**changes: object) -> tuple[int, int]:
    """Return the bytes of the estimate and those of an optimizer after one step."""
    config, sizes = run_config({**LORA, "rank": 24, "dora": True}, **changes), model_sizes(width=96)
    model = built(config, sizes)
    for value in model.parameters():
        value.grad = torch.ones_like(value) if value.requires_grad else None
    optimizer = make_optimizer(model, config.training)
    optimizer.step()
    tensors = {
        tensor.data_ptr(): tensor.nbytes
        for state in optimizer.state.values()
        for name, tensor in state.items()
        if isinstance(tensor, torch.Tensor)
        and name != "step"
        and not name.startswith("qmap")  # a table that all tensors share
    }
    return estimate_memory(config, sizes).parts["optimizer state"], sum(tensors.values())


def test_estimated_moments_equal_those_of_the_optimizer() -> None:
    estimate, measured = bytes_of_moments()
    assert estimate == measured


def test_estimated_8_bit_moments_equal_those_of_bitsandbytes() -> None:
    pytest.importorskip("bitsandbytes")
    estimate, measured = bytes_of_moments(training__optimizer="adamw_8bit")
    assert estimate == measured < bytes_of_moments()[0]


USUAL = {"run_dir": "run", "data": {"path": "set", "frames": 16}, "model": {"base": "not-here.pt"}}


def usual(**training: object) -> Config:
    """Return a config whose step is measured once for all tests."""
    return parse_config({**USUAL, "training": training}, where="test")


def test_memory_savings_are_suggested_only_for_a_run_that_does_not_fit() -> None:
    config, sizes = usual(batch_size=8), model_sizes()
    stored, checkpointed = (
        estimate_memory(config, sizes).total(checkpointing=checkpointing) for checkpointing in (False, True)
    )
    assert checkpointed < stored
    assert suggest_memory_savings(config, sizes, stored) == []
    assert suggest_memory_savings(config, sizes, stored - 1) == ["training.gradient_checkpointing=true"]
    assert suggest_memory_savings(config, sizes, 0) is None


def test_suggested_number_of_frames_is_large_enough_for_the_rollout() -> None:
    assert "data.frames=8" in dict(cost._list_memory_savings(usual(rollout_steps=2)))
    assert "data.frames=11" in dict(cost._list_memory_savings(usual(rollout_steps=10)))


def test_doctor_prints_whether_a_run_fits_and_which_parts_are_estimates(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    path = tmp_path / "run.yaml"
    path.write_text(json.dumps(USUAL))
    assert main(["doctor", str(path), "training.batch_size=8"]) == 1
    reported = capsys.readouterr().out
    assert "It fits with" in reported
    assert reported.startswith("No GPU: PyTorch finds none on this machine.")
    assert "a GPU with 24.0 GB is too small." in " ".join(reported.split())
    assert "allowance was not measured" in " ".join(reported.split())
    assert " 0.000 GB" not in reported
    assert f"vjepa2-ac train {path} --check" in reported


@pytest.mark.parametrize(("encoder", "peak"), [(90, 100), (97, 102)])
def test_batch_is_not_counted_while_the_predictor_runs(encoder: int, peak: int) -> None:
    parts = dict.fromkeys(estimate_memory(usual(), model_sizes()).parts, 0)
    parts |= {"batch": 5, "encoder activations": encoder, "predictor activations": 100}
    parameters = count_parameters(usual(), model_sizes())
    assert MemoryEstimate(parameters, checkpointing=False, parts=parts).total(checkpointing=False) == peak


# Parameter counts equal those of a built model, tensor by tensor.

HEADS = ["action_encoder", "state_encoder"]
ADAPTERS: dict[str, dict[str, Any]] = {
    "mlp and a head": {**LORA, "targets": ["mlp", "state_encoder"]},
    "the ends whole": {**LORA, "targets": ["all"], "modules_to_save": ["predictor_embed", "predictor_proj", *HEADS]},
    "dora everywhere": {**LORA, "dora": True, "targets": ["all"]},
    "none": {"kind": "none"},
}
SHAPES = {
    "extrinsics": model_sizes(extrinsics=True),
    "V-JEPA 2.1": model_sizes().model_copy(update={"encoder": EncoderSizes(width=48, depth=1, heads=2, family="v2.1")}),
}


@pytest.mark.parametrize("adapter", ADAPTERS)
@pytest.mark.parametrize("shape", SHAPES)
def test_parameter_counts_equal_those_of_a_built_model(shape: str, adapter: str) -> None:
    config, sizes = run_config(ADAPTERS[adapter]), SHAPES[shape]
    model = built(config, sizes)
    counts, report = count_parameters(config, sizes), trainable_report(model)
    assert (counts.predictor, counts.encoder) == (report.predictor, report.total - report.predictor)
    assert counts.trained == report.trained
    trained_sizes = sorted(value.numel() for value in model.parameters() if value.requires_grad)
    assert sorted(counts.trained_tensors) == trained_sizes


def test_parameter_counts_of_the_released_model() -> None:
    counts = count_parameters(run_config({"rank": 16}), ModelSizes())
    assert counts.encoder == 1_012_173_952
    assert counts.trained == 16 * 442_368
