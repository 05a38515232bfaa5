"""Which goals does a planner need to pick up a block? One model, the same problems, seven ways to give it its goals.

    vjepa2-ac simulate record demo/pick-data --task pick --episodes 300 --seed 1
    vjepa2-ac train configs/pick.yaml
    python benchmarks/sub_goals.py demo/pick-run                          # configs/pick.yaml says how long it takes
    python benchmarks/sub_goals.py demo/pick-B --domain B --out benchmarks/results/sub_goals_B.md

Goals on the way are key frames of one demonstration of the same problem, by the oracle (`simulate --sub-goals
demonstration`). A way that is done stands in --folder as JSON and is not run again.

*single goal*: the image of the end. *alike*: by that image and the one at the start the most similar demonstration of
the run's data is found (`simulate --sub-goals alike`); its key frames apply as with *slack*. *durations*: each key
frame applies for as many model steps as in the demonstration. *slack*: for three more. *advance*: the next one follows
when the energy has fallen below a share of its first value, at the earliest three steps sooner and at the latest three
later. *every step*: each model step of the demonstration is a goal, for one step more than it took there (`--sub-goals
every-step`). *gripper planned*: the planner opens and closes; else each goal says what the gripper does.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from vjepa2_ac.planning.goals import SubGoal
from vjepa2_ac.planning.session import load_to_plan
from vjepa2_ac.reporter import SILENT
from vjepa2_ac.simulation.agent import Agent, agent_of_session
from vjepa2_ac.simulation.benchmark import (
    DemonstratedGoals,
    DemonstrationSpec,
    every_step,
    of_demonstrations_alike,
)
from vjepa2_ac.simulation.domains import named_domain
from vjepa2_ac.simulation.policies import GoalsOf, Oracle, Policy
from vjepa2_ac.simulation.rollout import ClosedLoopResult, RolloutSpec, SimulatedWorld, run_task
from vjepa2_ac.simulation.tasks import STEPS, TaskProblem, arm_for
from vjepa2_ac.storage import write_atomically

SLACK, SHARE = 3, 0.2  # model steps; UVD's share
MORE = 6  # model steps that an episode may take beyond the task's default
WAYS = (
    "single goal", "alike", "durations, gripper planned", "durations", "slack", f"advance at {SHARE:.0%}", "every step",
    "oracle",
)  # fmt: skip


def main() -> None:
    """Run what is not there yet, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("subject", help="a run or a model")
    parser.add_argument("overrides", nargs="*", help="such as planning.samples=32")
    parser.add_argument("--task", default="pick", choices=["pick", "place"])
    parser.add_argument("--domain", default="A")
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--seed", type=int, default=7, help="of the problems; settings were chosen on seed 3")
    parser.add_argument("--only", default="", help="ways whose name has this in it")
    parser.add_argument("--folder", type=Path, default=Path("sub_goals"))
    parser.add_argument("--out", type=Path, help="file for the table")
    options = parser.parse_intermixed_args()
    torch.set_num_threads(1)
    agent = agent_of_session(load_to_plan(options.subject, overrides=options.overrides))
    for way in (one for one in WAYS if options.only in one):
        if not file_of(options, way).exists():
            found = as_dict(measure(way, agent, options))
            file_of(options, way).parent.mkdir(parents=True, exist_ok=True)
            write_atomically(file_of(options, way), json.dumps(found))
            print(f"{way}: {found['success']}", flush=True)
    text = table(options)
    print(text)
    if options.out is not None:
        write_atomically(options.out, text + "\n")


def measure(way: str, agent: Agent, options: argparse.Namespace) -> ClosedLoopResult:
    """Let one way solve all problems."""
    domain = named_domain(options.domain)
    arm = arm_for(options.task, domain, views=agent.planning.views)
    steps = STEPS[options.task] + MORE
    spec = RolloutSpec(options.task, domain, options.episodes, options.seed, steps, agent.stride)
    policy: Policy
    if way == "oracle":
        free = agent.planning.limits.model_copy(update={"gripper_mode": "free"})
        policy = Oracle(free, arm)
    elif way == "alike":
        policy = agent.policy(arm, of_demonstrations_alike(agent, SimulatedWorld(arm), spec.problems))
    else:
        policy = agent.policy(arm, goals_of(way, agent, options))
    return run_task(spec, policy, arm, SILENT.task(way))


def goals_of(way: str, agent: Agent, options: argparse.Namespace) -> GoalsOf | None:
    """Return what makes the goals of a problem; None: its goal image alone."""
    if way == "single goal":
        return None
    share = SHARE if way.startswith("advance") else None
    slack = 0 if way.startswith("durations") else SLACK
    spec = DemonstrationSpec(agent.planning.limits, None, agent.stride, slack, share)
    if way == "every step":
        spec = every_step(spec)
    demonstrated = DemonstratedGoals(options.task, named_domain(options.domain), spec, views=agent.planning.views)
    return without_grippers(demonstrated) if way.endswith("planned") else demonstrated


def without_grippers(goals: Callable[[TaskProblem], tuple[SubGoal, ...]]) -> GoalsOf:
    """Return the same goals, at which the planner opens and closes the gripper."""
    return lambda problem: tuple(replace(goal, gripper=None) for goal in goals(problem))


def as_dict(result: ClosedLoopResult) -> dict[str, Any]:
    """Return the figures of a way."""
    return {
        "success": result.success_rate.as_dict(),
        "left_cm": result.final_distance_cm.as_dict(),
        "by_episode": result.successes.tolist(),
        "steps": result.spec.model_steps,
    }


def table(options: argparse.Namespace) -> str:
    """Return the ways that are done as Markdown."""
    lines = [
        f"{options.task}, domain {options.domain}: {options.episodes} problems of seed {options.seed}",
        "",
        "| goals | done at the end | left, cm |",
        "|---|---|---|",
    ]
    for way in WAYS:
        if file_of(options, way).exists():
            found = json.loads(file_of(options, way).read_text())
            done, left = found["success"], found["left_cm"]
            share = f"{done['value']:.0%} [{done['low']:.0%}, {done['high']:.0%}]"
            lines.append(f"| {way} | {share} | {left['value']:.1f} [{left['low']:.1f}, {left['high']:.1f}] |")
    return "\n".join(lines)


def file_of(options: argparse.Namespace, way: str) -> Path:
    """Return where the figures of a way stand."""
    name = f"{Path(options.subject).name}-{options.task}-{options.domain}-{options.seed}-{options.episodes}"
    words = "".join(one if one.isalnum() else "-" for one in way)
    return options.folder / name / f"{words}.json"


if __name__ == "__main__":
    main()
