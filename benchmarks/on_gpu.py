"""Run all benchmarks that need a GPU: training step, memory, planning, encoders.

    python benchmarks/on_gpu.py --official ../vjepa2           # all parts: 10 to 15 minutes on an H100
    python benchmarks/on_gpu.py --only graph official --out FOLDER

Each part is a benchmark of this folder with the arguments below. It runs in its own process with a time limit; the
process imports its libraries while the previous part runs. The output of a part is in OUT/PART.log, its metrics are in
OUT/PART.json, which is written after every row, so that interrupted parts keep their rows. If parts fail, their names
are printed and the exit status is 1. Weights are random, because times and memory do not depend on them. --official is
a checkout of facebookresearch/vjepa2, whose training step and planner are timed for comparison; without a checkout they
are skipped.

PyTorch with CUDA, Triton and gcc are needed. Compiled code is cached in TORCHINDUCTOR_CACHE_DIR.
benchmarks/results/gpu.txt is the output on an H100 at commit 0d046757, where the command had four more parts (serving,
decoder, numerics, latents).
"""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from timing import DEFAULT_CHECKOUT

_STEP = "--device cuda --frames 16 --repeats 3 --warm-up 1 --official"
_PLAN = "--device cuda --horizon 1 --at-once 64 --no-memory --warm-up 1 --official"
_QUICK = {"--device cuda": "--quick", "+graph": ""}  # replacements in the arguments with --quick
_CPU_SCALE = 10  # of time limits with --quick: a CPU without AVX-512 emulates bfloat16


@dataclass(frozen=True)
class Part:
    """A benchmark to run."""

    name: str
    benchmark: str
    arguments: str
    limit_s: int


PARTS = (
    Part("train", "train_step", f"{_STEP} none --no-memory --source cache --batch 2 8 --profile"
         " --attention auto per_step auto+compile", 150),
    Part("graph", "train_step", f"{_STEP} none --no-memory --source cache --batch 2 8 --profile"
         " --attention auto+compile+graph", 90),
    Part("graph_alone", "train_step", f"{_STEP} none --no-memory --source cache --batch 2 --attention auto+graph", 60),
    Part("official", "train_step", f"{_STEP} OFFICIAL --full --no-memory --source pixels --batch 2 8"
         " --checkpointing on --attention auto", 90),
    Part("pixels", "train_step", f"{_STEP} none --no-memory --source pixels --batch 2 8"
         " --attention auto auto+compile+graph", 90),
    Part("checkpointing", "train_step", f"{_STEP} none --no-memory --source cache --batch 2 8 --checkpointing on"
         " --attention auto auto+compile+graph", 90),
    Part("memory", "train_step", f"{_STEP} none --memory --no-time --source cache pixels --batch 2 8"
         " --checkpointing off on --attention auto", 90),
    Part("official_memory", "train_step", f"{_STEP} OFFICIAL --full --memory --no-time --source pixels --batch 2 8"
         " --checkpointing on --attention auto", 90),
    Part("plan", "planning", f"{_PLAN} OFFICIAL --repeats 2", 120),
    Part("compiled_plan", "planning", f"{_PLAN} none --repeats 1 --compile --no-adapter", 90),
    Part("encoders", "encoders", "--device cuda", 60),
    Part("chunk", "encoders", "--device cuda --only ViT-g --frames 64", 40),
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the requested parts."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    options = parse(arguments)
    if options.part:
        run(next(part for part in PARTS if part.name == options.part), options)
        return
    options.out.mkdir(parents=True, exist_ok=True)
    parts = [part for part in PARTS if options.only is None or part.name in options.only]
    failed: list[str] = []
    scale = _CPU_SCALE if options.quick else 1
    processes: list[subprocess.Popen[bytes]] = [start(parts[0], arguments, options.out)]
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("stopped by SIGTERM"))
    try:
        for number, part in enumerate(parts):
            began = time.monotonic()
            if number + 1 < len(parts):
                processes.append(start(parts[number + 1], arguments, options.out))
            with suppress(subprocess.TimeoutExpired):
                processes[number].communicate(b"go\n", timeout=part.limit_s * scale)
            status = stop(processes[number])
            print(f"== {part.name}: exit {status}, {time.monotonic() - began:.0f} s", flush=True)
            print((options.out / f"{part.name}.log").read_text(), flush=True)
            failed += [part.name] if status else []
    finally:
        for process in processes:
            stop(process)
    if failed:
        sys.exit(f"failed or out of time: {', '.join(failed)}")


def stop(process: subprocess.Popen[bytes]) -> int:
    """Kill a process and its children, if it is still running; return its exit status."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
    with suppress(BrokenPipeError):
        assert process.stdin is not None
        process.stdin.close()
    return process.wait()


def start(part: Part, arguments: Sequence[str], out: Path) -> subprocess.Popen[bytes]:
    """Start the process of a part. It imports its libraries, and waits for a line on its standard input."""
    with (out / f"{part.name}.log").open("wb") as log:
        return subprocess.Popen(  # noqa: S603 - this program
            [sys.executable, "-u", __file__, *arguments, "--part", part.name],
            stdin=subprocess.PIPE, stdout=log, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip


def run(part: Part, options: argparse.Namespace) -> None:
    """Run a part in this process, after a line has arrived on standard input."""
    arguments = part.arguments.replace("OFFICIAL", str(options.official))
    if options.quick:
        for full, quick in _QUICK.items():
            arguments = arguments.replace(full, quick)
    benchmark = importlib.import_module(part.benchmark)
    if not sys.stdin.readline():  # the parent process has exited
        return
    benchmark.main([*arguments.split(), "--json", str(options.out / f"{part.name}.json")])


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/gpu"), help="folder for logs and metrics")
    parser.add_argument("--official", type=Path, default=DEFAULT_CHECKOUT, help="checkout (default: ../vjepa2)")
    parser.add_argument("--quick", action="store_true", help="tiny sizes on the CPU, to test the program")
    parser.add_argument("--only", nargs="+", choices=[part.name for part in PARTS], help="parts to run (default: all)")
    parser.add_argument("--part", help=argparse.SUPPRESS)
    return parser.parse_args(arguments)


if __name__ == "__main__":
    main()
