"""A planning decision: one planned action, and the energies of alternative actions for comparison."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8

from vjepa2_ac.errors import counted
from vjepa2_ac.planning.controller import Controller, Decision
from vjepa2_ac.planning.energy import SAME_ENERGY, EnergySlice, compute_energy_slices
from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.planning.search_space import SearchSpace
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.spaces import StateSpace
from vjepa2_ac.storage import write_atomically
from vjepa2_ac.storage.structured import format_json, to_plain


@dataclass(frozen=True, eq=False)
class PlanRequest:
    """The input of a planning decision: the observation and the goals."""

    start: UInt8[np.ndarray, "height width 3"]
    state: Float[np.ndarray, " numbers"]  # measured; the controller checks it
    goals: tuple[SubGoal, ...]  # in order; the first one applies
    mask: np.ndarray | None = None  # region of the image that counts towards the energy: height x width

    @property
    def durations(self) -> list[int]:
        """Number of model steps of each goal except the last; empty if one of these numbers is not fixed."""
        all_but_last = self.goals[:-1]
        is_fixed = all(goal.at_least == goal.at_most for goal in all_but_last)
        return [goal.at_least for goal in all_but_last] if is_fixed else []


@dataclass(frozen=True, eq=False)
class PlanResult:
    """A decision, and the energies of alternative actions."""

    request: PlanRequest
    controller: Controller
    decision: Decision
    actions: Float[np.ndarray, "steps dim"]  # changes of the state; zero if there is no plan
    states: Float[np.ndarray, "steps+1 dim"]  # predicted states before and after these actions
    zero_action_energy: float  # predicted energy of the zero action; NaN if it was not computed
    slices: tuple[EnergySlice, ...]  # empty if there is no plan, or none were requested
    seconds: dict[str, float]  # for encoding the goals, for the decision (including its frame), and for the slices

    @property
    def space(self) -> SearchSpace:
        """The allowed actions."""
        return self.controller.space

    @property
    def state_space(self) -> StateSpace:
        """Meaning of the numbers of a state."""
        return self.controller.spaces.state

    @property
    def worse_than(self) -> dict[str, str]:
        """A sentence for each reference (zero action, current frame) whose energy is below the plan's prediction."""
        energy = math.nan if self.decision.plan is None else self.decision.plan.energy
        references = {"zero action": self.zero_action_energy, "current frame": self.decision.current_energy}
        sentence = "The plan is predicted to be worse than the {}: energy {:.4f} against {:.4f}{}."
        return {
            name: sentence.format(name, energy, reference, _relative_change(energy, reference))
            for name, reference in references.items()
            if energy > reference + SAME_ENERGY * abs(reference)
        }


def decide(controller: Controller, request: PlanRequest, *, nodes: int = 0, reporter: Reporter = SILENT) -> PlanResult:
    """Make one decision, and evaluate alternative actions.

    Args:
        controller: The controller that plans; its goals are replaced by those of the request.
        request: The observation and the goal.
        nodes: Number of points of an energy slice along each axis; below 3: no slices.
        reporter: Shows the progress of the slices. The search reports through the controller's planner.

    Raises:
        InputError: An image, the state or the mask is invalid.
        ValueError: No goals.
    """
    times = [time.perf_counter()]
    controller.follow(request.goals, mask=request.mask)
    times.append(time.perf_counter())
    controller.act(request.start, request.state)
    controller.cameras.require_contrast(request.start, where="start")
    times.append(time.perf_counter())
    decision = controller.decision
    if decision is None:
        raise ValueError("the controller made no decision")
    plan, space, zero_action_energy = decision.plan, controller.space, np.nan
    slices: tuple[EnergySlice, ...] = ()
    if plan is not None and decision.cost is not None:
        with torch.no_grad():
            zero_action_energy = float(decision.cost(torch.zeros_like(plan.actions)[None])[0])
        components = controller.display_components
        if decision.why != "no finite energy" and nodes >= 3 and len(components) >= 2:
            task = reporter.task("energy maps", "action sequences")
            slices = compute_energy_slices(decision.cost, plan.actions, space, components, nodes=nodes, progress=task)
    times.append(time.perf_counter())
    return PlanResult(
        request=request,
        controller=controller,
        decision=decision,
        actions=np.zeros((space.steps, space.dim)) if plan is None else plan.actions.double().numpy(),
        states=np.tile(request.state, (space.steps + 1, 1)) if decision.states is None else decision.states,
        zero_action_energy=zero_action_energy,
        slices=slices,
        seconds=dict(zip(("goals", "decision", "slices"), np.diff(times).tolist(), strict=True)),
    )


PLAN_FILE = "plan.json"
FORMAT = 1  # incremented when a reader of the file would have to change

_AT_LIMIT = 0.98  # an action is at its limit if it is at least this fraction of the limit


def write_plan(result: PlanResult, about: Mapping[str, Any], path: Path) -> Path:
    """Write a decision to a JSON file, atomically; numbers that are not finite become null.

    Args:
        result: The decision.
        about: The model and the sources of the images, as plain values.
        path: The file.
    """
    decision, request, controller = result.decision, result.request, result.controller
    plan, progress, names = decision.plan, decision.progress, result.state_space.change_names
    goal_fields = ("name", "at_least", "at_most", "share", "gripper")
    iteration_fields = ("samples", "finite", "lowest", "mean", "std", "seconds")
    energy = {
        "now": decision.current_energy,
        "began": progress.initial_energy,
        "doing_nothing": result.zero_action_energy,
    }
    slices = []
    for plane in result.slices:
        across, up = (names[component] for component in plane.components)
        slices.append({"across": across, "up": up, across: plane.across, up: plane.up, "energy": plane.energy})
    content = {
        "format": FORMAT,
        "in_words": summarize(result),
        **about,
        "state": request.state,
        "durations": request.durations,
        "settings": controller.config.model_dump(mode="json"),
        "seed": controller.seed,
        "crop": controller.crop,
        "why": decision.why,
        "worse_than": list(result.worse_than),
        "actions": result.actions,
        "states": result.states,
        "goal_of_each_step": decision.goals,
        "sub_goals": [{name: getattr(goal, name) for name in goal_fields} for goal in request.goals],
        "since": progress.start_step,
        "changed": progress.changed,
        "done": decision.is_done,
        "energy": energy | {"plan": None if plan is None else plan.energy},
        "evaluations": 0 if plan is None else plan.evaluations,
        "iterations": [
            {name: getattr(iteration, name) for name in iteration_fields} | {"elites_mean": iteration.elite_energy}
            for iteration in (() if plan is None else plan.iterations)
        ],
        "slices": slices,
        "seconds": {**result.seconds, "search": 0.0 if plan is None else plan.seconds},
    }
    write_atomically(path, format_json({name: to_plain(value) for name, value in content.items()}))
    return path


def summarize(result: PlanResult) -> str:
    """Return the decision as one or more sentences."""
    plan, why, current_energy = result.decision.plan, result.decision.why, result.decision.current_energy
    if why == "outside the workspace":
        return (
            "Zero action: the robot is farther outside planning.limits.workspace than one action can correct. Move the"
            " robot inside by hand, or correct the workspace."
        )
    if why == "at the goal" or plan is None:
        return "Zero action: the latents of the current frame equal those of the goal image."
    if why == "no finite energy":
        return (
            "Zero action: the model gives no finite energy for any of"
            f" {plan.evaluations:,} action sequences. Use another checkpoint."
        )
    iterations = len(plan.iterations)
    effort = f"{counted(plan.evaluations, 'action sequence')} in {counted(iterations, 'iteration')}"
    sentences = [
        _describe_motion(result),
        f"Energy {current_energy:.4f} now,",
        f"{plan.energy:.4f} predicted for the plan{_relative_change(plan.energy, current_energy)},",
        f"{result.zero_action_energy:.4f} predicted for the zero action.",
        f"Planner {plan.planner}, seed {plan.seed}: {effort}, {result.seconds['decision']:.2f} s.",
    ]
    if plan.stopped == "out of time":
        sentences.append(
            f"The time budget ended the search after {iterations} of {result.controller.config.iterations} iterations."
        )
    if at_limit := find_components_at_limit(result):
        key = f"planning.limits.{'xyz' if result.state_space.is_pose else 'axes'}"
        sentences.append(f"The first action is at its limit along {', '.join(at_limit)} ({key}).")
    return " ".join(sentences)


def _relative_change(energy: float, reference: float) -> str:
    return f" ({100 * (energy - reference) / abs(reference):+.1f} %)" if reference else ""


def _describe_motion(result: PlanResult) -> str:
    space, change, steps = result.state_space, result.states[-1] - result.states[0], len(result.actions)
    displayed = change[list(result.controller.display_components)] * (space.display_factor if space.is_pose else 1.0)
    names = [space.change_names[component] for component in result.controller.display_components]
    duration = f"in {counted(steps, 'model step')}"
    if not space.is_pose:
        parts = ", ".join(f"{name} by {value:+.3g}" for name, value in zip(names, displayed, strict=True))
        more = ", ..." if len(result.space.free) > len(names) else ""
        return f"Changes {parts}{more} {duration}."
    parts = ", ".join(f"{name} {value:+.1f}" for name, value in zip(names, displayed, strict=True))
    gripper = 0.0 if space.gripper is None else change[space.gripper]
    gripper_text = f", gripper {gripper:+.2f}" if gripper else ""
    unit = space.display_unit
    return f"Moves {np.linalg.norm(displayed):.1f} {unit} {duration} ({parts} {unit}{gripper_text})."


def find_components_at_limit(result: PlanResult) -> list[str]:
    """Return the names of the components of the first action that are at their limits; for poses, only dx, dy, dz."""
    upper, space = result.space.upper[0].numpy(), result.state_space
    components = result.controller.display_components if space.is_pose else range(len(space))
    return [
        space.change_names[component] for component in components
        if upper[component] > 0 and abs(result.actions[0, component]) >= _AT_LIMIT * upper[component]
    ]  # fmt: skip
