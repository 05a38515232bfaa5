"""The whole report page: the verdict first, then all measurements and how to read them."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from markupsafe import Markup

from vjepa2_ac.evaluation.estimates import cost_of_actions, gain_over, over_persistence
from vjepa2_ac.evaluation.metrics import L1
from vjepa2_ac.evaluation.result import Evaluation
from vjepa2_ac.reports.html.actions import actions_section, landscape_section
from vjepa2_ac.reports.html.decoded import decoded_section
from vjepa2_ac.reports.html.errors import base_section, error_section, spread_section, strata_section
from vjepa2_ac.reports.html.examples import animation_style, examples_section
from vjepa2_ac.reports.html.formatting import seconds, share, value
from vjepa2_ac.reports.html.planning import planning_section
from vjepa2_ac.reports.html.runs import calibration_section, episode_section, training_section
from vjepa2_ac.reports.html.templates import render
from vjepa2_ac.storage import write_atomically

_COLOURS = {1: "better", 0: "unclear", -1: "worse"}


def write_report(evaluation: Evaluation, verdict: str, path: Path) -> Path:
    """Write the page; it is written atomically. The same evaluation gives the same bytes."""
    write_atomically(path, report_page(evaluation, verdict))
    return path


def report_page(evaluation: Evaluation, verdict: str) -> str:
    """Return an evaluation as one HTML page that needs no network, no script and no other file.

    It is smaller than 5 MB for any evaluation: the numbers of clips, frames, points and rows shown are limited, and
    photographs have the best quality that fits.

    Args:
        evaluation: The evaluation.
        verdict: The verdict as text: the first thing on the page.
    """
    style = resources.files("vjepa2_ac").joinpath("assets/report.css").read_text(encoding="utf-8")
    side, outcome = _outcome(evaluation)
    sections = (  # id, title, body
        ("errors", "Error by horizon", error_section(evaluation)),
        ("base", "Compared with the base", base_section(evaluation)),
        ("spread", "Is it as varied as the truth?", spread_section(evaluation)),
        ("strata", "Where it helps: moving and idle, small and large actions", strata_section(evaluation)),
        ("actions", "Does it use the actions?", actions_section(evaluation)),
        ("landscapes", "Energy landscapes", landscape_section(evaluation)),
        ("planning", "Plans beside demonstrations", planning_section(evaluation)),
        ("episodes", "Episodes, best and worst", episode_section(evaluation)),
        ("pictures", "Example clips", examples_section(evaluation)),
        ("decoded", "What the model imagines, decoded", decoded_section(evaluation)),
        ("training", "Training", training_section(evaluation)),
        ("strides", "Length of a model step", calibration_section(evaluation)),
        ("glossary", "Words", render("glossary")),
        ("about", "What was measured", render("about", evaluation=evaluation)),
    )
    page = render(
        "page",
        evaluation=evaluation,
        verdict=verdict,
        side=side,
        outcome=outcome,
        tiles=_tiles(evaluation),
        sections=sections,
        style=Markup(style + animation_style(evaluation.examples)),  # noqa: S704 - our own
    )
    return str(page)


def _tiles(evaluation: Evaluation) -> list[tuple[str, Markup, str]]:
    """Return the most important metrics: the name of each, its value, what it means."""
    errors, base = evaluation.errors, evaluation.base_errors
    ahead = f"{seconds(evaluation.seconds_ahead)} ahead, rollout, L1"
    tiles = [("error over persistence", value(over_persistence(errors, "rollout")[-1]), ahead)]
    if base is not None:
        gain = gain_over(errors, base)[-1]
        tiles.insert(0, (f"gain over the {evaluation.base}", share(gain, with_sign=True), ahead))
    cost = cost_of_actions(errors, "shuffled")
    tiles.append(("cost of another clip's actions", share(cost, with_sign=True), "growth of the one-step error"))
    sensitivity = evaluation.models[evaluation.trained].sensitivity
    if sensitivity is not None and sensitivity.rankings:
        first = sensitivity.rankings[0]
        tiles.append(("mean rank of the true action", value(first.mean_rank), "0 is best, 0.5 is chance"))
    return tiles


def _outcome(evaluation: Evaluation) -> tuple[str, str]:
    """Return a colour and a short text: whether training clearly helped, beside the base and beside doing nothing."""
    nothing, base = L1.side(over_persistence(evaluation.errors, "rollout")[-1]), evaluation.base_errors
    beside_nothing = {1: "better than", 0: "not clearly different from", -1: "worse than"}[nothing] + " doing nothing"
    if base is None:
        return _COLOURS[nothing], f"{beside_nothing.capitalize()}."
    gain = gain_over(evaluation.errors, base)[-1].side(0.0)
    words = {1: "Better than the base", 0: "Not clearly different from the base", -1: "Worse than the base"}[gain]
    if nothing == 1:
        return _COLOURS[gain], f"{words}."
    return _COLOURS[min(gain, 0)], f"{words}, and {beside_nothing}."
