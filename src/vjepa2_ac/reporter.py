"""The reporter: interface through which long operations show messages and their progress."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vjepa2_ac.episode import Progress

INDEXING, LOADING = "indexing the data set", "loading the model"  # titles of common tasks


class Reporter:
    """Shows nothing; subclasses override methods. In a run with several processes only the first one shows output."""

    def note(self, text: str) -> None:
        """Show a message."""

    def task(self, title: str, unit: str = "") -> Progress:  # noqa: ARG002
        """Begin a task, which ends the previous task; return the function that receives its progress.

        Args:
            title: Description of the task.
            unit: Unit of the total, such as "clips"; if set, the rate per second is shown.
        """
        return lambda _done, _total: None

    def on_start(self, done: int, total: int) -> None:
        """Called before the training loop, after `done` of `total` optimizer steps."""

    def on_step(self, step: int, metrics: dict[str, float]) -> None:
        """Called after each optimizer step."""

    def on_validation(self, step: int, validation: Any) -> None:
        """Called after each validation."""


SILENT = Reporter()
