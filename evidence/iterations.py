"""The iterations study: how many action sequences and iterations does a decision need?

Decisions: at the same starts, searches of different sizes are compared with the paper's search (800 x 10). Closed loop:
the success rate with some of these sizes, on the same problems. Four tasks of the simulated arm, each with a model that
is trained with a config of the repository in a few minutes.

The cells are in the order of their importance, and `--only` selects some of them. Their costs differ: decisions with
800 samples and the larger searches in closed loop take most of the time. The model evaluates about 600 action sequences
of one model step per second on one core that other processes use, too.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from methods import SHIFTS
from prepare import cache_latents
from work import Work

from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import load_config
from vjepa2_ac.errors import InputError
from vjepa2_ac.goals.key_frames import MODEL_STEP_RULE, add_frames_between, find_gripper_key_frames
from vjepa2_ac.planning.controller import Controller, Decision
from vjepa2_ac.reporter import SILENT
from vjepa2_ac.runs.checkpoint import NEWEST
from vjepa2_ac.runs.subject import load_subject
from vjepa2_ac.simulation.arm import SimulatedArm
from vjepa2_ac.simulation.benchmark import BenchmarkOptions, Planning, demonstrate, goals_of_episode
from vjepa2_ac.simulation.domains import DOMAIN_A, DOMAIN_B, Domain
from vjepa2_ac.simulation.record import RecordedTask, RecordingSpec, record_dataset
from vjepa2_ac.simulation.rollout import ArmEnvironment, EpisodeResult, Trial, run_trials
from vjepa2_ac.simulation.tasks import arm_for
from vjepa2_ac.training.loop import train

STARTS, PROBLEMS = 25, 50  # of each task: decisions, and closed-loop problems
SAMPLES, ITERATIONS = (16, 64, 256, 800), (1, 2, 3, 5, 10)
REFERENCE = (800, 10)  # the paper's search
SETTINGS = ((64, 1), (64, 3), (64, 4), (16, 3), (64, 10), (256, 3))  # samples, iterations; in this order
RECORDED, PROBLEMS_SEED = 41, 70_000  # seeds of the demonstrations and of the problems


@dataclass(frozen=True)
class Task:
    """A task, the config and the demonstrations of its model, and the sub-goals of its problems."""

    name: str
    title: str
    config: str  # packaged config: training and planning
    domain: Domain
    recorded: RecordedTask | None  # None: random reaching
    demonstrations: int
    training_steps: int
    steps: int | None = None  # model steps of a problem; None: the default of the task
    has_sub_goals: bool = False  # whether each step of the oracle's solution is a sub-goal

    @property
    def options(self) -> BenchmarkOptions:
        """The problems; more are drawn than are measured, because the oracle does not solve all of them."""
        return BenchmarkOptions(self.recorded or "reach", self.domain, 2 * PROBLEMS, PROBLEMS_SEED, self.steps)


_MOUNTING = SHIFTS["motion"]
assert isinstance(_MOUNTING, Domain)
TASKS = {
    task.name: task
    for task in (
        Task("reach-demo", "reach, domain of the demo", "demo", DOMAIN_B, None, 40, 800),
        Task("reach-mounting", "reach, mounting rotated", "demo", _MOUNTING, None, 40, 800),
        Task("push", "push", "push", DOMAIN_A, "push", 100, 1_500),
        Task("pick", "pick, sub-goals", "pick", DOMAIN_A, "pick", 100, 2_000, steps=18, has_sub_goals=True),
    )
}


@dataclass(frozen=True)
class Cell:
    """A search of one size on one task. Decisions with fewer iterations are part of the search with the most."""

    kind: Literal["decisions", "closed loop"]
    task: str
    samples: int
    iterations: int

    @property
    def name(self) -> str:
        """Name of its file."""
        return f"{self.kind.replace(' ', '-')}-{self.task}-{self.samples}x{self.iterations}"


def all_cells() -> Iterator[Cell]:
    """Yield all cells, the most important first."""
    for samples in SAMPLES:
        for task in TASKS:
            yield Cell("decisions", task, samples, max(ITERATIONS))
    for samples, iterations in SETTINGS:
        for task in TASKS:
            yield Cell("closed loop", task, samples, iterations)


def make_config(task: Task, folder: Path) -> Config:
    """Return the config of a task's model: that of the package, with fewer demonstrations and training steps."""
    steps = task.training_steps
    overrides = [
        f"run_dir={folder / 'iterations-runs' / task.name}",
        f"data.path={folder / f'data-iterations-{task.name}'}",
        f"data.cache_dir={folder / 'latents'}",
        "data.cache=auto",
        "data.workers=0",
        "data.validation_share=0.1",
        "data.test_share=0",
        f"training.steps={steps}",
        f"validation.every={steps}",
        f"checkpoint.every={steps}",
    ]
    return load_config(f"builtin:{task.config}", overrides)


def prepare(cells: Sequence[Cell], work: Work) -> int:
    """Make the data and models of the cells' tasks; return the number of tasks that failed."""
    tasks = [TASKS[name] for name in dict.fromkeys(cell.task for cell in cells)]
    return work.run(prepare_task, [(task, work.folder) for task in tasks])


def prepare_task(task: Task, folder: Path) -> None:
    """Record the demonstrations of a task, encode them, and train its model; finished parts are not repeated."""
    config = make_config(task, folder)
    if not Path(config.data.path).exists():
        spec = RecordingSpec(task.domain, seed=RECORDED, task=task.recorded)
        record_dataset(config.data.path, spec, episodes=task.demonstrations)
    cache_latents(config.data, str(config.model.base))
    train(config, SILENT)


def measure(cell: Cell, folder: Path, problems: int) -> dict[str, Any]:
    """Measure a cell.

    Args:
        cell: The cell.
        folder: The work folder with the output of `prepare`.
        problems: Largest number of starts or problems.
    """
    task = TASKS[cell.task]
    measure_kind = measure_decisions if cell.kind == "decisions" else measure_closed_loop
    largest = STARTS if cell.kind == "decisions" else PROBLEMS
    return measure_kind(task, make_controller(cell, folder), min(problems, largest))


def make_controller(cell: Cell, folder: Path) -> Controller:
    """Return the controller of a cell, with the model of its task, and with other random numbers for each size.

    Its planner measures the time on the processor, which does not depend on other processes as much as elapsed time.
    """
    config = make_config(TASKS[cell.task], folder)
    planning = config.planning.model_copy(update={"samples": cell.samples, "iterations": cell.iterations})
    model = load_subject(config.run_dir, NEWEST).world_model
    controller = Controller(model, planning, seed=1_000 * cell.samples)
    controller.planner.clock = time.process_time
    return controller


def demonstrate_problems(
    task: Task, arm: SimulatedArm, controller: Controller, count: int
) -> Iterator[tuple[Trial, EpisodeResult]]:
    """Yield the first problems that the oracle solves, with the sub-goals of the task, and the oracle's solutions."""
    solved, limits = 0, controller.config.limits
    for trial in task.options.trials().trials:
        if solved == count:
            return
        try:
            episode = demonstrate(trial, arm, limits)
        except InputError:  # the oracle does not solve this problem
            continue
        solved += 1
        keys = add_frames_between(find_gripper_key_frames(episode.states, MODEL_STEP_RULE), 1)
        goals = goals_of_episode(episode, keys, "every-step") if task.has_sub_goals else ()
        yield replace(trial, goals=goals), episode


def measure_decisions(task: Task, controller: Controller, starts: int) -> dict[str, Any]:
    """Return the decisions at `starts` starts, after each number of iterations.

    The starts are at different steps of the oracle's solutions. A search with fewer iterations equals the beginning of
    a longer search, so one search is sufficient.

    Returns:
        By start, the action of the oracle (dx, dy, dz in cm) and the energy of the zero action; by number of iterations
        and start, the action (cm), its energy and the processor time (s) of the search.
    """
    arm = arm_for(task.options.task, task.domain)
    oracle, zero_energies = list[list[float]](), list[float]()
    searches: dict[str, list[list[float]]] = {str(count): [] for count in ITERATIONS}
    for number, (trial, episode) in enumerate(demonstrate_problems(task, arm, controller, starts)):
        step = number % max(episode.steps_needed or 1, 1)
        decision = decide_at(controller, trial, episode, step)
        if decision.plan is None or decision.cost is None:
            raise ValueError(f"{task.name}, problem {trial.seed}, step {step}: no plan, {decision.why}")
        space, iterations = controller.space, decision.plan.iterations
        decisions = [space.finalize(iterations[count - 1].mean) for count in ITERATIONS]
        actions = torch.stack([space.repeat_over_steps(each) for each in decisions])
        with torch.no_grad():
            energies = decision.cost(torch.cat([torch.zeros_like(actions[:1]), actions])).tolist()
        oracle.append((100 * episode.actions[step, :3]).tolist())
        zero_energies.append(energies[0])
        for count, action, energy in zip(ITERATIONS, actions, energies[1:], strict=True):
            seconds = sum(iteration.seconds for iteration in iterations[:count])
            searches[str(count)].append([*(100 * action[0, :3]).tolist(), energy, seconds])
    return {"oracle": oracle, "zero_action_energy": zero_energies, "searches": searches}


def decide_at(controller: Controller, trial: Trial, episode: EpisodeResult, step: int) -> Decision:
    """Return the decision after `step` steps of an oracle's solution, towards the goal that applies there."""
    assert episode.frames is not None, "a demonstration has frames"
    if trial.goals:
        controller.follow(trial.goals[step:])
    else:
        controller.reset(episode.goal_image)
    controller.act(episode.frames[step], episode.states[step])
    assert controller.decision is not None, "a decision was made"
    return controller.decision


def measure_closed_loop(task: Task, controller: Controller, problems: int) -> dict[str, Any]:
    """Return which of the problems were solved, and the final distances to the goal (cm)."""
    arm = arm_for(task.options.task, task.domain)
    solvable = tuple(trial for trial, _ in demonstrate_problems(task, arm, controller, problems))
    trials = replace(task.options.trials(), trials=solvable)
    result = run_trials(ArmEnvironment(arm), Planning(controller), trials)
    return {"solved": result.successes.astype(int).tolist(), "distance_cm": result.distance_cm[:, -1].tolist()}


def compact(result: dict[str, Any]) -> dict[str, Any]:
    """Return the values of a measurement that the tables need, with few digits."""
    if "searches" not in result:
        return result | {"distance_cm": np.round(result["distance_cm"], 2).tolist()}
    digits = (2, 2, 2, 6, 3)  # dx, dy, dz, energy, seconds
    searches = {
        count: [[round(value, places) for value, places in zip(row, digits, strict=True)] for row in rows]
        for count, rows in result["searches"].items()
    }
    oracle = np.round(result["oracle"], 2).tolist()
    return result | {"oracle": oracle, "searches": searches}
