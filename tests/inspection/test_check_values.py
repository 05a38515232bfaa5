"""`data check` prints the expected values for a small data set."""

import re
from pathlib import Path

import pytest

from moving_arms import spot_frames, spot_states, write_spots
from vjepa2_ac.config import DataConfig
from vjepa2_ac.inspection.check import check_data

Values = dict[str, tuple[str, list[float]]]  # by name: level and numbers
WITH_TIMES = {"source", "index", "timing"}


def values_of(batch_size: int, **values: object) -> Values:
    config = DataConfig.model_validate({"validation_share": 0.2, "test_share": 0.2, "workers": 0} | values)
    return {
        finding.about: (finding.level, [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?", finding.text)])
        for finding in check_data(config, batch_size=batch_size)
        if finding.about not in WITH_TIMES
    }


def require(actual: Values, pinned: Values) -> None:
    """Compare levels and numbers; other checks may have been added."""
    for name, (level, numbers) in pinned.items():
        assert actual[name][0] == level, name
        assert actual[name][1] == pytest.approx(numbers, abs=0.011), name


def test_values_of_a_moving_spot_equal_the_pinned_values(tmp_path: Path) -> None:
    episodes = [(states, spot_frames(states)) for states in map(spot_states, range(10))]
    folder = write_spots(tmp_path / "set", episodes)
    pinned: Values = {
        "train": ("ok", [240, 3, 4, 6]),
        "validation": ("ok", [120, 3, 4, 3]),
        "test": ("warning", [1, 5]),
        "duplicates": ("ok", []),
        "batch": ("ok", [2, 3, 24, 32, 3, 8, 2, 3, 7, 2, 2, 7]),
        "pixels": ("ok", [20, 229, 58]),
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
