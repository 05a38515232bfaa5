"""Named goals of a server: images and folders with goal sequences."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from served import image
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.goals import SubGoal, write_goals
from vjepa2_ac.serving.metadata import read_named_goals


def write_pick_goals(folder: Path) -> Path:
    goals = (SubGoal(image(1), "grasp", at_most=4, gripper="held"), SubGoal(image(2), "lift"))
    write_goals(folder, goals)
    return folder


def test_goal_name_is_the_image_stem_or_the_folder_name(tmp_path: Path) -> None:
    Image.fromarray(image(5)).save(tmp_path / "cup.png")
    Image.fromarray(image(6)).save(tmp_path / "box.JPG")
    write_pick_goals(tmp_path / "pick")
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "empty").mkdir()
    goals = read_named_goals(tmp_path)
    assert sorted(goals) == ["box", "cup", "pick"]
    np.testing.assert_array_equal(goals["cup"][0].image, image(5))
    assert [(goal.name, goal.at_most, goal.gripper) for goal in goals["pick"]] == [
        ("grasp", 4, "held"),
        ("lift", None, None),
    ]
    assert list(read_named_goals(tmp_path / "pick")) == ["pick"]


def test_invalid_goal_folder_raises_with_the_reason(tmp_path: Path) -> None:
    for folder, error in ((tmp_path / "none", "no such folder"), (tmp_path, "no goals.*images")):
        with pytest.raises(InputError, match=error):
            read_named_goals(folder)
    Image.fromarray(image(5)).save(tmp_path / "cup.png")
    Image.fromarray(image(5)).save(tmp_path / "cup.jpg")
    with pytest.raises(InputError, match="two goals named 'cup'"):
        read_named_goals(tmp_path)
    (tmp_path / "cup.jpg").write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"cup\.jpg"):
        read_named_goals(tmp_path)
    with pytest.raises(InputError, match="a file"):
        read_named_goals(tmp_path / "cup.png")
