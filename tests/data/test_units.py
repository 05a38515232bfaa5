"""Positions and angles in other units: the error names the config key, and the data can be read with that key."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_sets import STATE, Recorded, recorded, write_v30
from synthetic import synthetic_states
from vjepa2_ac.config import LeRobotData, LeRobotFields
from vjepa2_ac.data.poses import convert_poses
from vjepa2_ac.data.sources.lerobot import LeRobotSource
from vjepa2_ac.errors import InputError

UNIT_KEYS = {"position_unit": "mm", "rotation": "euler_xyz_degrees"}
SCALE = np.array([1000.0] * 3 + [180 / np.pi] * 3)


def write_lerobot(folder: Path) -> Path:
    """Write a data set in millimetres and degrees."""
    episode = recorded(0, 12)
    pose = (episode.columns[STATE[0]] * SCALE).astype(np.float32)
    return write_v30(folder, [Recorded({**episode.columns, STATE[0]: pose}, episode.frames)])


def test_lerobot_unit_errors_name_the_keys_that_fix_them(tmp_path: Path) -> None:
    def open_source(**fields: Any) -> LeRobotSource:
        return LeRobotSource(LeRobotData(path=str(folder), lerobot=fields, disk_cache={"dir": str(tmp_path / "cache")}))

    folder = write_lerobot(tmp_path / "set")
    with pytest.raises(InputError) as raised:
        open_source().infos()
    assert raised.value.fix.startswith(
        "The positions look like millimetres: set data.lerobot.position_unit: mm."
        " The angles look like degrees: set data.lerobot.rotation: euler_xyz_degrees. Check data.lerobot: state, "
    )
    with pytest.raises(InputError, match="look like degrees") as raised:
        open_source(position_unit="mm").infos()
    assert "millimetres" not in raised.value.fix
    np.testing.assert_allclose(open_source(**UNIT_KEYS).read(0).states, synthetic_states(12, seed=0), atol=1e-5)


def test_configured_unit_is_not_rejected() -> None:
    numbers = synthetic_states(12, seed=0) * ([1e6] * 3 + [180 / np.pi] * 3 + [1])
    fields = LeRobotFields(position_unit="mm", rotation="rotation_vector")
    with pytest.raises(InputError, match="within 5 m") as raised:
        convert_poses(numbers, fields, "here", section="data.lerobot")
    assert raised.value.fix.startswith("Check data.lerobot: ")
