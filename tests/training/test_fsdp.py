"""FSDP2: processes that share a predictor equal a single one, and unsupported settings are refused."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from paths import ROOT
from ranks import finish, free_port, start_rank
from same_run import metrics, optimizer_state
from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.distributed.launch import check_launch
from vjepa2_ac.errors import InputError
from vjepa2_ac.runs.checkpoint import newest_checkpoint, read_state
from vjepa2_ac.training.loop import train

FSDP2 = {"ACCELERATE_USE_FSDP": "true", "FSDP_VERSION": "2"}


def weights(run: Path) -> dict[str, torch.Tensor]:
    return load_file(newest_checkpoint(run / "checkpoints") / "adapter" / "predictor.safetensors")


def assert_equal_up_to_rounding(one: Path, other: Path) -> None:
    assert read_state(newest_checkpoint(one / "checkpoints")).step == 6
    first, second = weights(one), weights(other)
    assert first.keys() == second.keys()
    for name, value in first.items():
        torch.testing.assert_close(second[name], value, rtol=1e-3, atol=1e-5, msg=name)
    moments, same = optimizer_state(one), optimizer_state(other)
    assert moments.keys() == same.keys()
    for key, values in moments.items():
        for name, value in values.items():
            torch.testing.assert_close(same[key][name], value, rtol=1e-3, atol=1e-6, msg=f"{key} {name}")
    for row, again in zip(metrics(one), metrics(other), strict=True):
        assert row.keys() == again.keys()
        assert row.pop("kind") == again.pop("kind")
        assert all(again[name] == pytest.approx(value, rel=1e-4) for name, value in row.items())


def test_two_processes_that_share_a_predictor_make_the_run_of_one(make_config, reporter, tmp_path) -> None:
    """Shared, gone on shared, gone on alone; and begun alone, gone on shared. More in shards_together.py."""

    def config(name: str, steps: int, accumulation: int):
        made = make_config(
            run_dir=str(tmp_path / name),
            adapter__kind="none",
            training__rollout_steps=3,
            training__schedule="constant",
            training__steps=steps,
            training__accumulation=accumulation,
            validation__every=2,
        )
        (tmp_path / f"{name}.yaml").write_text(config_as_yaml(made))
        return made

    train(config("whole", steps=6, accumulation=4), reporter)
    train(config("handed_over", steps=4, accumulation=4), reporter)
    config("shared", steps=6, accumulation=2)
    script, port = ROOT / "tests/support/shards_together.py", free_port()
    (reported, errors), (_, other_errors) = finish(
        [start_rank([str(script), str(tmp_path)], rank, 2, port, **FSDP2) for rank in range(2)]
    )
    assert "2 processes share the predictor's weights, gradients and moments" in reported
    assert "returned a view" not in errors + other_errors
    state = read_state(newest_checkpoint(tmp_path / "shared/checkpoints"))
    assert (state.step, state.processes) == (4, 2)
    train(config("shared", steps=6, accumulation=2), reporter, allow_config_change=True)
    assert_equal_up_to_rounding(tmp_path / "whole", tmp_path / "shared")
    assert_equal_up_to_rounding(tmp_path / "whole", tmp_path / "handed_over")


@pytest.mark.parametrize(
    ("changes", "environment", "message"),
    [
        ({}, {"FSDP_VERSION": "1"}, "FSDP version 1.*Add --fsdp_version 2"),
        ({"adapter__kind": "lora"}, {}, "an adapter needs no shards.*Start without --use_fsdp"),
        ({"training__optimizer": "adamw_8bit"}, {}, "Set training.optimizer=adamw"),
        ({"training__compile": "blocks"}, {}, "Set training.compile=off"),
        ({"data__broken_episodes": "skip"}, {}, "would leave the others waiting.*data.broken_episodes=error"),
        ({}, {"FSDP_OFFLOAD_PARAMS": "true"}, "--fsdp_offload_params true.*Start without it"),
        ({}, {"FSDP_ACTIVATION_CHECKPOINTING": "true"}, "training.gradient_checkpointing=true"),
        ({}, {"ACCELERATE_USE_DEEPSPEED": "true"}, "DeepSpeed"),
        ({}, {"ACCELERATE_USE_MEGATRON_LM": "true"}, "Megatron-LM"),
        ({}, {"ACCELERATE_USE_PARALLELISM_CONFIG": "true"}, "a parallelism config"),
    ],
)
def test_what_processes_cannot_share_is_refused_with_the_way_out(make_config, changes, environment, message) -> None:
    config = make_config(**{"adapter__kind": "none", **changes})
    with pytest.raises(InputError, match=message):
        check_launch(config, FSDP2 | environment)


def test_what_one_can_start_without_shards_is_not_refused(make_config) -> None:
    check_launch(make_config(data__broken_episodes="skip"), {"ACCELERATE_USE_FSDP": "false", "FSDP_VERSION": "1"})
    check_launch(make_config(adapter__kind="none"), FSDP2 | {"FSDP_OFFLOAD_PARAMS": "false"})


def test_a_run_asks_how_it_was_launched_before_anything_else(make_config, reporter, monkeypatch) -> None:
    monkeypatch.setenv("ACCELERATE_USE_FSDP", "true")
    with pytest.raises(InputError, match="FSDP version 1"):
        train(make_config(data__path="nowhere"), reporter)
