"""The content of plan.json: a decision as plain values, by the schema in docs/planning.md."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vjepa2_ac.planning.decision import PlanResult
from vjepa2_ac.planning.energy_slices import EnergySlice
from vjepa2_ac.planning.goals.sub_goals import SubGoal
from vjepa2_ac.planning.interfaces import Iteration
from vjepa2_ac.planning.summary import summarize
from vjepa2_ac.storage import write_atomically
from vjepa2_ac.storage.structured import finite_or_none, json_text

PLAN_FILE = "plan.json"
FORMAT = 1  # goes up when a reader of the file would have to change


def write_plan(answer: PlanResult, about: Mapping[str, Any], path: Path) -> Path:
    """Write a decision as JSON; the file is written atomically.

    Args:
        answer: The decision.
        about: The model and the sources of the images, as plain values.
        path: The file.
    """
    write_atomically(path, json_text(plan_as_dict(answer, about)))
    return path


def plan_as_dict(answer: PlanResult, about: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of the file; numbers that are not finite are null."""
    decision, plan, config = answer.decision, answer.decision.plan, answer.controller.config
    return {
        "format": FORMAT,
        "in_words": summarize(answer),
        **about,
        "state": _plain(answer.question.state),
        "durations": list(answer.question.durations),
        "settings": config.model_dump(mode="json"),
        "seed": answer.controller.seed,
        "crop": answer.controller.crop,
        "why": decision.why,
        "actions": _plain(answer.actions),
        "states": _plain(answer.states),
        "goal_of_each_step": list(decision.goals),
        "sub_goals": [_sub_goal(one) for one in answer.question.sub_goals],
        "since": decision.since,
        "changed": decision.changed,
        "done": decision.done,
        "energy": {
            "now": finite_or_none(decision.energy_now),
            "began": finite_or_none(decision.began),
            "doing_nothing": finite_or_none(answer.doing_nothing),
            "plan": None if plan is None else finite_or_none(plan.energy),
        },
        "evaluations": 0 if plan is None else plan.evaluations,
        "iterations": [] if plan is None else [_iteration(one) for one in plan.iterations],
        "slices": [_slice(one, answer.state_space.change_names) for one in answer.slices],
        "seconds": {
            "goals": answer.seconds.goals,
            "decision": answer.seconds.decision,
            "search": 0.0 if plan is None else plan.seconds,
            "slices": answer.seconds.slices,
        },
    }


def _sub_goal(one: SubGoal) -> dict[str, Any]:
    return {name: getattr(one, name) for name in ("name", "at_least", "at_most", "share", "gripper", "floor")}


def _iteration(one: Iteration) -> dict[str, Any]:
    return {
        "samples": one.samples,
        "finite": one.finite,
        "lowest": finite_or_none(one.lowest),
        "elites_mean": finite_or_none(one.elite_energy),
        "mean": _plain(one.mean.double().numpy()),
        "std": _plain(one.std.double().numpy()),
        "seconds": one.seconds,
    }


def _slice(one: EnergySlice, names: Sequence[str]) -> dict[str, Any]:
    across, up = (names[axis] for axis in one.axes)
    return {"across": across, "up": up, across: _plain(one.across), up: _plain(one.up), "energy": _plain(one.energy)}


def _plain(values: np.ndarray) -> Any:
    return [_plain(row) if row.ndim else finite_or_none(float(row)) for row in np.asarray(values, dtype=np.float64)]
