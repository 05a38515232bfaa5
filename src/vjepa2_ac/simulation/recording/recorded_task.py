"""Which tasks with a block are recorded, how long an episode is, and what its instruction says."""

from __future__ import annotations

from typing import Literal

RecordedTask = Literal["push", "pick", "place"]

INSTRUCTIONS: dict[RecordedTask | None, str] = {
    None: "reach around over the table",
    "push": "push the block",
    "pick": "pick up the block",
    "place": "put the block on the mark",
}
"""Language instruction of an episode; None: random reaching, without a block."""


def default_steps(task: RecordedTask | None) -> int:
    """Return the control steps of an episode, enough for its task: the script of `place` releases the block late."""
    return 81 if task == "place" else 41
