"""Run the cells of a study in processes, one thread each."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from results import write_result


@dataclass(frozen=True)
class Work:
    """The work folder of a study, and the number of processes."""

    folder: Path  # data, base models, runs and measurements
    workers: int  # number of processes

    def run(
        self,
        function: Callable[..., Any],
        calls: Sequence[tuple[Any, ...]],
        save: Callable[[str, Any], None] | None = None,
    ) -> int:
        """Call a function in new processes with one thread each; return the number of failed calls.

        Args:
            function: A function of a module.
            calls: The arguments of each call; the first one has a name.
            save: Receives the name and the result of each call.

        Raises:
            BrokenProcessPool: A process was killed, most likely because it used too much memory.
        """
        os.environ["OMP_NUM_THREADS"] = "1"
        context, failed = multiprocessing.get_context("spawn"), 0
        with ProcessPoolExecutor(self.workers, mp_context=context, max_tasks_per_child=1) as pool:
            futures = {pool.submit(_call, function, arguments): arguments[0].name for arguments in calls}
            for number, future in enumerate(as_completed(futures), start=1):
                name = futures[future]
                try:
                    result = future.result()
                except BrokenProcessPool:
                    raise
                except Exception as error:  # the other calls continue
                    print(f"{name} failed: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
                    failed += 1
                    continue
                if save is not None:
                    save(name, result)
                print(f"{number}/{len(futures)} {name}", flush=True)
        return failed

    def measure(self, study: str, module: str, cells: Sequence[Any], goals: int) -> int:
        """Measure the cells of a study and write a file for each one; return the number of failed cells."""
        calls = [(cell, module, self.folder, goals) for cell in cells]
        return self.run(
            measure_cell, calls, lambda name, result: write_result(self.folder / study / f"{name}.json", result)
        )


def _call(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    torch.set_num_threads(1)
    return function(*arguments)


def measure_cell(cell: Any, module: str, folder: Path, goals: int) -> dict[str, Any]:
    """Return the result of a cell, with the commit, the version of PyTorch and the processor time."""
    started = time.process_time()
    result = import_module(module).measure(cell, folder, goals)
    described = {"cell": asdict(cell), "made_with": describe_software(), "goals": goals}
    return {**described, "core_minutes": round((time.process_time() - started) / 60, 2), **result}


def describe_software() -> dict[str, str]:
    """Return the version of PyTorch and the commit of this checkout."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=7"]
    described = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    return {"torch": torch.__version__, "commit": described.stdout.strip() or "unknown"}
