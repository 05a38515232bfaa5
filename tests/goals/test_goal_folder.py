"""Goal folders survive write and read, and invalid folders raise."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from decisions import image
from vjepa2_ac.errors import InputError, UserError
from vjepa2_ac.media.images import encode_png
from vjepa2_ac.planning.goals import GOALS_FILE, SubGoal, read_goal_folder, write_goals

GOALS = (
    SubGoal(image(1), "before closing", 2, 8, 0.5, "held"),
    SubGoal(image(2), "closed", 1, 4, None, "close"),
    SubGoal(image(3), "end", 1, None, 0.4),
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_goals(tmp_path / "goals", GOALS, frames=(8, 12, 30), origin={"by": "me"})
    return tmp_path / "goals"


def settings(goal: SubGoal) -> tuple:
    return goal.name, goal.at_least, goal.at_most, goal.share, goal.gripper


def test_goals_survive_write_and_read(folder: Path) -> None:
    goals = read_goal_folder(folder)
    assert [settings(goal) for goal in goals] == [settings(goal) for goal in GOALS]
    for goal, original in zip(goals, GOALS, strict=True):
        np.testing.assert_array_equal(goal.image, original.image)
    content = json.loads((folder / GOALS_FILE).read_text())
    assert content["origin"] == {"by": "me"}
    assert [goal["frame"] for goal in content["goals"]] == [8, 12, 30]
    assert sorted(path.name for path in folder.iterdir()) == ["goal_1.png", "goal_2.png", "goal_3.png", GOALS_FILE]


def test_fields_of_older_versions_are_ignored(folder: Path) -> None:
    noise = {"energy": 0.08, "pairs": 12, "encoder": "a" * 64, "distance": "l1"}
    edit(folder, lambda content: content.update(noise=noise), None)
    edit(folder, first(began=0.3))
    assert len(read_goal_folder(folder)) == 3


def test_hand_written_folder_needs_only_the_file_names_of_goals(tmp_path: Path) -> None:
    for name in ("grasped.png", "placed.png"):
        (tmp_path / name).write_bytes(encode_png(image(1)))
    content = {"format": 1, "goals": [{"file": "grasped.png", "at_most": 4, "at_least": 4}, {"file": "placed.png"}]}
    (tmp_path / GOALS_FILE).write_text(json.dumps(content))
    first, last = read_goal_folder(tmp_path)
    assert settings(first) == ("", 4, 4, None, None)
    assert settings(last) == ("", 1, None, None, None)


def edit(folder: Path, change: Any, key: str | None = "goals") -> None:
    path = folder / GOALS_FILE
    content = json.loads(path.read_text())
    change(content if key is None else content[key])
    path.write_text(json.dumps(content))


def first(**changes: object) -> Any:
    return lambda goals: goals[0].update(changes)


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        (first(file="none.png"), "none.png: "), (first(file=3), r"goals\.0\.file"), (first(at_least=9), "at least 9"),
        (first(share=1.5), "share"), (first(gripper="shut"), "gripper"), (first(more=1), r"goals\.0\.more"),
        (lambda goals: goals.clear(), "goals: List should have at least 1"),
        (lambda goals: goals.append(3), r"goals\.3"),
    ],
)  # fmt: skip
def test_invalid_goal_raises_with_the_wrong_key(change: Any, wrong: str, folder: Path) -> None:
    edit(folder, change)
    with pytest.raises(InputError, match=wrong):
        read_goal_folder(folder)


@pytest.mark.parametrize("text", ["[]", "{", '{"goals": []}', '{"format": 2, "goals": []}', '{"format": 1}'])
def test_invalid_goals_file_raises(text: str, folder: Path) -> None:
    (folder / GOALS_FILE).write_text(text)
    with pytest.raises(InputError, match=r"goals\.json: "):
        read_goal_folder(folder)


def test_invalid_or_differently_sized_images_raise(folder: Path) -> None:
    (folder / "goal_2.png").write_bytes(encode_png(image(2)[:40]))
    with pytest.raises(InputError, match=r"goal_2\.png: 48 x 40 pixels"):
        read_goal_folder(folder)
    (folder / "goal_2.png").write_bytes(b"GIF89a")
    with pytest.raises(InputError, match=r"goal_2\.png: 6 bytes that are not an image"):
        read_goal_folder(folder)


def test_folder_without_goals_raises_with_the_goals_command(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"goals\.json: cannot be read.*`vjepa2-ac goals` writes"):
        read_goal_folder(tmp_path)
    with pytest.raises(ValueError, match="no goals"):
        write_goals(tmp_path / "new", [])
    assert not (tmp_path / "new").exists()


def test_image_outside_the_folder_raises(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "outside.png").write_bytes(encode_png(image(1)))
    (tmp_path / "goals-too").mkdir()
    (tmp_path / "goals-too" / "near.png").write_bytes(encode_png(image(1)))
    (folder / "link.png").symlink_to(tmp_path / "outside.png")
    (folder / "linked").symlink_to(tmp_path / "goals-too")
    (folder / "loop.png").symlink_to("loop.png")
    (folder / "inside.png").symlink_to("goal_1.png")
    os.mkfifo(folder / "pipe.png")
    outside = [
        "../outside.png",
        "/dev/zero",
        str(folder / "goal_1.png"),
        "link.png",
        "linked/near.png",
        "a/../goal_1.png",
    ]
    for file in [*outside, "a\0.png", "a\n.png", "\x1b[2J.png"]:
        edit(folder, lambda goals, file=file: goals[1].update(file=file))
        with pytest.raises(InputError, match=r"goals\.json: goal 2: the file .*Expected a printable path") as caught:
            read_goal_folder(folder)
        assert str(caught.value).isprintable()
    for file, message in (("pipe.png", "a pipe or a device"), ("loop.png", "symbolic links"), (".", "directory")):
        edit(folder, lambda goals, file=file: goals[1].update(file=file))
        with pytest.raises(UserError, match=message):
            read_goal_folder(folder)
    edit(folder, lambda goals: goals[1].update(file="inside.png"))
    assert len(read_goal_folder(folder)) == 3
