"""Parameter counts are exact: tensor by tensor those of a built model."""

from typing import Any

import pytest

from sized_runs import LORA, built, model_sizes, run_config
from vjepa2_ac.config import Config, EncoderSizes, ModelSizes
from vjepa2_ac.model.adapter.lora import trainable_report
from vjepa2_ac.model.adapter.targets import adapter_ranks
from vjepa2_ac.training.cost.memory import count_parameters
from vjepa2_ac.training.cost.step import meta_network

HEADS = ["action_encoder", "state_encoder"]
ADAPTERS: dict[str, dict[str, Any]] = {
    "lora": LORA,
    "rank": {"rank": 7},
    "some": {**LORA, "targets": ["q", "fc2", "predictor_proj"]},
    "attention": {**LORA, "targets": ["attention"]},
    "mlp and a head": {**LORA, "targets": ["mlp", "state_encoder"]},
    "all": {**LORA, "targets": ["all"]},
    "all but the heads": {**LORA, "targets": ["all"], "modules_to_save": HEADS},
    "one head whole": {**LORA, "modules_to_save": HEADS[:1]},
    "the ends whole": {**LORA, "targets": ["all"], "modules_to_save": ["predictor_embed", "predictor_proj", *HEADS]},
    "dora": {**LORA, "dora": True},
    "dora everywhere": {**LORA, "dora": True, "targets": ["all"]},
    "pissa": {**LORA, "init": "pissa"},
    "patterns": {**LORA, "rank_pattern": {"fc1": 6, r"blocks\.0\.attn\.q": 2, "attn.(k|v)": 3}},
    "patterns that overlap": {**LORA, "rank_pattern": {r"blocks\.1\..*": 5, "q": 2}, "dora": True},
    "a pattern for a head": {**LORA, "targets": ["all"], "rank_pattern": {"predictor_embed": 9, ".*_encoder": 1}},
    "none": {"kind": "none"},
}
SHAPES = {
    "small": model_sizes(),
    "wider": model_sizes(latent=96, width=128, depth=3, heads=4, mlp=3.3, image=96),
    "extrinsics": model_sizes(extrinsics=True),
    "V-JEPA 2.1": model_sizes().model_copy(update={"encoder": EncoderSizes(width=48, depth=1, heads=2, family="v2.1")}),
}


@pytest.mark.parametrize("adapter", ADAPTERS)
@pytest.mark.parametrize("shape", SHAPES)
def test_parameters_are_those_of_a_model_that_was_built(shape: str, adapter: str) -> None:
    assert_parameters_are_counted(run_config(ADAPTERS[adapter]), SHAPES[shape])


@pytest.mark.parametrize("extrinsics", [False, True])
@pytest.mark.parametrize("adapter", ["all", "one head whole", "dora everywhere", "a pattern for a head", "none"])
def test_parameters_of_a_model_without_states_are_those_of_one_that_was_built(adapter: str, extrinsics: bool) -> None:
    assert_parameters_are_counted(run_config(ADAPTERS[adapter]), model_sizes(states=False, extrinsics=extrinsics))


def assert_parameters_are_counted(config: Config, sizes: ModelSizes) -> None:
    model = built(config, sizes)
    counts, report = count_parameters(config, sizes), trainable_report(model)
    assert (counts.predictor, counts.encoder) == (report.predictor, report.total - report.predictor)
    assert counts.trained == report.trained
    found = sorted(value.numel() for value in model.parameters() if value.requires_grad)
    assert sorted(counts.trained_tensors) == found


@pytest.mark.parametrize("rank", [1, 16])
def test_parameters_of_the_released_model_are_the_known_ones(rank: int) -> None:
    counts = count_parameters(run_config({"rank": rank}), ModelSizes())
    assert counts.encoder == 1_012_173_952
    assert counts.trained == rank * 442_368


def test_layers_with_an_adapter_go_by_their_last_name() -> None:
    config = run_config(ADAPTERS["all but the heads"])
    assert {name.rpartition(".")[2] for name in adapter_ranks(meta_network(model_sizes()), config.adapter)} == {
        "q", "k", "v", "o", "fc1", "fc2", "predictor_embed", "predictor_proj",
    }  # fmt: skip
