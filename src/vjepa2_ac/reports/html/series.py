"""Colours and names of the models, the same in each chart and table of the page."""

from __future__ import annotations

from dataclasses import dataclass

from vjepa2_ac.evaluation.result import Evaluation, ModelResult, Way

_OTHERS = 4  # colours for other runs, reused after these


@dataclass(frozen=True)
class Series:
    """A measured way of predicting."""

    model: ModelResult
    way: Way
    label: str
    style: str


def persistence(evaluation: Evaluation) -> Series:
    """Return persistence, which every model was measured beside."""
    return Series(evaluation.models[evaluation.trained], "persistence", "persistence", "s-persistence")


def models_of(evaluation: Evaluation) -> tuple[Series, ...]:
    """Return the models, given the true actions."""
    others = [name for name, model in evaluation.models.items() if model.role == "other"]
    styles = {"base": "s-base", "trained": "s-trained"}
    return tuple(
        Series(model, "true", name, styles.get(model.role) or f"s-other{others.index(name) % _OTHERS}")
        for name, model in evaluation.models.items()
    )


def wrong_actions_of(evaluation: Evaluation) -> tuple[Series, ...]:
    """Return the trained model, given other actions than the true ones."""
    name, model = evaluation.trained, evaluation.models[evaluation.trained]
    return (
        Series(model, "zero", f"{name}, zero actions", "s-zero"),
        Series(model, "shuffled", f"{name}, shuffled actions", "s-shuffled"),
    )
