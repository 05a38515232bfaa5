"""Adapter files of unknown origin: converted to our knobs, or refused by name; PEFT does not see them."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from peft import LoraConfig

from vjepa2_ac.config import AdapterConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.adapter.adapter_file import ADAPTER_FILE, read_adapter_file
from vjepa2_ac.model.adapter.lora import add_adapter, load_trained, save_trained
from vjepa2_ac.model.network.world_model import WorldModel

Fresh = Callable[..., WorldModel]

KNOBS = AdapterConfig(
    rank=4,
    alpha=8.0,
    dropout=0.25,
    rslora=False,
    dora=True,
    init="gaussian",
    targets=("q", "fc1"),
    modules_to_save=("state_encoder",),
    rank_pattern={"fc1": 6},
    alpha_pattern={"blocks.0.mlp.fc1": 3.5},
)


@pytest.fixture
def folder(fresh: Fresh, tmp_path: Path) -> Path:
    model = fresh()
    add_adapter(model, KNOBS, seed=0)
    save_trained(model, tmp_path)
    return tmp_path


def rewrite(folder: Path, changes: dict[str, Any]) -> None:
    path = folder / ADAPTER_FILE
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_what_this_program_writes_is_read_as_the_knobs_that_it_was_made_of(folder: Path) -> None:
    read = read_adapter_file(folder, LoraConfig().to_dict())
    assert read == KNOBS.model_copy(update={"targets": ("fc1", "q")})


@pytest.mark.parametrize("init", ["default", "gaussian", "pissa"])
def test_an_adapter_of_every_start_comes_back(fresh: Fresh, tmp_path: Path, init: str) -> None:
    model = fresh()
    add_adapter(model, KNOBS.model_copy(update={"init": init}), seed=0)
    save_trained(model, tmp_path)
    assert read_adapter_file(tmp_path, LoraConfig().to_dict()).init == init
    load_trained(fresh(), tmp_path)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"target_modules": "(.*)*(a+)+$"}, "target_modules: Input should be a list"),
        ({"target_modules": "all-linear"}, "target_modules: Input should be a list"),
        ({"target_modules": ["q", 3]}, "target_modules.1: Input should be a valid string"),
        ({"target_modules": [f"q{n}" for n in range(65)]}, "at most 64 items"),
        ({"target_modules": ["blocks.0.attn.q"]}, "matches no layer of the predictor"),
        ({"target_modules": []}, "no target"),
        ({"rank_pattern": {"fc7": 4}}, "matches no layer that gets an adapter"),
        ({"rank_pattern": {"fc1": 2**40}}, "rank_pattern.fc1: Input should be less than or equal to 1024"),
        ({"r": "8"}, "r: Input should be a valid integer"),
        ({"r": 10**9}, "r: Input should be less than or equal to 1024"),
        ({"r": True}, "r: Input should be a valid integer"),
        ({"lora_alpha": float("nan")}, "lora_alpha: Input should be a finite number"),
        ({"lora_alpha": 1e300}, "lora_alpha: Input should be less than"),
        ({"lora_alpha": [8]}, "lora_alpha: Input should be a valid number"),
        ({"lora_dropout": 1.5}, "lora_dropout: Input should be less than 1"),
        ({"use_dora": "yes"}, "use_dora: Input should be a valid boolean"),
        ({"init_lora_weights": "olora"}, "init_lora_weights: Input should be 'default', 'gaussian' or 'pissa'"),
        ({"modules_to_save": ["blocks"]}, "modules_to_save.0: Input should be 'predictor_embed'"),
        ({"peft_type": "IA3"}, "an adapter with peft_type 'IA3'. needed: peft_type LORA"),
        ({"peft_type": None}, "peft_type None"),
        ({"bias": "all"}, "an adapter with bias 'all'"),
        ({"layers_to_transform": 3}, "an adapter with 'layers_to_transform' 3"),
        ({"layer_replication": [[0, 4], [2, 5]]}, "'layer_replication'"),
        ({"fan_in_fan_out": True}, "'fan_in_fan_out' True"),
        ({"exclude_modules": "(a+)+"}, "'exclude_modules'"),
        ({"target_parameters": ["w"]}, "'target_parameters'"),
        ({"use_of_the_future": {"a": 1}}, "'use_of_the_future'"),
    ],
)
def test_what_no_adapter_of_ours_can_be_is_refused_by_name(
    fresh: Fresh, folder: Path, changes: dict[str, Any], complaint: str
) -> None:
    rewrite(folder, changes)
    with pytest.raises(InputError) as caught:
        load_trained(fresh(), folder)
    assert complaint in str(caught.value)
    assert str(folder / ADAPTER_FILE) in caught.value.where


def test_what_another_version_of_peft_writes_of_what_is_off_is_no_obstacle(fresh: Fresh, folder: Path) -> None:
    later = {"peft_version": "9.9", "some_config": None, "use_it": False, "its_pattern": {}, "qalora_group_size": 16}
    rewrite(folder, later)
    load_trained(fresh(), folder)


def test_an_adapter_that_is_on_meets_the_same_strictness(folder: Path, fresh: Fresh) -> None:
    model = fresh()
    add_adapter(model, KNOBS, seed=1)
    load_trained(model, folder)
    rewrite(folder, {"target_modules": "(a+)+$"})
    with pytest.raises(InputError, match="target_modules: Input should be a list"):
        load_trained(model, folder)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"kind": ["lora"]}, "kind: Input should be 'lora' or 'none'"),
        ({"kind": {}}, "kind: "),
        ({"base_predictor": 3}, "base_predictor: Input should be a valid string"),
        ({"encoder": None}, "encoder: Input should be a valid string"),
        ({"fresh_heads": {"state_dim": 10**9, "action_dim": 7, "seed": 0}}, "fresh_heads.state_dim: "),
        ({"fresh_heads": {"state_dim": 8, "action_dim": 7, "seed": -1}}, "fresh_heads.seed: "),
        ({"fresh_heads": [1]}, "fresh_heads: "),
        ({"fresh_heads": {"state_dim": 8}}, "fresh_heads.action_dim: missing"),
        ({"more": 1}, "more: unknown"),
    ],
)
def test_a_card_of_other_types_is_refused_by_name(
    fresh: Fresh, folder: Path, changes: dict[str, Any], complaint: str
) -> None:
    path = folder / "vjepa2_ac.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    with pytest.raises(InputError) as caught:
        load_trained(fresh(), folder)
    assert complaint in str(caught.value)
