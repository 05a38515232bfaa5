"""Colours and names of the models, the same in each chart and table of the page."""

from __future__ import annotations

from dataclasses import dataclass

from vjepa2_ac.evaluation.result import Actions, Evaluation

_OTHERS = 4  # colours for other runs, reused after these


@dataclass(frozen=True)
class Series:
    """A measured way of predicting."""

    model: str  # its name in the result, or persistence
    actions: Actions
    label: str
    style: str


def persistence() -> Series:
    """Return persistence."""
    return Series("persistence", "true", "persistence", "s-persistence")


def models_of(evaluation: Evaluation) -> tuple[Series, ...]:
    """Return the models, given the true actions."""
    others = [name for name, model in evaluation.models.items() if model.role == "other"]
    styles = {"base": "s-base", "trained": "s-trained"}
    return tuple(
        Series(name, "true", name, styles.get(model.role) or f"s-other{others.index(name) % _OTHERS}")
        for name, model in evaluation.models.items()
    )


def wrong_actions_of(evaluation: Evaluation) -> tuple[Series, ...]:
    """Return the trained model, given other actions than the true ones."""
    name = evaluation.trained
    return (
        Series(name, "zero", f"{name}, zero actions", "s-zero"),
        Series(name, "shuffled", f"{name}, shuffled actions", "s-shuffled"),
    )
