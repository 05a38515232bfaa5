"""Planning uses a run or a model with its own config and the motions of its data, or raises."""

import json
import logging
from pathlib import Path

import numpy as np
import pytest
import torch

from adapted_run import write_adapted_run
from decisions import STATE, image
from vjepa2_ac.config.loading import config_as_yaml
from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.data.sources.indexed_source import open_source
from vjepa2_ac.episode import Episode
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.request import EvaluationOptions, resolve_config
from vjepa2_ac.model.checkpoints import load_base
from vjepa2_ac.model.predictor import ActionConditionedPredictor
from vjepa2_ac.model.world_model import WorldModel, fingerprint
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.model_setup import load_for_planning
from vjepa2_ac.planning.settings import load_planning_config, warn_if_limits_exceed_data
from vjepa2_ac.runs.folder import read_run_config
from vjepa2_ac.runs.subject import load_subject
from vjepa2_ac.spaces import actions_from_states
from vjepa2_ac.training.loop import train

PLANNING = {"horizon": 2, "samples": 12, "iterations": 2, "planner": {"name": "cem", "options": {"elites": 4}}}


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


def test_run_plans_with_its_own_config(run: Path) -> None:
    subject = load_for_planning(str(run))
    assert subject.checkpoint_label == "step-00000010 (the best by error)"
    assert subject.config.planning.horizon == 2
    controller = Controller.of_subject(subject)
    images = np.random.default_rng(0).integers(0, 256, (2, 40, 64, 3), dtype=np.uint8)
    controller.reset(images[0])
    controller.act(images[1], STATE)
    assert controller.decision.plan.seed == 7
    assert len(controller.decision.plan.actions) == 2
    assert controller.crop == "square"
    assert Controller.of_subject(subject, seed=3).seed == 3


def test_named_checkpoint_is_used_for_planning(run: Path, base_folder: Path) -> None:
    newest, best, base = (
        prediction(load_for_planning(*arguments[:1], checkpoint=arguments[1]).world_model)
        for arguments in ((str(run), "newest"), (str(run), "selected"), (str(base_folder), "selected"))
    )
    torch.testing.assert_close(prediction(load_for_planning(str(run), checkpoint="10").world_model), best)
    assert not torch.allclose(newest, best, atol=1e-4)
    assert not torch.allclose(base, best, atol=1e-4)


def test_model_plans_with_and_without_a_config(make_config, base_folder: Path, tmp_path: Path) -> None:
    alone = load_for_planning(str(base_folder), overrides=["planning.samples=20", "seed=4"])
    assert (alone.config.planning.samples, alone.config.seed, alone.config.planning.horizon) == (20, 4, 1)
    path = tmp_path / "model.yaml"
    path.write_text(config_as_yaml(make_config(planning=PLANNING, model__dtype="bfloat16", training__precision="bf16")))
    reported = load_for_planning(str(base_folder), config=path, overrides=["planning.planner.options.elites=3"])
    assert (reported.config.planning.horizon, reported.config.planning.planner.options) == (2, {"elites": 3})
    assert next(reported.world_model.parameters()).dtype == torch.bfloat16


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"overrides": ["training.steps=3"]}, r"training\.steps=3: a setting that planning does not use"),
        ({"overrides": ["horizon=3"]}, r"did you mean planning\.horizon"),
        ({"overrides": ["planning.horizon=0"]}, r"planning\.horizon.*greater than or equal to 1"),
        ({"checkpoint": "best"}, "not the folder of a run"),
    ],
)
def test_invalid_planning_settings_raise(base_folder: Path, options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_for_planning(str(base_folder), **options)


VECTORS = {
    "data__states": "vector",
    "data__fields": {"state": ["steps/observation/joint_position", "steps/observation/gripper_position"]},
    "adapter__modules_to_save": ["state_encoder", "action_encoder"],
    "planning": {"samples": 8, "iterations": 2, "planner": {"name": "cem", "options": {"elites": 3}}, "horizon": 2},
}


def test_vector_run_plans_within_the_motions_of_its_data(make_config, reporter) -> None:
    """The states are joint angles and a gripper. No number changes more than in the training data."""
    folder = train(make_config(**VECTORS, training__steps=1), reporter)
    data_changes = json.loads((folder / "changes.json").read_text())["changes"]
    states = [episode.states for episode in episodes_of(folder)]
    expected = np.percentile(np.abs(np.concatenate([values[2:] - values[:-2] for values in states])), 99, axis=0)
    np.testing.assert_allclose(data_changes, expected, rtol=1e-6)
    controller = Controller.of_subject(load_for_planning(str(folder)))
    controller.reset(image(0))
    action = controller.act(image(1), states[0][0])
    assert action.shape == (8,)
    assert np.any(action)
    assert (np.abs(action) <= data_changes).all()
    np.testing.assert_allclose(controller.decision.states[1], states[0][0] + action, atol=1e-6)
    limited = Controller.of_subject(load_for_planning(str(folder), overrides=["planning.limits.axes=[0.01]"]))
    limited.reset(image(0))
    assert np.abs(limited.act(image(1), states[0][0])).max() <= 0.01
    with pytest.raises(InputError, match=r"state: 7 numbers .* Expected 8: state 0, state 1"):
        limited.act(image(1), np.zeros(7))
    for content, message in (('{"changes": [1.0, "far"]}', "one number of 0 or more"), ('{"changes": 3}', "found|3")):
        (folder / "changes.json").write_text(content)
        with pytest.raises(InputError, match=message):
            load_for_planning(str(folder))
    (folder / "changes.json").unlink()
    with pytest.raises(
        InputError, match=r"planning\.limits\.axes: data, but the model has no record.*of the 8 numbers"
    ):
        Controller.of_subject(load_for_planning(str(folder)))


def episodes_of(folder: Path) -> list[Episode]:
    source = open_source(read_run_config(folder).data)
    return [source.read(number) for number in range(len(source.infos()))]


ADAPTERS = {
    "lora": {"rank": 4},
    "dora": {"rank": 4, "dora": True, "modules_to_save": ["predictor_proj", "state_encoder"]},
    "none": {"kind": "none"},
}


@pytest.mark.parametrize("adapter", ADAPTERS.values(), ids=ADAPTERS)
def test_merged_run_has_the_dtype_of_its_base_and_fingerprints_of_the_trained_weights(
    make_config, adapter: dict
) -> None:
    config = make_config(adapter=adapter, model__dtype="bfloat16", training__precision="bf16")
    run = write_adapted_run(config)
    subject, trained = load_for_planning(str(run), checkpoint="newest"), load_subject(run, "newest").world_model
    assert type(subject.world_model.predictor) is ActionConditionedPredictor
    assert subject.world_model.adaptation is None
    assert {value.dtype for value in subject.world_model.parameters()} == {torch.bfloat16}
    torch.testing.assert_close(prediction(subject.world_model), prediction(trained.eval()), rtol=0, atol=0.1)
    reported = subject.as_dict()["model"]
    assert reported["encoder"] == trained.encoder_fingerprint()
    assert reported["base"] == load_base(config.model, seed=0).predictor_fingerprint()
    assert reported["predictor"] == fingerprint(trained.predictor.state_dict())
    assert reported["dtype"] == "bfloat16"


CHANGES_IN_DATA = [0.03, 0.02, 0.01, 0.0, 0.1, 0.2, 0.8]  # metres, radians, gripper position


@pytest.fixture
def run_with_data_limits(make_config) -> Path:
    """Return a run with recorded motions and the default limits of the gripper."""
    folder = write_adapted_run(make_config(planning=PLANNING))
    write_changes(folder)
    return folder


def write_changes(folder: Path, **changes: object) -> None:
    (folder / "changes.json").write_text(
        json.dumps({"percentile": 99, "changes": CHANGES_IN_DATA, "narrow": ""} | changes)
    )


def read_warnings(folder: Path, *overrides: str) -> tuple[str, ...]:
    return warn_if_limits_exceed_data(load_planning_config(str(folder), overrides=list(overrides)), folder)


def test_pose_run_records_data_limits_and_plans_within_them(make_config, reporter) -> None:
    folder = train(make_config(planning=PLANNING, training__steps=1), reporter)
    recorded = json.loads((folder / "changes.json").read_text())
    source = open_source(read_run_config(folder).data)
    states = [source.read(number).states for number in range(len(source.infos()))]
    strided_states = [trajectory[first::2] for trajectory in states for first in (0, 1)]
    expected = np.percentile(
        np.abs(np.concatenate([actions_from_states(trajectory) for trajectory in strided_states])), 99, axis=0
    )
    np.testing.assert_allclose(recorded["changes"], expected, atol=1e-9)
    assert recorded["percentile"] == 99
    subject = load_for_planning(
        str(folder), overrides=["planning.limits.xyz=data", "planning.limits.gripper_mode=held"]
    )
    limits = subject.config.planning.limits.xyz
    assert (np.array(recorded["changes"][:3]) - limits < 1e-4).all()
    assert not any("planning.limits" in warning for warning in subject.warnings)
    controller = Controller.of_subject(subject)
    controller.reset(image(0))
    action = controller.act(image(1), states[0][0])
    assert np.any(action)
    assert (np.abs(action[:3]) <= recorded["changes"][:3]).all()

    data_changes = PlanningConfig.model_validate({**PLANNING, "limits": {"xyz": "data"}})
    run_controller = Controller.of_run(load_subject(folder), data_changes)
    np.testing.assert_allclose(run_controller.space.upper[0, :3], limits, rtol=1e-6)
    options = EvaluationOptions(overrides=("planning.limits.xyz=data",))
    assert resolve_config(str(folder), options).planning.limits.xyz == limits


def test_run_without_recorded_motions_plans_but_rejects_data_limits(make_config, base_folder) -> None:
    folder = write_adapted_run(make_config(planning=PLANNING))
    assert load_for_planning(str(folder)).warnings == ()
    error = r"planning\.limits\.xyz: data, for a model or an older run.*such as planning\.limits\.xyz=\[0\.05.*inspect"
    for subject in (folder, base_folder):
        with pytest.raises(InputError, match=error):
            load_planning_config(str(subject), overrides=["planning.limits.xyz=data"])
    data_changes = PlanningConfig.model_validate({"limits": {"xyz": "data"}})
    with pytest.raises(InputError, match=error):
        Controller(load_subject(folder).world_model, data_changes)


def test_limits_beyond_the_training_data_are_logged_as_warnings(
    run_with_data_limits: Path, caplog: pytest.LogCaptureFixture
) -> None:
    subject = load_for_planning(str(run_with_data_limits), overrides=["planning.limits.xyz=[0.05,0.02,0.012]"])
    assert len(subject.warnings) == 1
    assert "planning.limits.xyz exceeds the motions in the training data of" in subject.warnings[0]
    assert "dx 5 (3) cm, dz 1.2 (1) cm (99th percentile" in subject.warnings[0]
    assert "Set planning.limits.xyz=data" in subject.warnings[0]
    assert subject.as_dict()["warnings"] == list(subject.warnings)
    assert [(record.levelno, record.getMessage()) for record in caplog.records] == [
        (logging.WARNING, subject.warnings[0])
    ]
    caplog.clear()
    Controller.of_run(load_subject(run_with_data_limits))
    assert "dx 5 (3) cm, dy 5 (2) cm, dz 5 (1) cm" in caplog.text
    caplog.clear()
    assert load_for_planning(str(run_with_data_limits), overrides=["planning.limits.xyz=data"]).warnings == ()
    assert not caplog.records
    write_changes(run_with_data_limits, changes=[0.03, 1e-9, 0.00009, *CHANGES_IN_DATA[3:]])
    assert load_for_planning(
        str(run_with_data_limits), overrides=["planning.limits.xyz=data"]
    ).config.planning.limits.xyz == (
        0.03,
        0,
        0,
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (3, "Expected one number of 0 or more"),
        ([*CHANGES_IN_DATA[:6], "far"], "Expected one number of 0 or more"),
        (CHANGES_IN_DATA[:6], "Expected 7 numbers: dx, dy"),
        ([30.0, *CHANGES_IN_DATA[1:]], "positions in metres"),
    ],
)
def test_invalid_recorded_motions_raise(run_with_data_limits: Path, changes: object, message: str) -> None:
    write_changes(run_with_data_limits, changes=changes)
    with pytest.raises(InputError, match=rf"changes\.json: .*{message}"):
        load_for_planning(str(run_with_data_limits))


def test_vector_limits_are_compared_by_component(make_config) -> None:
    config = make_config(data__states="vector", data__path="elsewhere", planning=PLANNING)
    folder = Path(config.run_dir)
    folder.mkdir()
    write_changes(folder, changes=[0.1, 0.02], narrow="1 of 2 numbers hardly move, 0 only one way")

    def compute_warnings(axes: tuple[float, ...]) -> tuple[str, ...]:
        limits = config.planning.limits.model_copy(update={"axes": axes})
        planning = config.planning.model_copy(update={"limits": limits})
        return warn_if_limits_exceed_data(config.model_copy(update={"planning": planning}), folder)

    assert compute_warnings((0.1, 0.02)) == (
        f"{folder} was trained on low-diversity data: 1 of 2 numbers hardly move, 0 only one way",
    )
    assert "planning.limits.axes exceeds" in compute_warnings((0.1,))[1]
    assert "state 1 0.1 (0.02) (99th percentile" in compute_warnings((0.1,))[1]
