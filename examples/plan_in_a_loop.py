"""Plan in a loop: a model moves the simulated arm towards a goal image, one model step at a time.

    python examples/plan_in_a_loop.py [RUN_OR_MODEL]

For a real robot, replace `arm`: the loop needs a camera image, the measured state, and a command that moves to a pose.
"""

import sys
from pathlib import Path

import numpy as np

from vjepa2_ac import Controller, UserError, load_model, load_run
from vjepa2_ac.config import PlanningConfig
from vjepa2_ac.media.images import encode_png
from vjepa2_ac.simulation.domains import named_domain
from vjepa2_ac.simulation.rollout import set_scene
from vjepa2_ac.simulation.tasks import arm_for, make_problem
from vjepa2_ac.spaces import apply_action

IMAGE_STRIP = Path("demo/examples/plan_in_a_loop.png")


def main(subject: str = "builtin:sim-tiny", *, samples: int = 100, steps: int = 8) -> None:
    """Print the distance to the goal after each step, and write all camera images as one image strip."""
    planning = PlanningConfig(samples=samples, iterations=4)
    if Path(subject, "config.yaml").exists():  # a run, not a model
        controller = Controller.of_run(load_run(subject), planning)
    else:
        controller = Controller(load_model(subject), planning)
    problem = make_problem("reach", named_domain("A"), seed=0, index=0)  # a start and a goal
    arm = arm_for("reach", named_domain("A"))
    goal = set_scene(arm, problem.goal, None).image()  # height x width x 3, uint8, RGB
    set_scene(arm, problem.start, None)

    controller.reset(goal)
    frames = [arm.image()]
    print(f"start:  {100 * problem.distance_m(arm.state):.1f} cm from the goal")
    for step in range(1, steps + 1):
        state = arm.state  # measured: x, y, z in metres, roll, pitch, yaw in radians, gripper
        action = controller.act(frames[-1], state)  # the change of state, within planning.limits
        target = apply_action(state, action)
        target[6] = np.clip(target[6], 0.0, 1.0)
        if not arm.can_reach(target):
            print(f"step {step}: the arm cannot reach {target[:3].round(3)}")
            break
        arm.command(target, control_steps=4)  # one model step: data.stride control steps
        frames.append(arm.image())
        moved = " ".join(f"{100 * number:+.1f}" for number in action[:3])
        print(f"step {step}: {100 * problem.distance_m(arm.state):.1f} cm from the goal, moved by {moved} cm")
    IMAGE_STRIP.parent.mkdir(parents=True, exist_ok=True)
    IMAGE_STRIP.write_bytes(encode_png(np.concatenate([*frames, goal], axis=1)))
    print(f"Images: {IMAGE_STRIP}, one per step from left to right; the last image is the goal.")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:2])
    except UserError as error:
        sys.exit(f"error: {error}")
