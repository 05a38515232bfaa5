"""A training run in a terminal: its bar, its validations."""

from __future__ import annotations

from collections.abc import Mapping

from vjepa2_ac.cli.console.progress import ConsoleReporter, show
from vjepa2_ac.evaluation.result import ACTIONS, Validation, one_step_over_persistence, over_persistence
from vjepa2_ac.evaluation.summary import interval_of, percent

_MUCH_WAITING = 0.2  # share of a step's time; above it more data.workers, or a nearer copy of the data, would help


class TrainingConsole(ConsoleReporter):
    """Shows a training run."""

    def __init__(self) -> None:
        super().__init__()
        self._steps, self._validation = 0, ""

    def started(self, done: int, total: int) -> None:
        """Begin the bar."""
        bar, self._steps = self.task("training"), total
        if done < total:
            bar(done, total)

    def stepped(self, step: int, metrics: Mapping[str, float]) -> None:
        """Move the bar."""
        speed = metrics["samples_per_second"]
        words = [f"loss {metrics['loss']:.4f}", self._validation, f"{speed:.{1 if speed >= 10 else 2}f} clips/s"]
        if "bytes_per_clip" in metrics:
            words.append(f"{metrics['bytes_per_clip'] / 1e6:.2f} MB/clip")
        if metrics.get("data_wait_share", 0.0) > _MUCH_WAITING:
            words.append(f"waits for data {metrics['data_wait_share']:.0%} of the time")
        self._bar(step, self._steps, "  ".join(word for word in words if word))

    def validated(self, step: int, found: Validation) -> None:
        """Print the validation's metrics; metrics.jsonl has them for every horizon."""
        errors = found.errors
        true, zero, shuffled = (one_step_over_persistence(errors, actions).value for actions in ACTIONS)
        rollout = [one.value for one in over_persistence(errors, "rollout")]
        self._validation = f"one-step error {true:.3f} of persistence"
        rank = "not measured (needs validation.ranking_clips and clips in which the robot moves)"
        if found.ranking is not None:
            measured = found.ranking.rank
            share = f"{percent(measured.value)} % {interval_of(measured)}".rstrip()
            rank = f"{share} (0 % is best, chance 50 %)"
        show(
            f"validation at step {step:,}, errors relative to persistence (1: copying the last frame)",
            f"  one-step error        {true:.3f}; with zero actions {zero:.3f}, with shuffled actions {shuffled:.3f}",
            f"  rollout error         {rollout[0]:.3f} after 1 model step, {rollout[-1]:.3f} after {len(rollout)}",
            f"  action-ranking error  {rank}",
        )
