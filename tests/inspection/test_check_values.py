"""The values that `data check` prints are pinned: on a small set, and on real ones where they are present."""

import re
from pathlib import Path

import pytest

from moving_arms import spot_frames, spot_states, write_spots
from synthetic import write_synthetic_droid
from vjepa2_ac.config import DataConfig
from vjepa2_ac.inspection.check import check_data

Values = dict[str, tuple[str, list[float]]]  # by name: level and numbers
WITH_TIMES = {"source", "index", "timing"}


def values_of(batch_size: int, **values: object) -> Values:
    config = DataConfig.model_validate({"validation_share": 0.2, "test_share": 0.2, "workers": 0} | values)
    return {
        one.about: (one.level, [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?", one.text)])
        for one in check_data(config, batch_size=batch_size)
        if one.about not in WITH_TIMES
    }


def require(found: Values, pinned: Values) -> None:
    """Compare levels and numbers; other checks may have been added."""
    for name, (level, numbers) in pinned.items():
        assert found[name][0] == level, name
        assert found[name][1] == pytest.approx(numbers, abs=0.011), name


def test_values_of_a_moving_spot(tmp_path: Path) -> None:
    episodes = [(states, spot_frames(states)) for states in map(spot_states, range(10))]
    folder = write_spots(tmp_path / "set", episodes)
    pinned: Values = {
        "train": ("ok", [240, 3, 4, 6]),
        "validation": ("ok", [120, 3, 4, 3]),
        "test": ("warning", [1, 5, 10]),
        "duplicates": ("ok", []),
        "batch": ("ok", [2, 3, 24, 32, 3, 8, 2, 3, 7, 2, 2, 7]),
        "pixels": ("ok", [20, 229, 58]),
        "frames": ("ok", [0, 64]),
        "position": ("ok", [0.259, 0.993, -0.514, 0.631, 0.163, 0.455]),
        "rotation": ("ok", [0, 3.14, 1.2, 10, 1.8, 50, 2.3, 90, 2.5, 99]),
        "gripper": ("ok", [0, 1, 0, 1]),
        "actions": ("ok", [4.23, 10, 6.52, 50, 8.1, 90, 9.09, 99]),
        "speed": ("ok", [0.47, 0.22, 10, 10]),
        "padding": ("ok", [10, 10]),
        "rotation format": ("skipped", [3, 0]),
        "episode ends": ("ok", [16, 10]),
        "directions": ("warning", [48, 70, 0.27, 0, 1]),
        "axes": ("ok", [99, 9.3, 32, 63, 8, 38, 55, 2.8, 28, 60, 69]),
        "coverage": ("warning", [48, -0.2, -0.2, 1]),
        "agreement": ("ok", [10, 0.92, 0.09]),
    }
    require(values_of(2, source="npz", path=str(folder), frames=3, stride=4), pinned)


def test_values_of_drawn_demonstrations(tmp_path: Path) -> None:
    folder = write_synthetic_droid(tmp_path / "1.0.0", episodes=8, steps=40, size=(36, 64))
    pinned: Values = {
        "train": ("ok", [128, 3, 4, 4]),
        "validation": ("ok", [96, 3, 4, 3]),
        "test": ("warning", [1, 5, 8]),
        "duplicates": ("ok", []),
        "batch": ("ok", [2, 3, 36, 49, 3, 8, 2, 3, 7, 2, 2, 7]),
        "pixels": ("ok", [0, 255, 72]),
        "frames": ("ok", [0, 64]),
        "position": ("ok", [0.351, 0.65, -0.25, 0.25, 0.2, 0.5]),
        "rotation": ("ok", [-3.13, 3.14, 2.5, 10, 6.8, 50, 9.1, 90, 9.6, 99]),
        "gripper": ("ok", [0, 1, 0, 1]),
        "actions": ("ok", [3.88, 10, 6.4, 50, 9.44, 90, 10.56, 99]),
        "speed": ("ok", [0.4, 0.65, 8, 8]),
        "padding": ("ok", [8, 8]),
        "rotation format": ("ok", [12, 12]),
        "episode ends": ("ok", [16, 8]),
        "directions": ("skipped", [100, 72, 71, 70, 0.23, 0, 1]),
        "axes": ("ok", [99, 5.7, 50, 39, 9.5, 36, 58, 5.8, 32, 58, 34]),
        "coverage": ("skipped", [100, 72]),
        "agreement": ("skipped", [8, 0.18, 0.1]),
    }
    require(values_of(2, path=str(folder), frames=3, stride=4), pinned)


# The larger data sets, whose values were the same before the sentences were rewritten.


def test_values_of_an_excerpt_of_droid(shared: Path) -> None:
    folder = shared / "data/droid_rlds/r2d2_faceblur/1.0.0"
    pinned: Values = {
        "train": ("ok", [42, 4, 2, 1]),
        "validation": ("ok", [84, 4, 2, 1]),
        "test": ("warning", [1, 5, 3]),
        "duplicates": ("ok", []),
        "batch": ("ok", [2, 4, 180, 243, 3, 8, 2, 4, 7, 2, 3, 7]),
        "pixels": ("ok", [26, 229, 131]),
        "frames": ("ok", [0, 15]),
        "position": ("ok", [0.403, 0.5, -0.1, -0.045, 0.303, 0.35]),
        "rotation": ("ok", [-3.14, 3.14, 0.7, 10, 1.1, 50, 1.4, 90, 1.4, 99]),
        "gripper": ("ok", [0.53, 1, 0, 1]),
        "actions": ("ok", [0.48, 10, 0.64, 50, 1.03, 90, 1.09, 99]),
        "speed": ("ok", [0.08, 0.18, 3, 3]),
        "padding": ("ok", [3, 3]),
        "rotation format": ("ok", [7, 7]),
        "episode ends": ("ok", [16, 3]),
        "directions": ("skipped", [100, 84, 42, 70, 0.63, 0, 1]),
        "axes": ("ok", [99, 0.7, 1, 31, 0.7, 44, 0, 0.7, 27, 14, 0]),
        "coverage": ("skipped", [100, 84]),
        "agreement": ("skipped", [8, 8, 3, 63]),
    }
    require(values_of(2, path=str(folder), frames=4, stride=2), pinned)


def test_values_of_an_excerpt_of_bridge(shared: Path) -> None:
    folder = shared / "data/bridge_rlds/bridge_dataset/1.0.0"
    fields = {
        "state": ("steps/observation/state",), "gripper_open": 1.0, "gripper_closed": 0.0,
        "identity": ("episode_metadata/file_path", "episode_metadata/episode_id"),
        "cameras": {"image_0": "steps/observation/image_0"}, "control_rate_hz": 5.0,
    }  # fmt: skip
    pinned: Values = {
        "train": ("ok", [105, 4, 1, 15]),
        "validation": ("ok", [35, 4, 1, 5]),
        "test": ("ok", [35, 4, 1, 5]),
        "duplicates": ("ok", []),
        "batch": ("ok", [8, 4, 64, 64, 3, 8, 8, 4, 7, 8, 3, 7]),
        "pixels": ("ok", [0, 255, 120]),
        "frames": ("ok", [0, 45]),
        "position": ("ok", [0.225, 0.332, -0.104, 0.117, 0.06, 0.217]),
        "rotation": ("ok", [-0.73, 0.35, 0.6, 10, 2.2, 50, 6.8, 90, 13.7, 99]),
        "gripper": ("ok", [-0.01, 0.74, 0, 1]),
        "actions": ("ok", [0.34, 10, 0.99, 50, 1.58, 90, 1.92, 99]),
        "speed": ("ok", [0.15, 1.2, 25, 25]),
        "padding": ("ok", [25, 25]),
        "rotation format": ("skipped", [3, 0]),
        "episode ends": ("ok", [16, 24]),
        "directions": ("warning", [41, 70, 0.6, 0, 1]),
        "axes": ("ok", [99, 1.7, 4, 20, 1.7, 12, 5, 1.8, 50, 6, 15]),
        "coverage": ("warning", [41, -0.4, 0.2, 0.9]),
        "agreement": ("ok", [24, 0.69, 0.37]),
    }
    require(values_of(8, path=str(folder), frames=4, stride=1, fields=fields), pinned)


def test_values_of_a_lerobot_set(shared: Path) -> None:
    columns = {
        "state": ("observation.state",), "cameras": {"front": "observation.images.front"},
        "success": None,
    }  # fmt: skip
    pinned: Values = {
        "train": ("ok", [136, 4, 2, 3]),
        "validation": ("ok", [35, 4, 2, 1]),
        "test": ("warning", [1, 5, 5]),
        "duplicates": ("ok", []),
        "batch": ("ok", [2, 4, 120, 160, 3, 8, 2, 4, 7, 2, 3, 7]),
        "pixels": ("ok", [0, 255, 120]),
        "frames": ("ok", [0, 89]),
        "position": ("ok", [0.3, 0.5, -0.1, 0.1, 0.25, 0.35]),
        "rotation": ("ok", [-3.14, 3.14, 0.8, 10, 1.4, 50, 1.8, 90, 1.8, 99]),
        "gripper": ("ok", [0, 1, 0, 1]),
        "actions": ("ok", [1.11, 10, 2.08, 50, 2.71, 90, 3.01, 99]),
        "speed": ("ok", [0.23, 0.24, 5, 5]),
        "padding": ("ok", [5, 5]),
        "rotation format": ("ok", [9, 9]),
        "episode ends": ("ok", [16, 5]),
        "directions": ("warning", [57, 70, 0.41, 0, 1]),
        "axes": ("ok", [99, 2, 44, 39, 1.4, 73, 1, 2, 44, 39, 0]),
        "coverage": ("warning", [57, 0.1, 1, 0.1]),
        "agreement": ("skipped", [8, 8, 5, 47]),
    }
    values = {"source": "lerobot", "path": str(shared / "data/lerobot_v30"), "frames": 4, "stride": 2}
    require(values_of(2, lerobot=columns, **values), pinned)
