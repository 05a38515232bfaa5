"""The simulated arm picks up a block: a robot in a process of its own, with the real openpi-client, asks a server.

    vjepa2-ac serve demo/pick-run planning.limits.xyz=[0.05,0.05,0.05]          # configs/pick.yaml makes demo/pick-run
    pip install --no-deps openpi-client==0.1.2 && pip install typing_extensions  # in an environment with vjepa2-ac[sim]
    python examples/serve/simulated_arm_client.py ws://127.0.0.1:8000 served.gif

Each model step of one demonstration of the same problem is a sub-goal.
"""

import sys

import numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy

from vjepa2_ac.config import LimitsConfig
from vjepa2_ac.media.video import write_gif
from vjepa2_ac.simulation.benchmark import BenchmarkOptions, demonstrated_goals, video_frames, with_goals
from vjepa2_ac.simulation.rollout import ArmEnvironment, Image, Observation, Trial, run_trials
from vjepa2_ac.simulation.tasks import arm_for


class ServedPlanner:
    """A policy behind a server: images and measured states go through its socket."""

    name, why = "openpi-client", ""

    def __init__(self, client: WebsocketClientPolicy) -> None:
        self.client = client

    def reset(self, trial: Trial, goal_image: Image) -> None:  # noqa: ARG002 - of the protocol
        """Start an episode with the sub-goals of the trial, each for at most its number of model steps."""
        self.client.infer({"endpoint": "reset"})
        self.goal = {
            "goal/images": np.stack([goal.image for goal in trial.goals]),
            "goal/rules": [
                {"at_least": goal.at_least, "at_most": goal.at_most, "gripper": goal.gripper} for goal in trial.goals
            ],
        }

    def act(self, observation: Observation) -> np.ndarray:
        """Return the first action of the server's plan."""
        request = {"observation/image": observation.image, "observation/state": observation.state, **self.goal}
        reply = self.client.infer(request)
        self.goal, self.why = {}, reply["why"]
        return np.asarray(reply["actions"][0])


def main(url: str, film: str, episodes: str = "4", seed: str = "3") -> None:
    """Let the server solve some problems, and draw what the camera saw."""
    count = int(episodes)
    options = BenchmarkOptions("pick", "A", count, int(seed), steps=18)
    arm, trials, limits = arm_for("pick", options.world), options.trials(), LimitsConfig()
    trials = with_goals(trials, [demonstrated_goals(one, arm, limits, "every-step") for one in trials.trials])
    result = run_trials(ArmEnvironment(arm), ServedPlanner(WebsocketClientPolicy(url)), trials, num_videos=count)
    for number, episode in enumerate(result.episodes, start=1):
        print(
            f"problem {number}: {100 * episode.distances_m[-1]:.1f} cm left, {'lifted' if episode.success else 'not'}"
        )
    frames = list(video_frames(result))
    write_gif(film, frames, seconds=[0.2] * len(frames))


if __name__ == "__main__":
    main(*sys.argv[1:])
