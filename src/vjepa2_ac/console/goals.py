"""Console output of goals that were made of a demonstration."""

from __future__ import annotations

from rich.table import Table

from vjepa2_ac.console.progress import MetricsTable
from vjepa2_ac.demonstrations.make_goals import MadeGoals


def goals_table(made: MadeGoals) -> Table:
    """Return a row for each goal."""
    energies = [] if made.course is None else ["energy when it begins", "a model step before its end"]
    columns = ["goal", "frame", "at least", "at most", "share", "gripper", *energies]
    table = MetricsTable(f"Goals of {made.recording.name} (at least and at most: model steps)", columns)
    for place, (key, goal) in enumerate(zip(made.keys, made.goals, strict=True)):
        name = f"{place + 1} {goal.name}".strip()
        row = [name, str(key.frame), str(goal.at_least), "" if goal.at_most is None else str(goal.at_most)]
        row += ["" if goal.share is None else f"{goal.share:g}", goal.gripper or ""]
        if made.course is not None:
            began, before = made.course.began[place], made.course.step_before[place]
            row += [f"{began:.4g}", f"{before:.4g}" + (f" ({before / began:.0%})" if began > 0 else "")]
        table.add_row(*row)
    return table


def goals_notes(made: MadeGoals) -> tuple[str, ...]:
    """Return what is worth knowing about the noise floor: a line each."""
    if made.course is None:
        return ("No energies and no noise floor: --model measures them.",)
    if made.noise is None:
        found = "No noise floor: this recording shows no arm that is known to rest."
        return (
            f"{found} --still VIDEO, of a resting arm, measures it; without it thresholds may lie within the noise.",
        )
    floor = made.noise.energy
    notes = [f"Noise floor: energy {floor:.4g}, the 95th percentile of {made.noise.pairs} pairs of resting frames."]
    for place, (goal, began) in enumerate(zip(made.goals, made.course.began, strict=True), start=1):
        if began <= floor:
            notes.append(f"Goal {place} begins within the noise ({began:.4g}): no share can tell when it is reached.")
        elif goal.share is not None and goal.share * began < floor:
            notes.append(
                f"Goal {place}: its threshold, {goal.share * began:.4g}, is within the noise, which replaces it."
            )
    return tuple(notes)
