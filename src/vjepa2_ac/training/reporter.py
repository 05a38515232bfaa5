"""The reporter of a run: what is shown while it trains; silent in all other processes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Protocol, runtime_checkable

from vjepa2_ac.evaluation.result import Validation
from vjepa2_ac.reporter import Reporter
from vjepa2_ac.runs.tracker_thread import Image


@runtime_checkable
class TrainingReporter(Reporter, Protocol):
    """Shows the progress of a run, too."""

    def started(self, done: int, total: int) -> None:
        """The loop begins after `done` of `total` optimizer steps."""
        ...

    def stepped(self, step: int, metrics: dict[str, float]) -> None:
        """An optimizer step is done."""
        ...

    def validated(self, step: int, found: Validation) -> None:
        """Held-out clips were measured after `step` optimizer steps."""
        ...


class NullMetricsLog:
    """Writes nothing."""

    def write(self, kind: str, step: int, metrics: Mapping[str, Any]) -> None:
        """Write nothing."""

    def show(self, kind: str, name: str, step: int, image: Image) -> None:
        """Show nothing."""

    is_behind = False

    @contextmanager
    def before_a_checkpoint(self) -> Iterator[None]:
        """Do nothing."""
        yield

    def __enter__(self) -> NullMetricsLog:
        """Return this metrics log."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close nothing."""
