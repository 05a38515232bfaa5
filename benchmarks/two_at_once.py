"""What does a training cost beside another one? The demo's steps alone, and two at once, as whole commands.

    python benchmarks/two_at_once.py                      # as shipped, and as OpenMP waits by default
    python benchmarks/two_at_once.py --spins 0 1000 10000 default

Prints seconds, and ratios: two at once over one alone, and one alone over one alone with OpenMP's default. 2 is what
two trainings cost that share the cores without loss. Needs a quiet machine.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

DEFAULT, SHIPPED = "default", "shipped"
_LIBGOMP = "300000"  # what libgomp takes where nothing is set
_RECORD = ["simulate", "record", "data", "--domain", "B", "--seed", "5", "--episodes"]


def main(arguments: list[str] | None = None) -> int:
    """Measure each setting in turn, several rounds of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--spins", nargs="+", default=[DEFAULT, SHIPPED], help="GOMP_SPINCOUNT")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args(arguments)
    alone: dict[str, list[float]] = {spins: [] for spins in options.spins}
    both: dict[str, list[float]] = {spins: [] for spins in options.spins}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _wait_for([_command([*_RECORD, str(options.episodes)], folder, SHIPPED)])
        for _ in range(options.rounds):
            for spins in options.spins:
                alone[spins].append(_seconds(1, spins, options.steps, folder))
                both[spins].append(_seconds(2, spins, options.steps, folder))
                print(f"{spins}: {alone[spins][-1]:.1f} s alone, {both[spins][-1]:.1f} s two at once", flush=True)
    first = DEFAULT if DEFAULT in alone else options.spins[0]
    base = min(alone[first])
    print(f"{os.cpu_count()} cores, {options.steps} steps, the best of {options.rounds}")
    for spins in options.spins:
        one, two = min(alone[spins]), min(both[spins])
        print(
            f"GOMP_SPINCOUNT {spins:>8}: alone {one:6.1f} s ({one / base:.3f} of {first}),"
            f" two at once {two:6.1f} s ({two / one:.2f}x)"
        )
    return 0


def _seconds(count: int, spins: str, steps: int, folder: Path) -> float:
    """Return how long so many trainings take that start at once."""
    every = f"validation.every={steps}"
    words = ["train", "builtin:demo", "data.path=data", f"training.steps={steps}", every, f"checkpoint.every={steps}"]
    started = time.perf_counter()
    runs = [f"run_dir={tempfile.mkdtemp(dir=folder)}/run" for _ in range(count)]
    _wait_for([_command([*words, run], folder, spins) for run in runs])
    return time.perf_counter() - started


def _command(words: list[str], folder: Path, spins: str) -> subprocess.Popen[bytes]:
    environment = {name: value for name, value in os.environ.items() if name != "GOMP_SPINCOUNT"}
    if spins != SHIPPED:
        environment["GOMP_SPINCOUNT"] = _LIBGOMP if spins == DEFAULT else spins
    command = [sys.executable, "-m", "vjepa2_ac.cli", *words]
    nothing, kept = subprocess.DEVNULL, subprocess.PIPE
    return subprocess.Popen(command, cwd=folder, env=environment, stdout=nothing, stderr=kept)  # noqa: S603 - our own


def _wait_for(processes: list[subprocess.Popen[bytes]]) -> None:
    for process in processes:
        _, said = process.communicate()
        if process.returncode:
            raise SystemExit(said.decode())


if __name__ == "__main__":
    sys.exit(main())
