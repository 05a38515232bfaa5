"""Divergence warnings: has training made the model worse? One warning per cause, in metrics.jsonl and on the console.

Only the rows of the metrics log are used, so that a resumed run neither loses nor repeats a warning.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from vjepa2_ac.config import Config
from vjepa2_ac.reporter import Reporter
from vjepa2_ac.runs.metrics_log import WARNING, MetricsLog, read_metrics_log
from vjepa2_ac.runs.trackers import Trackers

_MEASURES = {
    "error_over_persistence": "one-step error",
    "rollout_over_persistence_last": "rollout error at the last horizon",
}
_NOISE = 1.01  # validation clips are always the same; smaller changes mean nothing
_LOSSES = 10  # number of `train` rows whose median is compared
_FEWEST_LOSSES = 5
_FAR_ABOVE = 2.0  # times the lowest such median


class WatchedMetricsLog(MetricsLog):
    """A metrics log that warns when its rows show that training diverges.

    Args:
        run_dir: The run's folder.
        config: Its config, for the knobs to change.
        reporter: Receives messages for the user.
        first_step: As of `MetricsLog`.
        trackers: As of `MetricsLog`.
    """

    def __init__(
        self,
        run_dir: Path,
        *,
        config: Config,
        reporter: Reporter,
        first_step: int,
        trackers: Trackers | None = None,
    ) -> None:
        super().__init__(run_dir, first_step=first_step, trackers=trackers)
        self._watch, self._reporter = Watch(config), reporter
        for row in read_metrics_log(self.path):
            self._watch(str(row.get("kind")), row["step"], row)

    def write(self, kind: str, step: int, metrics: Mapping[str, Any]) -> None:
        """Append a row, followed by its warnings."""
        super().write(kind, step, metrics)
        for text in self._watch(kind, step, metrics):
            super().write(WARNING, step, {"text": text})
            self._reporter.note(f"Warning: {text}")


class Watch:
    """Checks the rows of a metrics log one after the other.

    Args:
        config: Of the run.
    """

    def __init__(self, config: Config) -> None:
        self._config = config
        self._reported: set[str] = set()
        self._at_start: dict[str, float] = {}
        self._rank_at_start: Mapping[str, Any] = {}
        self._losses: deque[float] = deque(maxlen=_LOSSES)
        self._lowest = math.inf

    def __call__(self, kind: str, step: int, metrics: Mapping[str, Any]) -> list[str]:
        """Return the warnings of a row: none if it is fine or the cause is known already."""
        found = {"validation": self._of_validation, "train": self._of_loss}.get(kind)
        new = {cause: text for cause, text in found(step, metrics) if cause not in self._reported} if found else {}
        self._reported |= set(new)
        return [f"at step {step:,} {text}. {advice(self._config)}" for text in new.values()]

    def _of_validation(self, step: int, metrics: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        now = {name: _number(metrics.get(key)) for key, name in _MEASURES.items()}
        if step == 0:
            self._at_start, self._rank_at_start = now, metrics
            return
        yield from self._of_ranking(now, metrics)
        if not all(map(math.isfinite, now.values())):
            yield "not finite", "an error of the validation is not a finite number"
        starts = {name: self._at_start.get(name, math.nan) for name in now}
        worse = [name for name, value in now.items() if value > _NOISE * starts[name]]
        if not worse:
            return
        errors = " and ".join(f"the {name} is {now[name]:.3f} (before training {starts[name]:.3f})" for name in worse)
        beyond = any(now[name] > 1.0 > starts[name] for name in worse)
        copying = "; copying the last frame would be better" if beyond else ""
        last = step == self._config.training.steps
        yield f"{worse} {beyond} {last}", f"{errors} of persistence's in the validation{copying}"

    def _of_ranking(self, now: Mapping[str, float], metrics: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """Warn of a model that planning would not want, though it may predict better: the intervals are apart."""
        rank, low = (_number(metrics.get(key)) for key in ("action_rank", "action_rank_low"))
        before, high = (_number(self._rank_at_start.get(key)) for key in ("action_rank", "action_rank_high"))
        if low > high:
            better = all(value < self._at_start.get(name, math.nan) for name, value in now.items())
            words = "predicts better and plans worse than the base" if better else "plans worse than the base"
            text = f"the model {words}: the mean rank of the true action among others is {rank:.3f}"
            hint = "`vjepa2-ac data check` says how varied the motion of the data is"
            yield "rank", f"{text} (before training {before:.3f}; 0 is best, 0.5 chance). {hint}"

    def _of_loss(self, _step: int, metrics: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        loss = _number(metrics.get("loss"))
        if not math.isfinite(loss):  # a step without clips, or one that was refused
            return
        self._losses.append(loss)
        if len(self._losses) < _FEWEST_LOSSES:
            return
        typical = statistics.median(self._losses)
        self._lowest = min(self._lowest, typical)
        if typical > _FAR_ABOVE * self._lowest:
            yield "loss", f"the loss is {typical:.4g}, and was {self._lowest:.4g} (medians of {_LOSSES} rows)"


def advice(config: Config) -> str:
    """Return the knobs to change in a config whose training has made the model worse."""
    training, adapter = config.training, config.adapter
    knobs = [f"lower training.learning_rate ({training.learning_rate:g})"]
    if adapter.kind == "lora":
        knobs.append(f"lower adapter.alpha ({adapter.alpha:g}) or adapter.rank ({adapter.rank})")
    if training.max_grad_norm is None:
        knobs.append("set training.max_grad_norm=1")
    knobs.append(f"raise training.warmup_steps ({training.warmup_steps:,})")
    best = (
        "; the best checkpoint is kept, and used unless another is asked for"
        if config.checkpoint.keep_best != "off"
        else ""
    )
    return f"If it stays so: {', '.join(knobs)}{best}"


def _number(value: Any) -> float:
    """Return a number; NaN for one that JSON could not hold."""
    return float(value) if isinstance(value, int | float) else math.nan
