"""The summary of a decision as text: distance, expected gain, and warnings."""

from __future__ import annotations

import numpy as np

from vjepa2_ac.planning.decision import PlanResult
from vjepa2_ac.planning.interfaces import Plan

_AT_LIMIT = 0.98  # share of a limit from which an action is said to be at it


def summarize(answer: PlanResult) -> str:
    """Return the decision as one or more sentences."""
    plan, why = answer.decision.plan, answer.decision.why
    if why == "outside the workspace":
        return (
            "Does nothing: the robot is farther outside planning.limits.workspace than an action leads. Move it back by"
            " hand, or correct the box."
        )
    if why == "at the goal" or plan is None:
        return "Does nothing: what the model sees now is what it sees in the goal image."
    if why == "no finite energy":
        return (
            "Does nothing: the model gives no finite energy for any of"
            f" {plan.evaluations:,} action sequences. It is broken; another checkpoint may not be."
        )
    return " ".join([_motion(answer), _energy(answer, plan), _effort(answer, plan), *_warnings(answer, plan)])


def _motion(answer: PlanResult) -> str:
    space, change, steps = answer.state_space, answer.states[-1] - answer.states[0], len(answer.actions)
    shown = change[list(answer.shown_axes)] * (space.shown_factor if space.is_pose else 1.0)
    names = [space.change_names[axis] for axis in answer.shown_axes]
    lasting = f"in {steps} model step{'s' * (steps > 1)}"
    if not space.is_pose:
        parts = ", ".join(f"{name} by {value:+.3g}" for name, value in zip(names, shown, strict=True))
        more = ", ..." if len(answer.space.free) > len(names) else ""
        return f"Changes {parts}{more} {lasting}."
    parts = ", ".join(f"{name} {value:+.1f}" for name, value in zip(names, shown, strict=True))
    gripper = 0.0 if space.gripper is None else change[space.gripper]
    grips = f", gripper {gripper:+.2f}" if gripper else ""
    return f"Goes {np.linalg.norm(shown):.1f} {space.shown_unit} {lasting} ({parts} {space.shown_unit}{grips})."


def _energy(answer: PlanResult, plan: Plan) -> str:
    now = answer.decision.energy_now
    change = f" ({plan.energy / now - 1:+.0%})" if now else ""
    return (
        f"Energy {now:.4f} now, {plan.energy:.4f} predicted{change};"
        f" {answer.doing_nothing:.4f} predicted when doing nothing."
    )


def _effort(answer: PlanResult, plan: Plan) -> str:
    rounds = len(plan.iterations)
    return (
        f"Planner {plan.planner}, seed {plan.seed}: {plan.evaluations:,} action sequences in {rounds}"
        f" iteration{'s' * (rounds > 1)}, {answer.seconds.decision:.2f} s."
    )


def _warnings(answer: PlanResult, plan: Plan) -> list[str]:
    found = []
    if plan.stopped == "out of time":
        most = answer.controller.config.iterations
        found.append(f"Time was up after {len(plan.iterations)} of {most} iterations: the best so far.")
    if not plan.energy < answer.doing_nothing:
        found.append("None of the evaluated actions is predicted to be better than doing nothing.")
    if at_limit := axes_at_limit(answer):
        knob = f"planning.limits.{'xyz' if answer.state_space.is_pose else 'axes'}"
        found.append(f"The first action is at its limit along {', '.join(at_limit)} ({knob}).")
    if answer.unused_goals and not answer.question.sub_goals:  # of these everybody knows that the others come later
        unused = ", ".join(str(place + 1) for place in answer.unused_goals)
        found.append(f"No part in this plan has goal {unused}: see durations, planning.horizon, planning.energy.steps.")
    return found


def axes_at_limit(answer: PlanResult) -> list[str]:
    """Return the numbers, of a position or of a vector, whose first change is at its limit."""
    upper, space = answer.space.upper[0].numpy(), answer.state_space
    numbers = answer.shown_axes if space.is_pose else range(len(space))
    return [
        space.change_names[number] for number in numbers
        if upper[number] > 0 and abs(answer.actions[0, number]) >= _AT_LIMIT * upper[number]
    ]  # fmt: skip
