"""Console output of a plan."""

from __future__ import annotations

import numpy as np
from rich.table import Table

from vjepa2_ac.console.progress import MetricsTable
from vjepa2_ac.planning.decision import PlanResult
from vjepa2_ac.spaces import POSE


def plan_table(answer: PlanResult) -> Table:
    """Return a row for each model step: its action, and the state after it."""
    space = answer.state_space
    rows = list(zip(answer.actions, answer.states[1:], strict=True))
    if not space.is_pose:
        names, cells = ["number", "changes by", "then"], _of_vectors
    else:
        turns = ["turn (degrees)"] * bool(answer.actions[:, POSE.rotation].any())
        names = ["dx (cm)", "dy (cm)", "dz (cm)", *turns, "gripper", "then x, y, z (m)", "gripper"]
        cells = _of_poses
    table = MetricsTable(f"Plan: {answer.decision.why}", ["step", *names], labelled=False)
    for step, (action, after) in enumerate(rows, start=1):
        for row in cells(answer, action, after):
            table.add_row(str(step), *row)
    return table


def _of_poses(answer: PlanResult, action: np.ndarray, after: np.ndarray) -> list[list[str]]:
    turns = bool(answer.actions[:, POSE.rotation].any())
    way = [f"{value * 100:+.2f}" for value in action[POSE.position]]
    turn = [" ".join(f"{value:+.1f}" for value in np.degrees(action[POSE.rotation]))] * turns
    then = " ".join(f"{value:.3f}" for value in after[POSE.position])
    return [[*way, *turn, f"{action[POSE.gripper]:+.2f}", then, f"{after[POSE.gripper]:.2f}"]]


def _of_vectors(answer: PlanResult, action: np.ndarray, after: np.ndarray) -> list[list[str]]:
    free = answer.space.free.tolist()
    return [[answer.state_space.names[one], f"{action[one]:+.4g}", f"{after[one]:.4g}"] for one in free]
