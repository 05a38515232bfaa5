"""Untrusted adapter files are converted to this project's config, or rejected with the name of the option."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from vjepa2_ac.config import AdapterConfig
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.adapter_folder import ADAPTER_FILE, CARD, load_trained, save_trained
from vjepa2_ac.model.lora import add_adapter, parse_adapter_config
from vjepa2_ac.model.world_model import WorldModel

Fresh = Callable[..., WorldModel]

CONFIG = AdapterConfig(
    rank=4,
    alpha=8.0,
    dropout=0.25,
    rslora=False,
    dora=True,
    targets=("q", "fc1"),
    modules_to_save=("state_encoder",),
    peft={"rank_pattern": {"fc(1|2)": 6}, "alpha_pattern": {"blocks.0.mlp.fc1": 3.5}, "init_lora_weights": "gaussian"},
)


@pytest.fixture
def folder(fresh: Fresh, tmp_path: Path) -> Path:
    model = fresh()
    add_adapter(model, CONFIG, seed=0)
    save_trained(model, tmp_path)
    return tmp_path


def rewrite(folder: Path, changes: dict[str, Any], file: str = ADAPTER_FILE) -> None:
    path = folder / file
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_saved_adapter_config_has_layer_names_instead_of_user_patterns(folder: Path) -> None:
    saved = parse_adapter_config(json.loads((folder / ADAPTER_FILE).read_text()), where="here")
    ranks = {f"blocks.{index}.mlp.fc1": 6 for index in range(2)}
    patterns = {"rank_pattern": ranks, "alpha_pattern": {"blocks.0.mlp.fc1": 3.5}}
    assert saved == CONFIG.model_copy(update={"targets": ("fc1", "q"), "peft": patterns})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"target_modules": "(.*)*(a+)+$"}, "targets: Input should be a list"),
        ({"target_modules": ["(a+)+$"]}, "matches no layer of the predictor"),
        ({"target_modules": None}, "'target_modules' None"),
        ({"rank_pattern": {"(a+)+$": 4}}, "'rank_pattern'"),
        ({"rank_pattern": {"fc1": 2**40}}, "'rank_pattern'"),
        ({"r": 10**9}, "rank: Input should be less than or equal to 1024"),
        ({"lora_alpha": 1e300}, "alpha: Input should be less than"),
        ({"init_lora_weights": "pissa"}, "peft.init_lora_weights 'pissa' changes the base"),
        ({"modules_to_save": ["blocks"]}, "modules_to_save.0: Input should be 'predictor_embed'"),
        ({"peft_type": "IA3"}, "an adapter with unsupported options: 'peft_type' 'IA3'"),
        ({"bias": "all"}, "an adapter with unsupported options: 'bias' 'all'"),
        ({"use_future_option": 1}, "'use_future_option'"),
    ],
)
def test_unsupported_adapter_option_raises_with_its_name(
    fresh: Fresh, folder: Path, changes: dict[str, Any], message: str
) -> None:
    adapted = fresh()
    add_adapter(adapted, CONFIG, seed=1)
    load_trained(adapted, folder)
    rewrite(folder, changes)
    for model in (fresh(), adapted):
        if model is adapted and message == "matches no layer of the predictor":
            message = "Expected ('fc1', 'q'), as in the model"
        with pytest.raises(InputError) as caught:
            load_trained(model, folder)
        assert message in str(caught.value)


def test_disabled_options_of_another_peft_version_are_ignored(fresh: Fresh, folder: Path) -> None:
    options = {"peft_version": "9.9", "a_config": None, "use_option": False, "a_pattern": {}, "qalora_group_size": 16}
    rewrite(folder, options)
    load_trained(fresh(), folder)


@pytest.mark.parametrize("initialisation", ["pissa", "loftq"])
def test_initialisation_that_changes_the_base_weights_raises(initialisation: str) -> None:
    with pytest.raises(ValidationError, match="changes the base weights"):
        AdapterConfig(peft={"init_lora_weights": initialisation})


def test_peft_option_that_has_a_config_key_raises() -> None:
    with pytest.raises(ValidationError, match=r"peft\.r: set adapter\.rank instead"):
        AdapterConfig(peft={"r": 4})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": ["lora"]}, "kind: Input should be 'lora' or 'none'"),
        ({"encoder": None}, "encoder: Input should be a valid string"),
        ({"fresh_heads": {"state_dim": 10**9, "action_dim": 7, "seed": 0}}, "fresh_heads.state_dim: "),
        ({"fresh_heads": {"state_dim": 8}}, "fresh_heads.action_dim: missing"),
        ({"more": 1}, "more: unknown"),
    ],
)
def test_card_with_wrong_types_raises_with_the_key(
    fresh: Fresh, folder: Path, changes: dict[str, Any], message: str
) -> None:
    rewrite(folder, changes, CARD)
    with pytest.raises(InputError) as caught:
        load_trained(fresh(), folder)
    assert message in str(caught.value)
