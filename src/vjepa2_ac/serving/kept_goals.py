"""Goals that a server keeps, by their names: pictures, and folders with an order of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from vjepa2_ac.errors import InputError
from vjepa2_ac.media.image_file import read_image
from vjepa2_ac.planning.goal_folder import GOALS_FILE, GoalFolder, read_goal_folder
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.planning.input_checks import require_image

KeptGoals = Mapping[str, GoalFolder]

_PICTURES = {".png", ".jpg", ".jpeg"}


def read_kept_goals(folder: Path) -> KeptGoals:
    """Return the goals of a folder: itself an order of goals; or pictures, and folders with such an order.

    A picture `cup.png` is a goal of the name `cup`; an order of goals has its folder's name.

    Raises:
        InputError: There is no goal, two have one name, or a file cannot be used.
    """
    if not folder.is_dir():
        found = "a file" if folder.exists() else "no such folder"
        raise InputError(where=f"--goals {folder}", found=found, needed="a folder with goal images")
    if (folder / GOALS_FILE).is_file():
        return {folder.resolve().name: read_goal_folder(folder)}
    kept: dict[str, GoalFolder] = {}
    for path in sorted(folder.iterdir()):
        goals = _goals_at(path)
        if goals is not None and path.stem in kept:
            found = f"two goals named {path.stem!r}"
            raise InputError(where=str(path), found=found, needed="another name for one of them")
        kept |= {} if goals is None else {path.stem: goals}
    if not kept:
        found, needed = (
            "no goal",
            f"pictures (PNG or JPEG), or folders with a {GOALS_FILE} (`vjepa2-ac goals` makes them)",
        )
        raise InputError(where=f"--goals {folder}", found=found, needed=needed)
    return kept


def _goals_at(path: Path) -> GoalFolder | None:
    """Return the goals that a file or folder is; None: it is something else."""
    if path.is_dir():
        return read_goal_folder(path) if (path / GOALS_FILE).is_file() else None
    if path.suffix.lower() not in _PICTURES:
        return None
    image = read_image(path)
    require_image(image, where=str(path))
    return GoalFolder((SubGoal(image, name=path.stem),), (None,), (None,))
