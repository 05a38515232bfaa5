"""Console output of a plan."""

from __future__ import annotations

import numpy as np
from rich.table import Table

from vjepa2_ac.console.progress import MetricsTable
from vjepa2_ac.planning.decision import PlanResult


def plan_table(answer: PlanResult) -> Table:
    """Return a row for each model step: its action, and the position of the flange after it."""
    turns = bool(answer.actions[:, 3:6].any())
    table = MetricsTable(f"Plan: {answer.decision.why}")
    columns = ["step", "dx (cm)", "dy (cm)", "dz (cm)", *["turn (degrees)"] * turns, "gripper"]
    for name in [*columns, "then x, y, z (m)", "gripper"]:
        table.add_column(name, justify="right")
    for step, (action, after) in enumerate(zip(answer.actions, answer.states[1:], strict=True), start=1):
        way = [f"{value * 100:+.2f}" for value in action[:3]]
        turn = [" ".join(f"{value:+.1f}" for value in np.degrees(action[3:6]))] * turns
        then = " ".join(f"{value:.3f}" for value in after[:3])
        table.add_row(str(step), *way, *turn, f"{action[6]:+.2f}", then, f"{after[6]:.2f}")
    return table
