"""Where does the energy send a hand that is to go down on a block? True images beside the model, far goal beside near.

    python benchmarks/first_step.py demo/pick-run       # configs/pick.yaml makes the run; a minute on one core

At the start of each problem of `pick`, 27 first steps are compared: none or a whole step to either side along each
axis. *true images*: the block's scene is rendered with the hand where each step would bring it, encoded, and compared
with the goal. *model*: the same latents are predicted. *far*: the goal is the grasp; *near*: the first model step of
the demonstration. Printed are means over the problems: of the way to the goal, and of the step of lowest energy, how
far it goes towards the camera and down, and how far it is off horizontally from the way, cut to a step along each axis.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float

from vjepa2_ac.config.planning import EnergyConfig, LimitsConfig
from vjepa2_ac.planning.controller import Controller
from vjepa2_ac.planning.demonstrations.key_frames import OF_MODEL_STEPS, gripper_key_frames
from vjepa2_ac.planning.energy import distance
from vjepa2_ac.planning.session import load_to_plan
from vjepa2_ac.simulation.arm import SimulatedArm
from vjepa2_ac.simulation.benchmark import DemonstrationSpec, demonstrate
from vjepa2_ac.simulation.domains import named_domain
from vjepa2_ac.simulation.rollout import put
from vjepa2_ac.simulation.tasks import TaskProblem, arm_for, make_problem

STEP_M = 0.05
STEPS = np.array(list(itertools.product((-STEP_M, 0.0, STEP_M), repeat=3)))
SETTINGS = ("planning.horizon=1", "planning.action_repeat=1", "planning.samples=32", "planning.iterations=1",
            f"planning.limits.xyz=[{STEP_M},{STEP_M},{STEP_M}]", "planning.limits.gripper_mode=held")  # fmt: skip


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("subject", help="a run or a model")
    parser.add_argument("--domain", default="A")
    parser.add_argument("--episodes", type=int, default=12)
    parser.add_argument("--seed", type=int, default=3, help="of the problems")
    options = parser.parse_args()
    torch.set_num_threads(1)
    controller = load_to_plan(options.subject, overrides=SETTINGS).controller()
    domain = named_domain(options.domain)
    arm = arm_for("pick", domain)
    problems = [make_problem("pick", domain, options.seed, index) for index in range(options.episodes)]
    found = np.array([list(choices(controller, arm, problem)) for problem in problems])
    angle = np.deg2rad(domain.camera.azimuth_deg - domain.base_yaw_deg)
    to_camera = np.array([np.cos(angle), np.sin(angle)])
    print("| goal | step | towards the camera, cm | down, cm | off, cm |", "|---|---|---|---|---|", sep="\n")
    for place, (goal, step) in enumerate(itertools.product(("far", "near"), ("way to it", "true images", "model"))):
        way, taken = (100 * found[:, one] for one in (place // 3 * 3, place))
        off = np.linalg.norm(taken[:, :2] - np.clip(way[:, :2], -100 * STEP_M, 100 * STEP_M), axis=1)
        shown = "" if step == "way to it" else f"{off.mean():.1f}"
        print(f"| {goal} | {step} | {(taken[:, :2] @ to_camera).mean():.1f} | {-taken[:, 2].mean():.1f} | {shown} |")


def choices(controller: Controller, arm: SimulatedArm, problem: TaskProblem) -> Iterator[Float[np.ndarray, " 3"]]:
    """Yield the way to a goal, and the step of lowest energy by true images and by the model: of far and near goal."""
    frames, states = demonstrate(problem, arm, DemonstrationSpec(LimitsConfig(xyz=(STEP_M,) * 3)))
    start, grasp = states[0], gripper_key_frames(states, OF_MODEL_STEPS)[0].frame
    latents = []
    for step in STEPS:
        put(arm, start + np.append(step, np.zeros(4)), problem.block_start)
        latents.append(controller.encoded(arm.image()))
    actions = torch.from_numpy(np.concatenate([STEPS, np.zeros((len(STEPS), 4))], axis=1)).float()[:, None]
    for frame in (grasp, 1):
        yield states[frame, :3] - start[:3]
        goal = controller.encoded(frames[frame])
        yield STEPS[int(distance(torch.stack(latents), goal, EnergyConfig()).argmin())]
        controller.reset(frames[frame])
        controller.act(frames[0], start)
        assert controller.decision is not None
        assert controller.decision.cost is not None
        with torch.no_grad():
            yield STEPS[int(controller.decision.cost(actions).argmin())]


if __name__ == "__main__":
    main()
