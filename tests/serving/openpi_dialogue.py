"""Drive a server with the real openpi-client and print the replies as JSON.

test_real_client.py runs `python openpi_dialogue.py HOST PORT KEY` in an environment without vjepa2_ac.
"""

import json
import sys

import numpy as np
from openpi_client import action_chunk_broker, websocket_client_policy

STATE = np.array([0.4, 0.0, 0.3, 3.1, 0.0, 0.1, 0.2])


def make_image(seed):
    return np.random.default_rng(seed).integers(0, 256, (48, 60, 3), dtype=np.uint8)


def dialogue(policy):
    """Send a goal, request decisions, cause an error, start a new episode, and take single actions from a chunk."""
    results = {"metadata": policy.get_server_metadata()["policy"]}
    first = policy.infer(
        {"observation/image": make_image(0), "observation/state": STATE, "goal/image": make_image(100)}
    )
    second = policy.infer({"observation/image": make_image(1), "observation/state": STATE})
    try:
        policy.infer({"observation/image": make_image(2), "observation/state": STATE[:3]})
    except RuntimeError as error:
        results["error"] = str(error)
    third = policy.infer({"observation/image": make_image(2), "observation/state": STATE})
    repeated = policy.infer(
        {"observation/image": make_image(0), "observation/state": STATE, "goal/image": make_image(100), "reset": True}
    )
    results["actions"] = [reply["actions"].tolist() for reply in (first, second, third, repeated)]
    results["why"] = [reply["why"] for reply in (first, second, third, repeated)]
    broker = action_chunk_broker.ActionChunkBroker(policy, action_horizon=2)
    request = {"observation/image": make_image(3), "observation/state": STATE, "prompt": "cup"}
    results["one_by_one"] = [broker.infer(request)["actions"].tolist() for _ in range(2)]
    return results


if __name__ == "__main__":
    _, host, port, key = sys.argv
    client = websocket_client_policy.WebsocketClientPolicy(host, int(port), key)
    sys.stdout.write(json.dumps(dialogue(client)))
