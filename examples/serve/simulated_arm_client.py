"""The simulated arm picks up a block: a robot in a process of its own, with the real openpi-client, asks a server.

    vjepa2-ac serve demo/pick-run planning.limits.xyz=[0.05,0.05,0.05]          # configs/pick.yaml makes demo/pick-run
    pip install --no-deps openpi-client==0.1.2 && pip install typing_extensions  # in an environment with vjepa2-ac[sim]
    python examples/serve/simulated_arm_client.py ws://127.0.0.1:8000 served.gif

Each model step of one demonstration of the same problem is a goal on the way. For tables use `vjepa2-ac simulate ws://…`.
"""

import sys

from openpi_client.websocket_client_policy import WebsocketClientPolicy

from vjepa2_ac.media.video import write_gif
from vjepa2_ac.simulation.agent import ServedPlanner
from vjepa2_ac.simulation.benchmark import DemonstratedGoals, DemonstrationSpec, every_step, film_frames
from vjepa2_ac.simulation.domains import named_domain
from vjepa2_ac.simulation.rollout import RolloutSpec, run_task


def main(url: str, film: str, episodes: str = "4", seed: str = "3") -> None:
    """Let the server solve some problems, and draw what the camera saw."""
    shown = DemonstratedGoals("pick", named_domain("A"), every_step(DemonstrationSpec()))
    policy = ServedPlanner(WebsocketClientPolicy(url), "openpi-client", shown)
    count = int(episodes)
    result = run_task(RolloutSpec("pick", "A", count, int(seed), steps=18, films=count), policy)
    for number, episode in enumerate(result.episodes, start=1):
        print(
            f"problem {number}: {100 * episode.distances_m[-1]:.1f} cm left, {'lifted' if episode.success else 'not'}"
        )
    frames = list(film_frames(result))
    write_gif(film, frames, seconds=[0.2] * len(frames))


if __name__ == "__main__":
    main(*sys.argv[1:])
