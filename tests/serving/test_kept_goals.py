"""Goals that a server keeps: pictures and folders of goals, each by its name."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from served import image
from vjepa2_ac.errors import InputError
from vjepa2_ac.planning.goals import SubGoal, write_goals
from vjepa2_ac.serving.about import read_kept_goals


def pick(folder: Path) -> Path:
    goals = (SubGoal(image(1), "grasp", at_most=4, gripper="held"), SubGoal(image(2), "lift"))
    write_goals(folder, goals)
    return folder


def test_a_picture_has_its_own_name_and_an_order_of_goals_its_folders(tmp_path: Path) -> None:
    Image.fromarray(image(5)).save(tmp_path / "cup.png")
    Image.fromarray(image(6)).save(tmp_path / "box.JPG")
    pick(tmp_path / "pick")
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "empty").mkdir()
    kept = read_kept_goals(tmp_path)
    assert sorted(kept) == ["box", "cup", "pick"]
    np.testing.assert_array_equal(kept["cup"][0].image, image(5))
    assert [(goal.name, goal.at_most, goal.gripper) for goal in kept["pick"]] == [
        ("grasp", 4, "held"),
        ("lift", None, None),
    ]
    assert list(read_kept_goals(tmp_path / "pick")) == ["pick"]


def test_what_is_no_goal_is_told(tmp_path: Path) -> None:
    for place, error in ((tmp_path / "none", "no such folder"), (tmp_path, "no goal. needed: pictures")):
        with pytest.raises(InputError, match=error):
            read_kept_goals(place)
    Image.fromarray(image(5)).save(tmp_path / "cup.png")
    Image.fromarray(image(5)).save(tmp_path / "cup.jpg")
    with pytest.raises(InputError, match="two goals named 'cup'"):
        read_kept_goals(tmp_path)
    (tmp_path / "cup.jpg").write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"cup\.jpg"):
        read_kept_goals(tmp_path)
    with pytest.raises(InputError, match="a file"):
        read_kept_goals(tmp_path / "cup.png")
