"""Console tables show every number and word in full, in narrow and wide terminals and with long cells."""

import re
from collections.abc import Callable
from typing import Any, cast
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from rich.table import Table

from vjepa2_ac.cli.progress import PlainConsole
from vjepa2_ac.cli.tables import benchmark_table, plan_table, row_tables, variants_table
from vjepa2_ac.evaluation.evaluate import EvaluatedModel, evaluate
from vjepa2_ac.evaluation.request import ProbeOptions
from vjepa2_ac.evaluation.rows import Row, make_rows
from vjepa2_ac.inspection.variants import VariantResult
from vjepa2_ac.intervals import Estimate
from vjepa2_ac.planning.decision import PlanResult
from vjepa2_ac.simulation.benchmark import BenchmarkOptions, ClosedLoopBenchmark
from vjepa2_ac.simulation.rollout import ClosedLoopResult
from vjepa2_ac.spaces import POSE, make_vector_states
from worlds import Copier, Halfway, about, clips_batch, repeatable_clips

SURE = Estimate(-0.123, -0.145, -0.101)
SHARE = Estimate(0.912, 0.888, 0.934)


def variants() -> list[Table]:
    results = [
        VariantResult(f"{name} or some other thing", SHARE, 0.4321, 0.5432, 1024, 128, difference)
        for name, difference in (("late", None), ("mirrored", SURE))
    ]
    return [variants_table("variants", results, results[1])]


def evaluations() -> list[Table]:
    names = ["base", "adapter", "runs/of-another-day/with-a-long-name", "vjepa2-ac-vitg.pt"]
    evaluated_models = [
        EvaluatedModel(name, "trained" if name == "adapter" else "base", Halfway()) for name in names[:2]
    ]
    evaluated_models += [EvaluatedModel(name, "other", Copier()) for name in names[2:]]
    probes = ProbeOptions(ranking_clips=4, samples=4, landscape_clips=2, nodes=3, examples=0)
    evaluation = evaluate(cast("Any", evaluated_models), repeatable_clips(clips_batch(12, 0)), about(), probes=probes)
    return row_tables(make_rows(evaluation), "Held-out episodes")


def comparisons() -> list[Table]:
    runs = ("first", "a/run/with/a/name/that/does/not/end/anywhere/near")
    lines = ("4.00 s ahead", "one step", "4.00 s, L2")
    rows = [Row("a group", line, line, run, 0.912, 0.888, 0.934) for run in runs for line in lines]
    return row_tables(rows, "L1 error over persistence")


def plans() -> list[Table]:
    actions, states = np.full((3, 7), -0.12345), np.full((4, 7), -0.54321)
    results = [
        Mock(
            spec=PlanResult, actions=actions, states=states, decision=Mock(why="planned"), state_space=space,
            space=Mock(free=torch.arange(7)),
        )
        for space in (POSE, make_vector_states(7))
    ]  # fmt: skip
    return [plan_table(result) for result in results]


def benchmarks() -> list[Table]:
    result = Mock(
        spec=ClosedLoopResult,
        policy="the model of runs/of-another-day",
        estimates={
            "success": SHARE,
            "success_ever": SHARE,
            "final_distance_cm": Estimate(12.3, 10.1, 14.5),
            "steps_needed": SHARE,
            "seconds_per_decision": Estimate(16.2, 15.0, 17.0),
        },
    )
    trials = BenchmarkOptions("reach", "B", episodes=100, seed=5, steps=20).trials()
    return [benchmark_table(Mock(spec=ClosedLoopBenchmark, trials=trials, results=(result,)))]


@pytest.mark.parametrize("width", [80, 120])
@pytest.mark.parametrize("make_tables", [variants, evaluations, comparisons, plans, benchmarks])
def test_tables_show_all_numbers_and_words_in_full(make_tables: Callable[[], list[Table]], width: int) -> None:
    for table in make_tables():
        console = PlainConsole(width=width)
        with console.capture() as capture:
            console.print(table)
        shown = capture.get()
        assert all(len(line) <= width for line in shown.splitlines() if line and line[0] in "│┃┏┡├└")  # not the title
        assert "…" not in shown
        words = re.split(r"[\s│┃]+", shown)
        for column in table.columns:
            for cell in (column.header, *column.cells):
                for word in str(cell).split():
                    assert word in words or len(word) > 16, (word, shown)
        assert all(word in words for word in str(table.caption or "").split())
