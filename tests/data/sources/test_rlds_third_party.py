"""Third-party RLDS data sets: `init` proposes a config, and the config reads the true frames and states."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from rlds_sets import encoded, write_rlds_set
from synthetic import draw_frame, synthetic_states
from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.loading import parse_config
from vjepa2_ac.data.dataset import open_dataset
from vjepa2_ac.data.sources.indexed_source import open_source
from vjepa2_ac.init.draft_values import list_guesses, plain_values
from vjepa2_ac.init.recognize import read_properties

STEPS, EPISODES, SIZE = 12, 6, (24, 32)
IMAGE, STATE, NAME = "steps/observation/image", "steps/observation/state", "episode_metadata/file_path"
TRUE = [synthetic_states(STEPS, seed=seed) for seed in range(EPISODES)]
FRAMES = [np.stack([draw_frame(state, size=SIZE) for state in states]) for states in TRUE]


def write(folder: Path, *, images: Any = None, states: Any = None, kinds: Any = None, names: Any = None) -> Path:
    """Write six episodes; each argument but `kinds` is a function that returns features of an episode."""
    records = []
    for number in range(EPISODES):
        record = {"steps/is_first": np.arange(STEPS) == 0, IMAGE: [encoded(frame) for frame in FRAMES[number]]}
        record |= {STATE: TRUE[number]} if states is None else states(TRUE[number])
        record |= {} if images is None else images(number)
        record |= {NAME: [f"/data/{number}".encode()]} if names is None else names(number)
        records.append(record)
    features: dict[str, Any] = {"steps/is_first": ("bool", ()), IMAGE: ("uint8", (*SIZE, 3), "png")}
    features |= {STATE: ("float32", (7,))} if kinds is None else kinds
    features |= {name: "text" for name in records[0] if name == NAME}
    return write_rlds_set(folder, records, features)


def propose_config(folder: Path) -> tuple[DataConfig, dict[str, str]]:
    """Return the data config that `init` proposes, and the guessed values."""
    properties = read_properties(str(folder))
    data = {
        "source": "rlds",
        "path": str(folder),
        "states": properties.states,
        **plain_values(properties.config_values),
        "workers": 0,
    }
    values = {"run_dir": "none", "data": data, "model": {"base": "builtin:sim-tiny"}}
    return parse_config(values, where="init").data, list_guesses(properties.config_values)


def assert_true_states(config: DataConfig, *, tolerance: float = 1e-5) -> None:
    source = open_source(config)
    assert len(source.infos()) == EPISODES
    for number in range(EPISODES):
        read = source.read(number).states
        rotation_error = (
            Rotation.from_euler("xyz", read[:, 3:6]) * Rotation.from_euler("xyz", TRUE[number][:, 3:6]).inv()
        )
        assert np.abs(read[:, [0, 1, 2, 6]] - TRUE[number][:, [0, 1, 2, 6]]).max() < tolerance
        assert rotation_error.magnitude().max() < 1e-3


@pytest.mark.parametrize("mode", [None, "RGBA", "P", "L"])
def test_image_format_is_detected_from_content(mode: str | None, tmp_path: Path) -> None:
    folder = write(
        tmp_path / "set", images=lambda number: {IMAGE: [encoded(frame, mode=mode) for frame in FRAMES[number]]}
    )
    config, _ = propose_config(folder)
    read = open_source(config).read(2).read_frames([5, 0])
    expected = FRAMES[2][[5, 0]]
    if mode == "L":
        assert (read[..., 0] == read[..., 1]).all()
        assert (read[..., 0] == read[..., 2]).all()
    tolerance = {None: 0, "RGBA": 0, "P": 60, "L": 255}[mode]
    assert abs(read.astype(int) - expected).max() <= tolerance


@pytest.mark.parametrize(
    "names",
    [lambda _: {}, lambda _: {NAME: [b""]}, lambda _: {NAME: [b"same"]}],
    ids=["without metadata", "empty names", "equal names"],
)
def test_records_without_identity_feature_are_numbered(names: Any, tmp_path: Path) -> None:
    config, guessed = propose_config(write(tmp_path / "set", names=names))
    assert config.fields.identity == "record"
    assert "written again" in guessed["fields.identity"] or "rewriting the data set" in guessed["fields.identity"]
    assert_true_states(config)
    assert len({info.id for info in open_source(config).infos()}) == EPISODES
    assert len(open_dataset(config.model_copy(update={"frames": 3, "stride": 1})).windows("train"))


def convert_states(states: Float[np.ndarray, "steps 7"], rotation: str) -> Float[np.ndarray, "steps _"]:
    rotations = Rotation.from_euler("xyz", states[:, 3:6])
    numbers = {
        "quaternion_xyzw": rotations.as_quat(),
        "rotation_vector": rotations.as_rotvec(),
        "euler_xyz_degrees": np.rad2deg(states[:, 3:6]),
    }
    return np.concatenate([states[:, :3], numbers[rotation], states[:, 6:]], axis=1)


@pytest.mark.parametrize(
    ("states", "kinds", "expected"),
    [
        (
            lambda s: {"steps/observation/ee_pose": s[:, :6], "steps/observation/gripper_closed": s[:, 6] > 0.5},
            {"steps/observation/ee_pose": ("float32", (6,)), "steps/observation/gripper_closed": ("bool", ())},
            {"gripper_open": 0.0, "gripper_closed": 1.0},
        ),
        (lambda s: {STATE: np.c_[s[:, :6], 2 * s[:, 6] - 1]}, None, {"gripper_open": -1.0, "gripper_closed": 1.0}),
        (lambda s: {STATE: np.c_[s[:, :6], 0.08 * (1 - s[:, 6])]}, None, {"gripper_closed": 0.0}),
        (lambda s: {STATE: np.c_[1000 * s[:, :3], s[:, 3:]]}, None, {"position_unit": "mm"}),
        (lambda s: {STATE: convert_states(s, "euler_xyz_degrees")}, None, {"rotation": "euler_xyz_degrees"}),
        (
            lambda s: {STATE: convert_states(s, "quaternion_xyzw")},
            {STATE: ("float32", (8,))},
            {"rotation": "quaternion_xyzw"},
        ),
        (
            lambda s: {STATE: np.c_[s[:, :6], 0.04 * (1 - s[:, 6]), -0.04 * (1 - s[:, 6])]},
            {STATE: ("float32", (8,))},
            {"select": (0, 1, 2, 3, 4, 5, 6)},
        ),
    ],
    ids=["bool gripper", "gripper -1 to 1", "gripper in metres", "millimetres", "degrees", "quaternion", "LIBERO"],
)
def test_state_formats_are_proposed_and_read(
    states: Any, kinds: Any, expected: Mapping[str, Any], tmp_path: Path
) -> None:
    config, guessed = propose_config(write(tmp_path / "set", states=states, kinds=kinds))
    for key, value in expected.items():
        assert getattr(config.fields, key) == value, guessed
    if "bool" in str(kinds):
        closed = open_source(config).read(0).states[:, 6]
        assert np.array_equal(closed, TRUE[0][:, 6] > 0.5)
    elif "gripper_closed" in expected or "select" in expected:  # the open gripper's width is estimated from the data
        closed, true = open_source(config).read(0).states[:, 6], TRUE[0][:, 6]
        assert np.corrcoef(closed, true)[0, 1] > 0.999
    else:
        assert_true_states(config, tolerance=1e-3)
