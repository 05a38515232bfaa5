"""How much memory does loading the official checkpoint need? Writes a random file of its form and size, and loads it.

    python benchmarks/load_memory.py FOLDER [--small] [--keep]

FOLDER needs room for 11.8 GB. Each load runs in a process of its own; the peak is the process's maximum resident set,
in which pages of the mapped file count that the system could take back.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import torch

from vjepa2_ac.config import EncoderSizes, ModelSizes, PredictorSizes
from vjepa2_ac.model.checkpoints.loading import load_official, to_official
from vjepa2_ac.model.network.world_model import WorldModel

SMALL = ModelSizes(encoder=EncoderSizes(depth=4), predictor=PredictorSizes(depth=2))


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the file, load it in each type in a fresh process, print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--small", action="store_true", help="a few layers instead of the full size")
    parser.add_argument("--keep", action="store_true", help="leave the file there")
    parser.add_argument("--load", choices=("float32", "bfloat16"), help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    path = options.folder / "random-vjepa2-ac-vitg.pt"
    if options.load:
        report_load(path, getattr(torch, options.load))
        return
    try:
        if not path.exists():
            options.folder.mkdir(parents=True, exist_ok=True)
            write_random(path, SMALL if options.small else ModelSizes())
        print(f"{path.stat().st_size / 1e9:.2f} GB in {path}")
        print(f"{'dtype':10} {'weights GB':>10} {'peak RSS GB':>11} {'over GB':>8} {'seconds':>8}", flush=True)
        for dtype in ("float32", "bfloat16"):
            subprocess.run([sys.executable, __file__, str(options.folder), "--load", dtype], check=True)  # noqa: S603
    finally:
        if not options.keep:
            path.unlink(missing_ok=True)


def write_random(path: Path, sizes: ModelSizes) -> None:
    """Write a checkpoint with the official's parts: both encoders, the predictor and the optimizer's two moments."""
    model = WorldModel.empty(sizes).to_empty(device="cpu")
    for value in model.parameters():
        value.data.uniform_(-0.1, 0.1)
    whole = to_official(model)
    whole["target_encoder"] = {name: value.clone() for name, value in whole["encoder"].items()}
    moments = {index: (value.clone(), value.clone()) for index, value in enumerate(whole["predictor"].values())}
    torch.save(whole | {"opt": {"state": moments}, "scaler": None, "epoch": 315}, path)


def report_load(path: Path, dtype: torch.dtype) -> None:
    """Load the file and print a line of the table."""
    start = time.perf_counter()
    model = load_official(path, dtype=dtype)
    seconds = time.perf_counter() - start
    weights = sum(value.numel() * value.element_size() for value in model.parameters()) / 1e9
    peak = peak_resident_bytes() / 1e9
    print(f"{str(dtype)[6:]:10} {weights:10.2f} {peak:11.2f} {peak - weights:8.2f} {seconds:8.1f}", flush=True)


def peak_resident_bytes() -> int:
    """Return the most memory this process had; ru_maxrss would count what its parent had when it was started."""
    status = Path("/proc/self/status").read_text()
    return int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1]) * 1024


if __name__ == "__main__":
    main()
