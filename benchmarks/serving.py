"""What does the socket cost? Decisions through a served websocket on loopback, less what the decision itself took.

    python benchmarks/serving.py                   # 300 decisions of the built-in model, images of 180 x 320
    python benchmarks/serving.py --size 720 1280   # larger images
    python benchmarks/serving.py --large --decisions 10   # a GPU: the released size, 800 samples x 10, as in the paper

The server is a process of its own, as for a robot. A request has an image and a state; the goal was sent before. The
cost is the client's round trip less `policy_timing.infer_ms`: packing, loopback, waiting for the planning thread,
checking, unpacking. A busy machine makes it larger: nothing else should run. --large has random weights, which decide
nothing and take as long.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from rows import Rows

from vjepa2_ac.config import ModelSizes
from vjepa2_ac.model.network.world_model import WorldModel
from vjepa2_ac.serving.wire import PlanningClient

STATE = np.array([0.45, 0.0, 0.3, np.pi, 0.0, 0.0, 0.0])
SMALL = ("planning.samples=10", "planning.iterations=1", "planning.limits.gripper_mode=held")
LARGE = ("planning.samples=800", "planning.iterations=10", "planning.horizon=1", "planning.energy.samples_at_once=64")


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the percentiles, and write them where they are wanted."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--decisions", type=int, default=300)
    parser.add_argument("--size", type=int, nargs=2, default=(180, 320), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--large", action="store_true", help="a model of the released size, at the paper's setting")
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        small = "builtin:sim-tiny", SMALL, 10
        model, settings, warm_up = (large_model(Path(folder)), LARGE, 1) if options.large else small
        command = [sys.executable, "-m", "vjepa2_ac.cli", "serve", model, "--port", "0", *settings]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:  # noqa: S603 - our own command
            try:
                cost, whole = measure(address_of(server), options.decisions, warm_up, tuple(options.size))
            finally:
                server.terminate()
    rows = Rows(options.json, size=list(options.size), decisions=options.decisions, large=options.large)
    row = {f"cost_ms_p{p}": round(float(np.percentile(cost, p)), 2) for p in (50, 95, 99)}
    for p in (50, 95):
        row[f"round_trip_ms_p{p}"] = round(float(np.percentile(whole, p)), 2)
    rows.add(row)
    print("\n".join(f"{name}: {value}" for name, value in row.items()))


def large_model(folder: Path) -> str:
    """Write a random model of the released size, and return where it is."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    WorldModel.random(ModelSizes(), seed=0, dtype=torch.bfloat16, device=device).save_pretrained(folder / "model")
    return str(folder / "model")


def address_of(server: subprocess.Popen[str]) -> str:
    """Return where a server listens, once it is ready.

    Raises:
        RuntimeError: It ended.
    """
    address = ""
    assert server.stdout is not None
    for line in server.stdout:
        if line.startswith("listening on "):
            address = line.removeprefix("listening on ").strip()
        if line.strip() == "ready":
            return address
    raise RuntimeError("the server has ended")


def measure(url: str, decisions: int, warm_up: int, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return what the socket cost, and the whole round trip, of each decision in milliseconds."""
    rng, found = np.random.default_rng(0), []
    with PlanningClient(url) as client:
        goal = rng.integers(0, 256, (*size, 3), dtype=np.uint8)
        client.infer({"endpoint": "reset", "goal/image": goal})
        for _ in range(warm_up + decisions):
            image = rng.integers(0, 256, (*size, 3), dtype=np.uint8)
            began = time.perf_counter()
            answer = client.infer({"observation/image": image, "observation/state": STATE})
            whole = 1e3 * (time.perf_counter() - began)
            found.append((whole - answer["policy_timing"]["infer_ms"], whole))
    cost, whole = np.array(found[warm_up:]).T
    return cost, whole


if __name__ == "__main__":
    main()
