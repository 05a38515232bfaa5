"""Robots without poses: every source that supports vectors returns them unchanged, at any width."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from clips import clip_at
from lerobot_sets import Recorded, recorded, write_v21, write_v30
from vector_sets import vectors, write_vectors
from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.sources.indexed_source import open_source
from vjepa2_ac.episode import Batch, Widths
from vjepa2_ac.errors import InputError
from vjepa2_ac.inspection.check import batch_findings
from vjepa2_ac.inspection.sheet import plot_dataset
from vjepa2_ac.inspection.statistics import inspect_dataset
from vjepa2_ac.spaces import Spaces

JOINTS = ("steps/observation/joint_position", "steps/observation/gripper_position")
VELOCITIES = ("steps/action_dict/joint_velocity", "steps/action_dict/gripper_velocity")


def vector_config(path: object, **changes: Any) -> DataConfig:
    values = {
        "source": "npz", "path": str(path), "states": "vector", "frames": 3, "stride": 2, "workers": 0,
        "validation_share": 0.3, "test_share": 0.0,
    }  # fmt: skip
    return DataConfig.model_validate_json(json.dumps(values | changes))


def join_recorded(operation: str | None, **changes: Any) -> dict[str, Any]:
    return {"actions": "recorded", "join_actions": operation} | changes


@pytest.mark.parametrize("width", [1, 7, 14])
def test_vector_states_are_the_stored_numbers_and_actions_their_differences(tmp_path: Path, width: int) -> None:
    dataset = open_dataset(vector_config(write_vectors(tmp_path, width=width)))
    assert dataset.widths == Widths(width, width)
    clip = clip_at(dataset, 0, 3)
    states = vectors(24, width, seed=0)
    np.testing.assert_array_equal(clip.states, states[[3, 5, 7]].astype(np.float32))
    np.testing.assert_array_equal(clip.actions, (states[[5, 7]] - states[[3, 5]]).astype(np.float32))


@pytest.mark.parametrize(("operation", "join"), [("sum", np.sum), ("mean", np.mean), ("last", lambda x, **_: x[:, -1])])
def test_commands_of_a_model_step_are_joined_control_steps(
    tmp_path: Path, operation: str, join: Callable[..., np.ndarray]
) -> None:
    dataset = open_dataset(vector_config(write_vectors(tmp_path, width=14, action_width=5), **join_recorded(operation)))
    assert dataset.widths == Widths(14, 5)
    clip = clip_at(dataset, 1, 4)
    states = vectors(24, 5, seed=1001)  # of control steps 4, 5 and 6, 7
    np.testing.assert_array_equal(clip.actions, join(states[4:8].reshape(2, 2, 5), axis=1).astype(np.float32))


def test_rlds_reads_the_configured_features(droid: Path) -> None:
    fields = {"state": JOINTS, "action": VELOCITIES}
    config = vector_config(droid, source="rlds", fields=fields, **join_recorded("mean"))
    dataset = open_dataset(config)
    assert dataset.widths == Widths(8, 8)
    episode = dataset.source.read(0)
    steps = np.arange(12)
    joints = np.sin(steps[:, None] / 15.0 + np.arange(7))
    np.testing.assert_allclose(episode.states[:, :7], joints, atol=1e-6)
    np.testing.assert_allclose(episode.commands[:, :7], np.gradient(joints, axis=0), atol=1e-6)
    mistyped = config.model_copy(update={"fields": config.fields.model_copy(update={"action": ("steps/actoin",)})})
    with pytest.raises(InputError, match="Did you mean steps/action"):
        open_dataset(mistyped)


def test_rlds_vector_width_is_unknown_without_a_flag_per_step(
    write_with_changed_record: Callable[[Callable[[Any], None]], Path],
) -> None:
    folder = write_with_changed_record(lambda features: features.pop("steps/is_first"))
    with pytest.raises(InputError, match="steps/is_first"):
        open_dataset(vector_config(folder, source="rlds", fields={"state": JOINTS}))


def bimanual(number: int, steps: int) -> Recorded:
    columns = {
        "observation.state": vectors(steps, 14, seed=number).astype(np.float32),
        "action": vectors(steps, 16, seed=50 + number).astype(np.float32),
    }
    return Recorded(columns, recorded(number, steps).frames)


@pytest.mark.parametrize("write", [write_v30, write_v21], ids=["v3.0", "v2.1"])
def test_lerobot_reads_the_configured_columns(tmp_path: Path, write: Callable[..., Path]) -> None:
    folder = write(tmp_path / "set", [bimanual(number, 12) for number in range(4)])
    lerobot = {"state": ["observation.state"], "success": None}
    dataset = open_dataset(vector_config(folder, source="lerobot", lerobot=lerobot, **join_recorded("last")))
    assert dataset.widths == Widths(14, 16)
    clip = clip_at(dataset, 2, 1)
    np.testing.assert_array_equal(clip.states, vectors(12, 14, seed=2)[[1, 3, 5]].astype(np.float32))
    np.testing.assert_array_equal(clip.actions, vectors(12, 16, seed=52)[[2, 4]].astype(np.float32))
    selecting = open_source(vector_config(folder, source="lerobot", lerobot=lerobot | {"select": [13, 0]}))
    np.testing.assert_array_equal(selecting.read(0).states, vectors(12, 14, seed=0)[:, [13, 0]].astype(np.float32))
    mistyped = vector_config(
        folder, source="lerobot", lerobot=lerobot | {"action": ["actions"]}, **join_recorded("last")
    )
    with pytest.raises(InputError, match=r"data\.lerobot\.action.*Did you mean action"):
        open_dataset(mistyped)


def test_episode_of_another_width_is_broken(tmp_path: Path) -> None:
    write_vectors(tmp_path, width=14)
    write_vectors(tmp_path / "other", width=8, episodes=1)
    with pytest.raises(InputError, match=r"other.*8 numbers per state.*14 numbers per state, as in most"):
        open_dataset(vector_config(tmp_path))


def test_missing_or_short_recorded_commands_raise(tmp_path: Path) -> None:
    write_vectors(tmp_path / "none", width=8)
    with pytest.raises(InputError, match=r"actions: no such array"):
        open_dataset(vector_config(tmp_path / "none", **join_recorded("sum")))
    write_vectors(tmp_path / "few", width=8, actions=np.zeros((23, 3)))
    with pytest.raises(InputError, match=r"actions: shape \(23, 3\).*24 x any"):
        open_dataset(vector_config(tmp_path / "few", **join_recorded("sum")))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"source": "droid_raw"}, "source droid_raw: only for poses"),
        ({"pose_frame": "camera"}, "pose_frame camera: only for poses"),
        ({"idle": {"rule": "motion"}}, "idle.rule motion: only for poses"),
        ({"source": "rlds", "fields": {"gripper_open": 0.5}}, "fields.gripper_open"),
        ({"source": "lerobot", "lerobot": {"rotation": "quaternion_wxyz"}}, "lerobot.rotation"),
        ({"source": "lerobot", "lerobot": {"gripper_open": 0.08}}, "lerobot.gripper_open"),
        ({"actions": "recorded"}, "needs join_actions. Set it to sum"),
        ({"actions": "recorded", "stride": "auto"}, "needs join_actions. Set it to sum"),
        ({"states": "pose", "actions": "recorded", "join_actions": "sum"}, "needs states: vector"),
        ({"join_actions": "sum"}, "join_actions is only for actions: recorded"),
        ({"fields": {"gripper_open": 0.5}}, "data.fields: only for source rlds, and this is source npz"),
    ],
)
def test_vector_config_that_needs_poses_or_is_incomplete_raises(changes: dict[str, Any], message: str) -> None:
    values = {"path": "d", "source": "npz", "states": "vector"} | changes
    with pytest.raises(InputError, match=message):
        parse_config({"run_dir": "r", "model": {"base": "b"}, "data": values}, where="here")


FIVE_NUMBERS = Spaces.from_widths(Widths(5, 5), "difference")


def batch(states: np.ndarray, actions: np.ndarray | None = None) -> Batch:
    state_numbers = states.astype(np.float32)[None]
    differences = np.diff(state_numbers, axis=1) if actions is None else actions.astype(np.float32)[None]
    frames = torch.randint(0, 255, (1, len(states), 4, 4, 3), generator=torch.Generator().manual_seed(0))
    return Batch(
        frames.to(torch.uint8), torch.from_numpy(state_numbers), torch.from_numpy(differences), None, ("e",), (0,)
    )


@pytest.mark.parametrize(
    ("states", "about", "level", "words"),
    [
        (vectors(9, 5, seed=0) * [1, 0, 1, 1, 0], "states", "warning", "1, 4 (from 0) never change"),
        (vectors(9, 5, seed=0) * [1, 1, 4096, 1, 1], "states", "warning", "numbers 2 (from 0) are large"),
        (vectors(9, 5, seed=0) * 0, "states", "error", "none of the numbers ever changes"),
        (vectors(9, 5, seed=0) * 0, "actions", "error", "nothing to learn from"),
    ],
)
def test_check_reports_constant_states_and_zero_actions(states: np.ndarray, about: str, level: str, words: str) -> None:
    findings = {finding.about: finding for finding in batch_findings([batch(states)], FIVE_NUMBERS)}
    assert findings[about].level == level
    assert words in findings[about].text


@pytest.mark.usefixtures("drawn")
def test_inspection_reports_a_range_for_each_number_of_a_vector(tmp_path: Path) -> None:
    dataset = open_dataset(vector_config(write_vectors(tmp_path / "set", width=14)))
    inspection = inspect_dataset(dataset)
    metrics = json.loads(json.dumps(inspection.values))
    assert len(metrics["ranges"]) == 14
    assert "gripper" not in metrics
    assert [candidate["stride"] for candidate in metrics["per_model_step"]] == [3, 5, 10]
    assert inspection.summary["states"].startswith("14 numbers: -")
    assert plot_dataset(inspection, tmp_path / "sheet.png").stat().st_size > 10_000
