"""What do the processes of a run use that neither show nor write? All but the first one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from vjepa2_ac.evaluation.metrics import PredictionErrors


class QuietReporter:
    """Shows nothing."""

    def note(self, text: str) -> None:
        """Say nothing."""

    def looked_through(self, done: int, total: int) -> None:
        """Show nothing."""

    def encoded(self, done: int, total: int) -> None:
        """Show nothing."""

    def started(self, done: int, total: int) -> None:
        """Show nothing."""

    def stepped(self, step: int, figures: dict[str, float]) -> None:
        """Show nothing."""

    def validated(self, step: int, errors: PredictionErrors) -> None:
        """Show nothing."""


class QuietJournal:
    """Writes nothing."""

    def write(self, kind: str, step: int, figures: Mapping[str, Any]) -> None:
        """Write nothing."""

    is_behind = False

    @contextmanager
    def before_a_checkpoint(self) -> Iterator[None]:
        """Do nothing."""
        yield

    def __enter__(self) -> QuietJournal:
        """Return the journal."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close nothing."""
