"""What was named is planned with, as its own config says; what cannot be planned with is refused."""

from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from adapted_run import write_adapted_run
from vjepa2_ac.config_file import config_as_dict, config_as_yaml
from vjepa2_ac.errors import InputError
from vjepa2_ac.model.world_model import WorldModel
from vjepa2_ac.training.planning import Steering, load_to_plan
from vjepa2_ac.training.run_folder import check_run_folder, config_changes, open_run_folder, read_run_config

PLANNING = {"horizon": 2, "samples": 12, "iterations": 2, "cem": {"elites": 4}}
STATE = np.array([0.4, 0.0, 0.3, 3.1, 0.0, 0.1, 0.2])


@pytest.fixture
def run(make_config, tmp_path: Path) -> Path:
    return write_adapted_run(
        make_config(run_dir=str(tmp_path / "a run"), planning=PLANNING, seed=7, data__crop="square")
    )


@torch.no_grad()
def prediction(world_model: WorldModel) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    latents = torch.randn(1, 1, world_model.num_tokens, world_model.latent_dim, generator=generator)
    return world_model.predict(latents, torch.full((1, 1, 7), 0.1), torch.full((1, 1, 7), 0.2))


def test_a_run_is_planned_with_as_its_own_config_says(run: Path) -> None:
    steering = load_to_plan(str(run))
    assert steering.checkpoint == "step-00000020 (the newest)"
    assert steering.config.planning.horizon == 2
    controller = steering.controller()
    pictures = np.random.default_rng(0).integers(0, 256, (2, 40, 64, 3), dtype=np.uint8)
    controller.reset(pictures[0])
    controller.act(pictures[1], STATE)
    assert controller.decision is not None
    assert controller.decision.plan is not None
    assert controller.decision.plan.seed == 7
    assert len(controller.decision.plan.actions) == 2
    assert controller.crop == "square"
    assert steering.controller(seed=3).seed == 3


def test_the_checkpoint_that_is_named_is_the_one_that_plans(run: Path, base_folder: Path) -> None:
    newest, best, base = (
        prediction(load_to_plan(*given[:1], checkpoint=given[1]).world_model)
        for given in ((str(run), "newest"), (str(run), "best"), (str(base_folder), "newest"))
    )
    torch.testing.assert_close(prediction(load_to_plan(str(run), checkpoint="10").world_model), best)
    assert not torch.allclose(newest, best, atol=1e-4)
    assert not torch.allclose(base, best, atol=1e-4)


def test_a_model_in_eval_mode_comes_out(run: Path, base_folder: Path) -> None:
    for subject in (str(run), str(base_folder)):
        assert not any(module.training for module in load_to_plan(subject).world_model.modules())


def test_a_model_needs_no_config_and_takes_one(make_config, base_folder: Path, tmp_path: Path) -> None:
    alone = load_to_plan(str(base_folder), overrides=["planning.samples=20", "seed=4"])
    assert (alone.config.planning.samples, alone.config.seed, alone.config.planning.horizon) == (20, 4, 1)
    path = tmp_path / "its.yaml"
    path.write_text(config_as_yaml(make_config(planning=PLANNING, model__dtype="bfloat16", training__precision="bf16")))
    told = load_to_plan(str(base_folder), config=path, overrides=["planning.cem.elites=3"])
    assert (told.config.planning.horizon, told.config.planning.cem.elites) == (2, 3)
    assert next(told.world_model.parameters()).dtype == torch.bfloat16


def test_the_model_that_was_named_is_loaded_not_that_of_the_config(make_config, base_folder, tmp_path: Path) -> None:
    sizes = config_as_dict(make_config())["model"]["sizes"] | {"image_size": 32}
    sizes["encoder"] = {"width": 12, "depth": 1, "heads": 1}
    fresh = make_config(model={"random": sizes, "dtype": "float32"}, adapter__kind="none")
    path = tmp_path / "its.yaml"
    path.write_text(config_as_yaml(fresh))
    assert load_to_plan(str(base_folder), config=path).world_model.latent_dim == 24


def test_the_builtin_model_plans_at_once() -> None:
    steering = load_to_plan("builtin:sim-tiny")
    assert isinstance(steering, Steering)
    assert steering.checkpoint == ""


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ({"overrides": ["training.steps=3"]}, r"training\.steps=3: a setting that planning does not heed"),
        ({"overrides": ["horizon=3"]}, r"did you mean planning\.horizon"),
        ({"overrides": ["planning.horizon=0"]}, r"planning\.horizon.*greater than or equal to 1"),
        ({"overrides": ["planning.limits.xyz=[-0.1, 0, 0]"]}, r"planning\.limits\.xyz"),
        ({"overrides": ["planning.limits={xyz: [0, 0, 0], gripper: 0}"]}, "nothing is left to plan"),
        ({"overrides": ["planning.horizont=3"]}, "did you mean horizon"),
        ({"checkpoint": "best"}, "not the folder of a run"),
    ],
)
def test_what_a_model_cannot_be_asked_for_is_refused(base_folder: Path, given: dict, complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        load_to_plan(str(base_folder), **given)


def test_what_a_run_cannot_be_asked_for_is_refused(run: Path) -> None:
    with pytest.raises(InputError, match="a config of its own"):
        load_to_plan(str(run), config="other.yaml")
    with pytest.raises(InputError, match="one of the steps 10, 20"):
        load_to_plan(str(run), checkpoint="15")
    with pytest.raises(InputError, match="no such file or folder"):
        load_to_plan(str(run / "nowhere"))


def test_a_model_of_vectors_is_refused(make_config, tmp_path: Path) -> None:
    config = make_config()
    vectors = config.model_copy(update={"data": config.data.model_copy(update={"states": "vector"})})
    path = tmp_path / "its.yaml"
    path.write_text(config_as_yaml(vectors))
    with pytest.raises(InputError, match="a model of poses"):
        load_to_plan("builtin:sim-tiny", config=path)


def test_a_run_from_before_there_was_a_planning_section_goes_on_unchanged(make_config) -> None:
    config = make_config()
    folder = open_run_folder(config, "name")
    plain = config_as_dict(config)
    del plain["planning"]
    (folder / "config.yaml").write_text(yaml.safe_dump(plain))
    assert read_run_config(folder) == config
    check_run_folder(config)
    assert config_changes(config) == []


def test_a_run_may_go_on_with_other_settings_of_planning(make_config) -> None:
    open_run_folder(make_config(), "name")
    check_run_folder(make_config(planning=PLANNING))
