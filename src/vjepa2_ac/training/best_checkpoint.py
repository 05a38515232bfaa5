"""The best validation of a run. Only errors of the same clips, time span and latents are compared."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import replace

from vjepa2_ac.config import Config
from vjepa2_ac.config.loading import flat
from vjepa2_ac.config.section import Affects, knobs_that_affect
from vjepa2_ac.data.dataset import Dataset
from vjepa2_ac.data.loader import validation_windows
from vjepa2_ac.reporter import Reporter
from vjepa2_ac.runs.checkpoint import RunState

_SELECTS = "checkpoint.keep_best"


def measured_on(config: Config, dataset: Dataset) -> Mapping[str, str]:
    """Return what determines the measurements of a validation, by readable names."""
    decide = flat(knobs_that_affect(Affects.MEASURED, config))
    settings = {key: json.dumps(value) for key, value in decide.items()}
    windows = validation_windows(dataset, "validation", clips=config.validation.clips)
    clips = [(dataset.table.identity(episode), int(start)) for episode, start in windows]
    return {**settings, "its clips": hashlib.sha256(json.dumps(clips).encode()).hexdigest()[:16]}


def best_so_far(state: RunState, now: Mapping[str, str], reporter: Reporter) -> RunState:
    """Return the state to resume from: a best validation by other measurements is dropped, with a message.

    What a state of an earlier version does not record, or records beyond what matters now, is accepted; those selected
    by error.
    """
    before = {_SELECTS: '"error"', **(state.measured_on or {})}
    differing = sorted(key for key in before.keys() & now if before[key] != now[key])
    state = replace(state, measured_on=dict(now))
    if not differing or state.best_error is None:
        return state
    reporter.note(
        f"Validation measures something else than before (other: {', '.join(differing)}): the error"
        f" {state.best_error:.4g} of step {state.best_step}, the best so far, does not compare and no longer counts."
    )
    return replace(state, best_step=None, best_error=None, best_rank=None, lowest_rank=None)
