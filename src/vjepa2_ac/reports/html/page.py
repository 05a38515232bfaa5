"""The whole report page: the verdict first, then all measurements and how to read them."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from vjepa2_ac.evaluation.estimates import cost_of_actions, gain_over, over_persistence
from vjepa2_ac.evaluation.metrics import L1
from vjepa2_ac.evaluation.result import Evaluation
from vjepa2_ac.reports.html.actions import actions_section, landscape_section
from vjepa2_ac.reports.html.errors import base_section, error_section, strata_section
from vjepa2_ac.reports.html.examples import animation_style, examples_section
from vjepa2_ac.reports.html.formatting import seconds
from vjepa2_ac.reports.html.layout import ReportSection, share, value
from vjepa2_ac.reports.html.markup import Markup, element, joined
from vjepa2_ac.reports.html.planning import planning_section
from vjepa2_ac.reports.html.runs import calibration_section, episode_section, training_section
from vjepa2_ac.storage import write_atomically

# Nothing may be fetched and nothing may run, whatever the names of episodes contain.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
_COLOURS = {1: "better", 0: "unclear", -1: "worse"}
_GLOSSARY = {
    "latent": "What the frozen encoder makes of a frame: a vector for each patch, layer-normalised. Predictions are"
    " compared with these, not with pixels.",
    "persistence": "The prediction of doing nothing: a copy of the frame that was seen last. An error over persistence"
    " of 1 is as good as that, 0 is perfect.",
    "horizon": "How many model steps ahead is predicted; a model step is several control steps of the robot.",
    "teacher-forced": "Each frame is predicted from the true frames before it, so mistakes cannot add up.",
    "rollout": "Only the first frame is true; each prediction is fed back to make the next, as in planning.",
    "zero, shuffled actions": "Wrong actions on purpose: all zero, or those of another clip. A model that uses its"
    " actions does worse with them.",
    "energy": "The L1 distance between the latents that an action is predicted to lead to and those that came. A"
    " planner takes the action of lowest energy.",
    "[low, high]": "A 95 % interval: whole episodes are drawn again and again, with replacement. With few episodes it"
    " is itself rough. No brackets: one episode only, so nothing is known of the spread. An interval of no width means"
    " that all episodes agree, not that the figure is certain.",
}


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
    sections = (
        error_section(evaluation),
        base_section(evaluation),
        strata_section(evaluation),
        actions_section(evaluation),
        landscape_section(evaluation),
        planning_section(evaluation),
        episode_section(evaluation),
        examples_section(evaluation),
        training_section(evaluation),
        calibration_section(evaluation),
        ReportSection("glossary", "Words", _glossary()),
        ReportSection("about", "What was measured", _about(evaluation)),
    )
    body = element(
        "body",
        element("a", "Skip to the results", href="#errors", class_="skip"),
        _header(evaluation, verdict),
        _contents(sections),
        element("main", *(section.markup() for section in sections)),
        element("footer", f"vjepa2-ac {evaluation.about.version}, {evaluation.about.time}"),
    )
    return f'<!DOCTYPE html>\n<html lang="en">\n{_head(evaluation)}\n{body}\n</html>\n'


def _head(evaluation: Evaluation) -> Markup:
    style = resources.files("vjepa2_ac").joinpath("assets/report.css").read_text(encoding="utf-8")
    return element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("title", f"Evaluation of {evaluation.about.subject}"),
        element("style", Markup(f"\n{style}{animation_style(evaluation.examples)}\n")),
    )


def _header(evaluation: Evaluation, verdict: str) -> Markup:
    about, clips = evaluation.about, evaluation.clips
    measured_on = (
        f"{len(clips)} clips of {clips.episodes} held-out episode{'s' * (clips.episodes != 1)} ({about.split} split),"
        f" up to {evaluation.horizon} model steps or {seconds(evaluation.seconds_ahead)} ahead"
    )
    side, outcome = _outcome(evaluation)
    return element(
        "header",
        element("h1", "Evaluation of ", element("span", about.subject, class_="id")),
        element("p", element("strong", outcome), " ", verdict, class_=f"verdict {side}"),
        element("p", measured_on, class_="on"),
        _tiles(evaluation),
    )


def _tiles(evaluation: Evaluation) -> Markup:
    """Return the most important metrics as tiles."""
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
    cells = [
        element("div", element("dt", name), element("dd", shown), element("dd", about, class_="about"))
        for name, shown, about in tiles
    ]
    return element("dl", *cells, class_="tiles")


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


def _contents(sections: tuple[ReportSection, ...]) -> Markup:
    links = [element("li", element("a", section.title, href=f"#{section.id}")) for section in sections]
    return element("nav", element("ul", *links), aria_label="Contents")


def _glossary() -> Markup:
    terms = [joined(element("dt", term), element("dd", meaning)) for term, meaning in _GLOSSARY.items()]
    return element("dl", *terms, class_="glossary")


def _about(evaluation: Evaluation) -> Markup:
    about, clips = evaluation.about, evaluation.clips
    facts = {
        "subject": about.subject,
        "checkpoint": ", ".join(filter(None, [about.checkpoint, about.checkpoint_path])) or "a model, not a run",
        "data": f"{about.source}: {about.data}",
        "cameras": ", ".join(about.cameras) or "the first one",
        "split": about.split,
        "clips": f"{len(clips)} of {clips.episodes} episodes, {about.frames} frames each",
        "model step": f"{about.stride} control steps, {seconds(about.seconds_per_step)}",
        "moving means": clips.moving_means,
        "seed": str(about.seed),
    }
    terms = [joined(element("dt", term), element("dd", fact)) for term, fact in facts.items()]
    return element("dl", *terms, class_="facts")
