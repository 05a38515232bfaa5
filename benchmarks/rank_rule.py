"""Which alpha lets one learning rate serve every rank? LoRA on the simulated arm, alpha = 2 x rank beside alpha = 32.

    python benchmarks/rank_rule.py                  # 18 cells of about a minute on one core; goes on where it stopped
    python benchmarks/rank_rule.py --table          # the table of the cells that are done

The demo's base meets the demo's data (domain B: another camera, light, and angle of the robot). rsLoRA scales the
update by alpha / sqrt(rank): with alpha = 2 x rank that is 2 x sqrt(rank), with alpha constant it falls with the rank.
A cell is the validation error at the last horizon over persistence at the end of its run; one seed.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import load_config
from vjepa2_ac.errors import UserError
from vjepa2_ac.reporter import SILENT
from vjepa2_ac.runs.metrics_log import read_metrics_log
from vjepa2_ac.simulation.record import RecordingSpec, record_dataset
from vjepa2_ac.storage import write_atomically
from vjepa2_ac.training.loop import train

DEMO = Path(__file__).parents[1] / "configs/demo.yaml"
EPISODES, SEED = 60, 5  # of the recording, as `make demo` makes it
RANKS = (4, 8, 16, 32, 64)
RATES = (3e-3, 8e-3)
CONSTANT = 32.0
DIVERGED = None  # a loss that is not finite ended the run


@dataclass(frozen=True)
class Cell:
    """One run."""

    rank: int
    alpha: float
    learning_rate: float

    @property
    def name(self) -> str:
        """What its files are called."""
        return f"r{self.rank}-a{self.alpha:g}-lr{self.learning_rate:g}"


def all_cells() -> Iterator[Cell]:
    """Yield every cell, those in which the rules differ most first; at rank 16 both are the same."""
    for rate in reversed(RATES):
        for rank in reversed(RANKS):
            for alpha in dict.fromkeys((2.0 * rank, CONSTANT)):
                yield Cell(rank, alpha, rate)


def config_of(cell: Cell, folder: Path, steps: int) -> Config:
    """Return the run of a cell: the demo's, from cached latents and with a fifth of its steps."""
    return load_config(DEMO, [
        f"run_dir={folder / 'runs' / cell.name}", f"data.path={folder / 'data'}", "data.workers=0", "data.cache=auto",
        f"data.cache_dir={folder / 'latents'}", "data.cache_dtype=fp32", f"adapter.rank={cell.rank}",
        f"adapter.alpha={cell.alpha}", f"training.learning_rate={cell.learning_rate}", f"training.steps={steps}",
        f"training.warmup_steps={min(20, steps)}", f"validation.every={steps}", "validation.clips=120",
        f"checkpoint.every={steps}", "tracking.tensorboard=false",
    ])  # fmt: skip


def measure(cell: Cell, folder: Path, steps: int) -> dict[str, float | None]:
    """Train a cell, and return its errors over persistence; that of a run which diverged is None."""
    config = config_of(cell, folder, steps)
    try:
        run = train(config, SILENT)
    except UserError as error:
        if "not finite" not in str(error):
            raise
        return {"one_step": DIVERGED, "last_horizon": DIVERGED}
    last = [row for row in read_metrics_log(run / "metrics.jsonl") if row["kind"] == "validation"][-1]
    return {"one_step": last["error_over_persistence"], "last_horizon": last["rollout_over_persistence_last"]}


def table(folder: Path) -> str:
    """Return the table in Markdown of whatever is done: a row per rank, a column per rule and rate."""
    rules = (("alpha 2 x rank", lambda rank: 2.0 * rank), (f"alpha {CONSTANT:g}", lambda _: CONSTANT))
    columns = [(f"{name}, lr {rate:g}", rule, rate) for name, rule in rules for rate in RATES]
    lines = ["| rank | " + " | ".join(name for name, _, _ in columns) + " |", "|---" * (1 + len(columns)) + "|"]
    for rank in RANKS:
        cells = [_shown(folder, Cell(rank, rule(rank), rate)) for _, rule, rate in columns]
        lines.append(f"| {rank} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is not there yet, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("rank_rule"), help="data, latents, runs, results")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--episodes", type=int, default=EPISODES)
    parser.add_argument("--only", default="", help="cells whose name has this in it")
    parser.add_argument("--table", action="store_true", help="run nothing")
    options = parser.parse_args(arguments)
    if not options.table:
        if not (options.folder / "data").exists():
            record_dataset(options.folder / "data", RecordingSpec("B", seed=SEED), episodes=options.episodes)
        for cell in (one for one in all_cells() if options.only in one.name):
            if not _result(options.folder, cell).exists():
                found = measure(cell, options.folder, options.steps)
                write_atomically(_result(options.folder, cell), json.dumps(found).encode())
            print(f"{cell.name}: {_shown(options.folder, cell)}", file=sys.stderr, flush=True)
    print(table(options.folder))


def _result(folder: Path, cell: Cell) -> Path:
    return folder / "results" / f"{cell.name}.json"


def _shown(folder: Path, cell: Cell) -> str:
    """Return the figure of a cell as the table has it."""
    if not _result(folder, cell).exists():
        return "-"
    error = json.loads(_result(folder, cell).read_text())["last_horizon"]
    return "diverged" if error is DIVERGED else f"{error:.3f}"


if __name__ == "__main__":
    main()
