"""A robot with the real openpi-client, in an environment of its own: drives a server, and prints what it got as JSON.

Run by test_real_client.py as `python openpi_dialogue.py HOST PORT KEY`. Knows nothing of vjepa2_ac.
"""

import json
import sys

import numpy as np
from openpi_client import action_chunk_broker, websocket_client_policy

STATE = np.array([0.4, 0.0, 0.3, 3.1, 0.0, 0.1, 0.2])


def picture(seed):
    return np.random.default_rng(seed).integers(0, 256, (48, 60, 3), dtype=np.uint8)


def dialogue(policy):
    """A goal once, decisions, an error, a decision after it, a new episode; and actions one by one from a chunk."""
    found = {"metadata": policy.get_server_metadata()["policy"]}
    first = policy.infer({"observation/image": picture(0), "observation/state": STATE, "goal/image": picture(100)})
    second = policy.infer({"observation/image": picture(1), "observation/state": STATE})
    try:
        policy.infer({"observation/image": picture(2), "observation/state": STATE[:3]})
    except RuntimeError as error:
        found["error"] = str(error)
    third = policy.infer({"observation/image": picture(2), "observation/state": STATE})
    again = policy.infer(
        {"observation/image": picture(0), "observation/state": STATE, "goal/image": picture(100), "reset": True}
    )
    found["actions"] = [one["actions"].tolist() for one in (first, second, third, again)]
    found["why"] = [one["why"] for one in (first, second, third, again)]
    broker = action_chunk_broker.ActionChunkBroker(policy, action_horizon=2)
    request = {"observation/image": picture(3), "observation/state": STATE, "prompt": "cup"}
    found["one_by_one"] = [broker.infer(request)["actions"].tolist() for _ in range(2)]
    return found


if __name__ == "__main__":
    _, host, port, key = sys.argv
    client = websocket_client_policy.WebsocketClientPolicy(host, int(port), key)
    sys.stdout.write(json.dumps(dialogue(client)))
