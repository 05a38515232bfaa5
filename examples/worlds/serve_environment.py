"""Serve a Gymnasium environment to `vjepa2-ac simulate --world` (protocol: docs/worlds.md). Copy it into your project.

Import it first: it keeps standard output for answers and moves this folder behind installed packages.
"""

import base64
import importlib.metadata
import json
import os
import sys

os.environ.setdefault("MUJOCO_GL", "egl")
sys.path.append(sys.path.pop(0))  # otherwise `import robosuite` would import robosuite.py from this folder
answers = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)  # output of libraries goes to standard error


def send(answer):
    print(json.dumps(answer), file=answers, flush=True)


def get_versions(*packages):
    """Return the versions of installed packages, which are stored with every result."""
    return {package: importlib.metadata.version(package) for package in packages}


def serve(env, **about):
    """Answer requests until the input ends.

    Args:
        env: `reset(seed=)` and `step(target)` return the state as observation, and `success` and `distance_m` in info.
            `step(None)` lets the scripted expert act for a control step, and returns its `target` in info. `render()`
            returns the image.
        about: The first message: world, task, rate_hz, steps, instruction, expert, versions.
    """
    send(about)
    for line in sys.stdin:
        request = json.loads(line)
        if request["do"] == "reset":
            state, info = env.reset(seed=request["seed"])
        for _ in range(request.get("steps", 0)):
            state, _, _, _, info = env.step(request["target"])
        image = env.render()
        pixels = {"height": len(image), "width": len(image[0]), "rgb": base64.b64encode(image.tobytes()).decode()}
        answer = {"image": pixels, "state": list(map(float, state)), "success": bool(info["success"])}
        answer["distance_m"] = float(info["distance_m"])
        send(answer | ({"target": list(map(float, info["target"]))} if "target" in info else {}))
