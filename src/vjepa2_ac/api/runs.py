"""Runs from Python: train by a config, and measure a run or a model on held-out episodes."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

from vjepa2_ac.config import Config
from vjepa2_ac.errors import InputError
from vjepa2_ac.evaluation.estimates import over_persistence
from vjepa2_ac.evaluation.request import EvaluationOptions, ProbeOptions
from vjepa2_ac.evaluation.result import Validation
from vjepa2_ac.reporter import NullReporter
from vjepa2_ac.reports.write import Evaluated, evaluate_subject
from vjepa2_ac.training import loop

logger = logging.getLogger(__name__)

_NO_PROBES = ProbeOptions(sensitivity_clips=0, landscape_clips=0, examples=0)


def train(
    config: Config,
    *,
    note: Callable[[str], None] = logger.info,
    on_step: Callable[[int, dict[str, float]], None] | None = None,
    check_only: bool = False,
    allow_config_change: bool = False,
) -> Path:
    """Train as a config says, as `vjepa2-ac train` does, and return the folder of the run.

    If the folder `run_dir` has this run already, training resumes from its newest checkpoint; a finished run is left
    as it is. In the main thread SIGINT (Ctrl-C), SIGTERM and SIGUSR1 end it after the current step, with a checkpoint.

    Args:
        config: The run, from `load_config`.
        note: Called with each message, such as the result of a validation; `print` shows them.
        on_step: Called after each optimizer step with its number, from 1, and its metrics: `loss`, `grad_norm` ...
        check_only: Do everything that can fail, and stop before the first step; nothing is written.
        allow_config_change: Resume a run whose folder has another config.

    Raises:
        InputError: Something cannot be used; raised before the first step wherever possible.
        StoppedError: A signal ended it, see `distributed.signals`; the same call resumes.

    Example:
        >>> run = train(load_config("configs/demo.yaml", ["training.steps=200"]), note=print)
        >>> load_run(run, "best").world_model
    """
    told = _Told(note, on_step)
    return loop.train(config, told, check_only=check_only, allow_config_change=allow_config_change)


def evaluate(
    subject: str | Path,
    *,
    data: Config | None = None,
    out: str | Path | None = None,
    clips: int = 256,
    checkpoint: str | int = "selected",
    probes: bool = True,
) -> Evaluated:
    """Measure a run or a model on held-out episodes, as `vjepa2-ac evaluate` does, and write the report.

    For more options, such as other models to compare with, see `vjepa2_ac.reports.write.evaluate_subject`.

    Args:
        subject: The folder of a run, which is measured beside its base; or a model, as of `load_model`.
        data: A config with other data than the run's own; a model has none of its own.
        out: Folder for metrics.json, report.html and evaluation.png; None: the run's. Needed with `data`.
        clips: At most as many, spread over the test episodes.
        checkpoint: Of a run: selected (the best, else the newest), newest, best, or a number of steps.
        probes: Whether the use of the actions is measured in detail, which takes most of the time: other actions,
            energy landscapes, examples.

    Returns:
        `verdict`, a text; `error_over_persistence` of each model by horizon (below 1: better than copying the first
        frame); `files` that were written; `evaluation`, all arrays.

    Raises:
        InputError: The subject or the data cannot be used, there are no test episodes, or the folder cannot be written.

    Example:
        >>> result = evaluate("demo/run", clips=64)
        >>> result.error_over_persistence["adapter"][-1]  # at the last horizon, with its 95 % interval
        Estimate(value=0.728, low=0.699, high=0.759)
    """
    if data is not None and out is None:
        needed = "a folder for the results: those in a run's own folder are of its own data"
        raise InputError(where="evaluate", found="data without out", needed=needed, fix="Name one: out=FOLDER")
    asked = EvaluationOptions(
        clips=clips,
        checkpoint=str(checkpoint),
        data=data,
        out=None if out is None else Path(out),
        probes=ProbeOptions() if probes else _NO_PROBES,
    )
    return evaluate_subject(str(subject), asked)


class _Told(NullReporter):
    """Calls functions of the user."""

    def __init__(self, note: Callable[[str], None], on_step: Callable[[int, dict[str, float]], None] | None) -> None:
        self._note, self._on_step = note, on_step

    def note(self, text: str) -> None:
        self._note(text)

    def stepped(self, step: int, metrics: dict[str, float]) -> None:
        if self._on_step is not None:
            self._on_step(step, metrics)

    def validated(self, step: int, found: Validation) -> None:
        by_horizon = ", ".join(f"{ratio.value:.3f}" for ratio in over_persistence(found.errors, "rollout"))
        ranked = f"; mean rank of the true action {found.ranking.rank}" if found.ranking else ""
        self._note(f"Validation at step {step}: error over persistence by horizon {by_horizon}{ranked}")
