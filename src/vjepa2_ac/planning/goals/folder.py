"""Stand-in until the branch of sub-goals has it."""

from __future__ import annotations

from pathlib import Path

from vjepa2_ac.planning.goals.sub_goals import SubGoal

GOALS = "goals.json"


def read_goals(folder: Path) -> tuple[SubGoal, ...]:
    raise NotImplementedError(folder)
