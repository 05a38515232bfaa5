"""Console tables of the commands, and the console of a training run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
from rich.table import Table

from vjepa2_ac.cli.progress import ConsoleReporter, MetricsTable, console, show, wrap_text
from vjepa2_ac.errors import counted
from vjepa2_ac.evaluation.result import ACTIONS, Validation, one_step_over_persistence, over_persistence
from vjepa2_ac.evaluation.rows import Row, arrange_tables
from vjepa2_ac.evaluation.summary import format_interval, format_percent
from vjepa2_ac.intervals import Estimate
from vjepa2_ac.spaces import POSE

if TYPE_CHECKING:
    from vjepa2_ac.decoding.decoder import DecoderCard
    from vjepa2_ac.goals.make_goals import DemonstrationGoals
    from vjepa2_ac.inspection.findings import Finding
    from vjepa2_ac.inspection.variants import VariantResult
    from vjepa2_ac.planning.decision import PlanResult
    from vjepa2_ac.policies.monitor import EpisodeErrors, Monitor
    from vjepa2_ac.policies.score import PolicyScores
    from vjepa2_ac.simulation.benchmark import ClosedLoopBenchmark

_COLOURS = {"ok": "green", "warning": "yellow", "error": "red", "skipped": "cyan"}
_USUAL_REASONS = {"planned", "nothing", "random", "scripted"}  # for decisions, without a note
_DECODERS = {"decoder": "decoder", "linear": "linear decoder", "mean_image": "mean image"}
_NOTABLE_WAIT_SHARE = 0.2  # of the step time; above it more data.workers or a local copy of the data would help


def row_tables(rows: Sequence[Row], title: str) -> list[Table]:
    """Return console tables of all rows except details. Adjacent sections with equal columns share a table.

    Args:
        rows: Rows of an evaluation or comparison.
        title: Printed above the first table.
    """
    tables: list[Table] = []
    has_intervals = any(row.estimate.has_interval for row in rows)
    interval_note = "95 % interval over episodes" if has_intervals else "one episode: no interval"
    shown = arrange_tables([row for row in rows if not row.detail])
    for columns, group in groupby(shown, lambda section: section.columns):
        sections_of_table = list(group)
        with_chance = any(chance for section in sections_of_table for _, chance, _ in section.lines)
        head = ["", *(["persistence or chance"] if with_chance else []), *columns]
        table = MetricsTable("" if tables else f"{title} ({interval_note})", head)
        for section in sections_of_table:
            table.add_section()
            table.add_row(section.title)
            for label, chance, cells in section.lines:
                table.add_row(f"  {label}", *([chance] if with_chance else []), *cells)
        tables.append(table)
    return tables


def plan_table(result: PlanResult) -> Table:
    """Return a table of a plan, with the action and the predicted state of each model step.

    For poses there is one row per model step. For other states each number that may change has its own row.
    """
    is_pose, turns = result.state_space.is_pose, bool(result.actions[:, POSE.rotation].any())
    names = ["number", "changes by", "then"]
    if is_pose:
        turn = ["turn (degrees)"] * turns
        names = ["dx (cm)", "dy (cm)", "dz (cm)", *turn, "gripper", "then x, y, z (m)", "gripper"]
    why, steps = result.decision.why, len(result.actions)
    has_plan = result.decision.plan is not None and why != "no finite energy"
    title = f"Plan of {counted(steps, 'model step')}" if has_plan else f"Zero action: {why}"
    table = MetricsTable(title, ["step", *names], labelled=False)
    for step, (action, after) in enumerate(zip(result.actions, result.states[1:], strict=True), start=1):
        if is_pose:
            motion = [f"{value * 100:+.2f}" for value in action[POSE.position]]
            turn = [" ".join(f"{value:+.1f}" for value in np.degrees(action[POSE.rotation]))] * turns
            then = " ".join(f"{value:.3f}" for value in after[POSE.position])
            table.add_row(str(step), *motion, *turn, f"{action[POSE.gripper]:+.2f}", then, f"{after[POSE.gripper]:.2f}")
            continue
        for axis in result.space.free.tolist():
            table.add_row(str(step), result.state_space.names[axis], f"{action[axis]:+.4g}", f"{after[axis]:.4g}")
    return table


def goals_table(goals: DemonstrationGoals) -> Table:
    """Return a table with one row per goal that was extracted from a demonstration."""
    columns = ["goal", "frame", "at least", "at most", "share", "gripper"]
    table = MetricsTable(f"Goals of {goals.origin['episode']} (at least and at most: model steps)", columns)
    for number, (key, goal) in enumerate(zip(goals.keys, goals.goals, strict=True), start=1):
        name = f"{number} {goal.name}".strip()
        row = [name, str(key.frame), str(goal.at_least), "no limit" if goal.at_most is None else str(goal.at_most)]
        table.add_row(*row, "not used" if goal.share is None else f"{goal.share:g}", goal.gripper or "default")
    return table


def benchmark_table(benchmark: ClosedLoopBenchmark) -> Table:
    """Return a table with one row per policy of a closed-loop benchmark, with 95 % intervals over episodes."""
    trials = benchmark.trials
    table = MetricsTable(
        f"{trials.task} in {trials.place}: {counted(len(trials.trials), 'problem')} of seed {trials.about['seed']},"
        f" {counted(trials.steps, 'step')} of {trials.seconds_per_step:.2f} s (95 % interval over episodes)",
        ["", f"{trials.criterion} at the end", "at any time", "final distance, cm", "steps", "s per decision"],
    )
    for result in benchmark.results:
        metrics, needed = result.estimates, result.estimates["steps_needed"]
        table.add_row(
            result.policy,
            f"{metrics['success']:.0%}",
            f"{metrics['success_ever']:.0%}",
            f"{metrics['final_distance_cm']:.1f}",
            "" if needed is None else f"{needed.value:.1f}",
            "" if (seconds := metrics["seconds_per_decision"]) is None else f"{seconds.value:.2f}",
        )
    return table


def benchmark_notes(benchmark: ClosedLoopBenchmark) -> tuple[str, ...]:
    """Return notes on the reasons of unusual decisions and on unreachable commands; empty if there are none."""
    notes = []
    for result in benchmark.results:
        decisions = counted(result.seconds.size, "decision")
        for why, number in result.reason_counts.items():
            if why not in _USUAL_REASONS:
                notes.append(f"{result.policy}: {number} of {decisions}: {why}")
        if result.unreachable.any():
            notes.append(f"{result.policy}: {counted(result.unreachable.sum(), 'command')} led out of the arm's reach")
    return tuple(notes)


def held_out_table(card: DecoderCard) -> Table:
    """Return a table of the decoder's image quality on held-out frames, compared with the two baselines."""
    held_out = card.held_out
    table = MetricsTable(
        f"{counted(held_out['frames'], 'frame')} of {counted(held_out['episodes'], 'held-out episode')}"
        " (95 % interval over episodes)",
        ["", "PSNR, dB", "SSIM"],
    )
    for name, label in _DECODERS.items():
        psnr, ssim = (_estimate(held_out[name][metric]) for metric in ("psnr_db", "ssim"))
        table.add_row(label, f"{psnr:.1f}", f"{ssim:.3f}")
    return table


def _estimate(values: dict[str, float | None]) -> Estimate:
    return Estimate(*(math.nan if values[name] is None else float(values[name]) for name in ("value", "low", "high")))  # type: ignore[arg-type]


def print_finding(finding: Finding) -> None:
    """Print one line of `data check`."""
    text = console.render_str(wrap_text(f"{finding.level:<7}  {finding.about:<15}  {finding.text}"))
    text.stylize(_COLOURS[finding.level], 0, 7)
    console.print(text)


def variants_table(title: str, results: Sequence[VariantResult], best: VariantResult | None = None) -> Table:
    """Return the table of `data check --model` and `data calibrate`, with one row per variant of the same clips."""
    columns = ["variant", "error ratio", "95 % CI", "difference", "95 % CI", "episodes"]
    table = MetricsTable(f"{title} (95 % CI over episodes)", columns)
    for result in results:
        cells = [*_estimate_cells(result.ratio), *_estimate_cells(result.difference)]
        table.add_row(f"{result.name}{' <' * (result is best)}", *cells, str(result.episodes))
    return table


def _estimate_cells(estimate: Estimate | None) -> tuple[str, str]:
    """Return the cells of a value and of its interval; empty if they do not exist."""
    if estimate is None:
        return "", ""
    interval = f"{estimate.low:.3f} to {estimate.high:.3f}" if estimate.has_interval else ""
    return f"{estimate.value:.3f}", interval


def scores_table(scores: PolicyScores) -> Table:
    """Return a table with one row per scored policy and one for the demonstrated actions."""
    title = f"Energy relative to the zero action, {counted(scores.places, 'frame')}"
    columns = ["policy", "all chunks", "best chunk", "minus the row above"]
    table = MetricsTable(f"{title} of {counted(scores.episodes, 'episode')}", columns)
    for policy in scores.policies:
        behind = "" if policy.behind is None else str(policy.behind)
        table.add_row(policy.name, str(policy.mean), str(policy.best), behind)
    table.add_row("demonstrated", str(scores.demonstrated), "", "")
    return table


def surprise_table(episodes: Sequence[EpisodeErrors], monitor: Monitor) -> Table:
    """Return a table of the highest surprise and the first alarm of each checked episode."""
    table = MetricsTable("Surprise divided by the threshold", ["episode", "highest", "first alarm at control step"])
    for episode in episodes:
        first, highest = (
            episode.find_first_alarm(monitor),
            episode.compute_scores(monitor.expected).max() / monitor.threshold,
        )
        table.add_row(episode.name, f"{highest:.2f}", "no alarm" if first is None else str(episode.steps[first]))
    return table


class TrainingConsole(ConsoleReporter):
    """Shows a training run: a progress bar, and the metrics of each validation."""

    def __init__(self) -> None:
        super().__init__()
        self._steps = 0

    def on_start(self, done: int, total: int) -> None:
        """Start the progress bar at `done` of `total` optimizer steps."""
        bar, self._steps = self.task("training"), total
        if done < total:
            bar(done, total)

    def on_step(self, step: int, metrics: Mapping[str, float]) -> None:
        """Update the progress bar after an optimizer step: loss, learning rate, speed and memory."""
        speed = metrics["samples_per_second"]
        parts = [f"loss {metrics['loss']:.4f}", f"lr {metrics['learning_rate']:.1e}"]
        parts += [f"{speed:.{1 if speed >= 10 else 2}f} clips/s", f"{metrics['memory_gb']:.1f} GB"]
        if metrics.get("data_wait_share", 0.0) > _NOTABLE_WAIT_SHARE:
            parts.append(f"waits for data {metrics['data_wait_share']:.0%} of the time")
        self._bar(step, self._steps, "  ".join(part for part in parts if part))

    def on_validation(self, step: int, validation: Validation) -> None:
        """Print the metrics of a validation; metrics.jsonl contains them for every horizon."""
        errors = validation.errors
        true, zero, shuffled = (one_step_over_persistence(errors, actions).value for actions in ACTIONS)
        rollout = [estimate.value for estimate in over_persistence(errors, "rollout")]
        rank = "not measured (needs validation.ranking_clips and clips in which the robot moves)"
        if validation.ranking is not None:
            measured = validation.ranking.rank
            share = f"{format_percent(measured.value)} % {format_interval(measured)}".rstrip()
            rank = f"{share} (0 % is best, chance 50 %)"
        show(
            f"validation at step {step:,}, errors relative to persistence (1: copying the last frame)",
            f"  one-step error        {true:.3f}; with zero actions {zero:.3f}, with shuffled actions {shuffled:.3f}",
            f"  rollout error         {rollout[0]:.3f} after 1 model step, {rollout[-1]:.3f} after {len(rollout)}",
            f"  action-ranking error  {rank}",
        )
        if self._steps:
            self.on_start(step, self._steps)  # the validation's bar has replaced the training's bar
