"""A run keeps how far its data move in a model step; planning takes its limits from that, or warns beyond it."""

import json
import logging
from pathlib import Path

import numpy as np
import pytest

from adapted_run import write_adapted_run
from decisions import image
from vjepa2_ac.config.planning import PlanningConfig
from vjepa2_ac.data.sources.indexed_source import open_source
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.request import EvaluationOptions, settle
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.model_setup import load_to_plan
from vjepa2_ac.planning.settings import planning_settings, warn_beyond_taught
from vjepa2_ac.runs.folder import read_run_config
from vjepa2_ac.runs.subject import load_subject
from vjepa2_ac.spaces import actions_from_states
from vjepa2_ac.training.loop import train

PLANNING = {"samples": 12, "iterations": 2, "horizon": 2, "planner": {"name": "cem", "options": {"elites": 4}}}
TAUGHT = [0.03, 0.02, 0.01, 0.0, 0.1, 0.2, 0.8]  # metres, radians, closedness


@pytest.fixture
def run(make_config) -> Path:
    """Return a run that was taught so, within the default gripper's limits."""
    folder = write_adapted_run(make_config(planning=PLANNING))
    note(folder)
    return folder


def note(folder: Path, **changes: object) -> None:
    (folder / "changes.json").write_text(json.dumps({"percentile": 99, "changes": TAUGHT, "narrow": ""} | changes))


def warnings_of(folder: Path, *overrides: str) -> tuple[str, ...]:
    return warn_beyond_taught(planning_settings(str(folder), overrides=list(overrides)), folder)


def test_a_run_of_poses_keeps_what_it_was_taught_and_plans_within_it(make_config, reporter) -> None:
    folder = train(make_config(planning=PLANNING, training__steps=1), reporter)
    noted = json.loads((folder / "changes.json").read_text())
    source = open_source(read_run_config(folder).data)
    states = [source.read(number).states for number in range(len(source.infos()))]
    pieces = [one[first::2] for one in states for first in (0, 1)]
    expected = np.percentile(np.abs(np.concatenate([actions_from_states(one) for one in pieces])), 99, axis=0)
    np.testing.assert_allclose(noted["changes"], expected, atol=1e-9)
    assert noted["percentile"] == 99
    session = load_to_plan(str(folder), overrides=["planning.limits.xyz=data", "planning.limits.gripper_mode=held"])
    limits = session.config.planning.limits.xyz
    assert (np.array(noted["changes"][:3]) - limits < 1e-4).all()
    assert not any("planning.limits" in warning for warning in session.warnings)
    controller = Controller.of_subject(session)
    controller.reset(image(0))
    action = controller.act(image(1), states[0][0])
    assert np.any(action)
    assert (np.abs(action[:3]) <= noted["changes"][:3]).all()

    taught = PlanningConfig.model_validate({**PLANNING, "limits": {"xyz": "data"}})
    of_run = Controller.of_run(load_subject(folder), taught)
    np.testing.assert_allclose(of_run.space.upper[0, :3], limits, rtol=1e-6)
    asked = EvaluationOptions(overrides=("planning.limits.xyz=data",))
    assert settle(str(folder), asked).planning.limits.xyz == limits


def test_a_run_without_it_plans_as_before_and_its_limits_cannot_be_those_of_the_data(make_config, base_folder) -> None:
    folder = write_adapted_run(make_config(planning=PLANNING))
    assert load_to_plan(str(folder)).warnings == ()
    error = r"planning\.limits\.xyz: data, for a model or an older run.*such as planning\.limits\.xyz=\[0\.05.*inspect"
    for subject in (folder, base_folder):
        with pytest.raises(InputError, match=error):
            planning_settings(str(subject), overrides=["planning.limits.xyz=data"])
    taught = PlanningConfig.model_validate({"limits": {"xyz": "data"}})
    with pytest.raises(InputError, match=error):
        Controller(load_subject(folder).world_model, taught)


def test_whoever_loads_a_run_is_warned_of_limits_that_leave_what_it_was_taught(
    run: Path, caplog: pytest.LogCaptureFixture
) -> None:
    session = load_to_plan(str(run), overrides=["planning.limits.xyz=[0.05,0.02,0.012]"])
    assert len(session.warnings) == 1
    assert "planning.limits.xyz exceeds the motions in the training data of" in session.warnings[0]
    assert "dx 5 (3) cm, dz 1.2 (1) cm (99th percentile" in session.warnings[0]
    assert "planning.limits.xyz=data stays within" in session.warnings[0]
    assert session.as_dict()["warnings"] == list(session.warnings)
    assert [(one.levelno, one.getMessage()) for one in caplog.records] == [(logging.WARNING, session.warnings[0])]
    caplog.clear()
    Controller.of_run(load_subject(run))
    assert "dx 5 (3) cm, dy 5 (2) cm, dz 5 (1) cm" in caplog.text
    caplog.clear()
    assert load_to_plan(str(run), overrides=["planning.limits.xyz=data"]).warnings == ()
    assert not caplog.records
    note(run, changes=[0.03, 1e-9, 0.00009, *TAUGHT[3:]])
    assert load_to_plan(str(run), overrides=["planning.limits.xyz=data"]).config.planning.limits.xyz == (0.03, 0, 0)


WITHIN = "planning.limits.xyz=[0.033,0.02,0]"


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        (3, "needed: a number of 0 or more"),
        ([*TAUGHT[:6], "far"], "needed: a number of 0 or more"),
        (TAUGHT[:6], "needed: 7 numbers: dx, dy"),
        ([30.0, *TAUGHT[1:]], "positions in metres"),
    ],
)
def test_a_note_that_says_no_limits_is_an_error(run: Path, changes: object, complaint: str) -> None:
    note(run, changes=changes)
    with pytest.raises(InputError, match=rf"changes\.json: .*{complaint}"):
        load_to_plan(str(run))


def test_vectors_are_compared_number_by_number(make_config) -> None:
    config = make_config(data__states="vector", data__path="elsewhere", planning=PLANNING)
    folder = Path(config.run_dir)
    folder.mkdir()
    note(folder, changes=[0.1, 0.02], narrow="1 of 2 numbers hardly move, 0 only one way")

    def found(axes: tuple[float, ...]) -> tuple[str, ...]:
        limits = config.planning.limits.model_copy(update={"axes": axes})
        planning = config.planning.model_copy(update={"limits": limits})
        return warn_beyond_taught(config.model_copy(update={"planning": planning}), folder)

    assert found((0.1, 0.02)) == (f"{folder} learned from narrow data: 1 of 2 numbers hardly move, 0 only one way",)
    assert "planning.limits.axes exceeds" in found((0.1,))[1]
    assert "state 1 0.1 (0.02) (99th percentile" in found((0.1,))[1]
