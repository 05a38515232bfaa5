"""The report page: the verdict first, then every number and its figure. One HTML file, without network and script."""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from vjepa2_ac.evaluation.estimates import gain_over, over_persistence
from vjepa2_ac.evaluation.result import L1, EpisodeScore, Evaluation, Row, RowTable, sections
from vjepa2_ac.evaluation.rows import rows_of
from vjepa2_ac.evaluation.verdict import verdict
from vjepa2_ac.media.images import encode_jpeg
from vjepa2_ac.reports.figures import evaluation as figures
from vjepa2_ac.reports.figures.film import draw_strip
from vjepa2_ac.reports.figures.page import svg_of, visible
from vjepa2_ac.storage import write_atomically

MOST_CLIPS = 4  # example clips, and as many decoded ones
_AT_EACH_END = 8  # episodes in a table
_JPEG_QUALITIES = (85, 70, 50, 30)
_BYTES = 3_000_000  # of all clips together
_COLOURS = {1: "better", 0: "unclear", -1: "worse"}

Draw = Callable[[Any], None]  # on a figure


@dataclass(frozen=True)
class PageImage:
    """An image of the page."""

    url: str
    described: str
    title: str = ""


@dataclass(frozen=True)
class PagePart:
    """A part of the page; what it means stands in the template."""

    id: str
    title: str
    sections: tuple[RowTable, ...] = ()
    details: tuple[RowTable, ...] = ()  # folded
    images: tuple[PageImage, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass
class _Plan:
    """What a part is made of, besides the rows whose keys begin so."""

    title: str
    keys: tuple[str, ...] = ()
    draw: dict[str, tuple[float, float, Draw]] = field(default_factory=dict)  # description -> inches, and how


def write_report(evaluation: Evaluation, path: Path) -> Path:
    """Write the page; it is written atomically. The same evaluation gives the same bytes."""
    write_atomically(path, report_page(evaluation))
    return path


def report_page(evaluation: Evaluation) -> str:
    """Return an evaluation as one HTML page that needs no network, no script and no other file.

    It is smaller than 5 MB for any evaluation of usual length: clips, points of curves and episodes are limited, and
    images of clips have the best quality that fits.
    """
    rows = rows_of(evaluation)
    side, outcome = _outcome(evaluation)
    environment = Environment(
        loader=PackageLoader("vjepa2_ac", "assets"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=lambda value: visible(value) if isinstance(value, str) and not isinstance(value, Markup) else value,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.tests["search_for"] = lambda text, word: word in text
    environment.filters["breakable"] = lambda name: Markup("/<wbr>").join(map(visible, name.split("/")))
    return environment.get_template("report.html.jinja").render(
        evaluation=evaluation,
        verdict=verdict(evaluation),
        side=side,
        outcome=outcome,
        tiles=_tiles(evaluation, rows),
        parts=_parts(evaluation, rows),
        style=Markup(resources.files("vjepa2_ac").joinpath("assets/report.css").read_text("utf-8")),  # noqa: S704
    )


def _parts(evaluation: Evaluation, rows: Sequence[Row]) -> list[PagePart]:
    plans = _plans(evaluation)
    of_part: dict[str, list[Row]] = {name: [] for name in plans}
    for row in rows:
        place = next((name for name, plan in plans.items() if re.match("|".join(plan.keys) or "$^", row.key)), "others")
        of_part[place].append(row)
    parts = []
    for name, plan in plans.items():
        images = [PageImage(svg_of(draw, *size), described) for described, (*size, draw) in plan.draw.items()]
        shown = {row.group for row in of_part[name] if not row.detail}
        tables = sections(of_part[name])
        parts.append(
            PagePart(
                name,
                plan.title,
                tuple(one for one in tables if one.title in shown or len(tables) == 1),
                tuple(one for one in tables if one.title not in shown and len(tables) > 1),
                tuple(images),
            )
        )
    extra: dict[str, dict[str, Any]] = {
        "episodes": {"sections": _episodes(evaluation.episodes)},
        "examples": {"images": _examples(evaluation)},
        "decoded": {"notes": () if evaluation.decoded is None else evaluation.decoded.notes},
        "strides": {"notes": tuple(str(one.as_dict().get("verdict", "")) for one in evaluation.beside.values())},
    }
    return [
        PagePart(**{**vars(part), **extra.get(part.id, {})})
        for part in parts
        if part.id != "others" or of_part["others"]
    ]


def _plans(evaluation: Evaluation) -> dict[str, _Plan]:
    """Return the parts of the page in their order, with the figures that can be drawn."""
    e, models = evaluation, evaluation.models.values()
    plans = {
        "errors": _Plan("Error by horizon", (r"(rollout|teacher_forced)\.\w+\.(over_pers|error)",)),
        "base": _Plan("Compared with the base", (r"(rollout|teacher_forced)\.", "one_step_gain")),
        "spread": _Plan("Is it as varied as the truth?", ("spread", "latent_mmd")),
        "steps": _Plan("Where it helps: moving and idle, small and large actions", ("one_step",)),
        "actions": _Plan("Does it use the actions?", ("cost_of", "gap_of", "sensitivity", "ranking", "axes")),
        "landscapes": _Plan("Energy landscapes", ("landscapes",)),
        "planning": _Plan("Plans beside demonstrations", ("plans",)),
        "episodes": _Plan("Episodes, best and worst"),
        "examples": _Plan("Example clips"),
        "decoded": _Plan("What the model imagines, decoded", ("decoded",)),
        "training": _Plan("Training"),
        "strides": _Plan("Length of a model step", ("strides",)),
        "others": _Plan("Further measurements"),
    }
    forced = partial(figures.draw_errors, mode="teacher_forced")
    plans["errors"].draw = {
        "Open-loop L1 error over persistence by horizon": (
            6.4,
            3.6,
            partial(_on_axes, draw=figures.draw_errors, evaluation=e),
        ),
        "Teacher-forced L1 error over persistence by horizon": (6.4, 3.6, partial(_on_axes, draw=forced, evaluation=e)),
    }
    if e.base is not None:
        plans["base"].draw = {
            "Gain over the base by horizon": (6.4, 3.4, partial(_on_axes, draw=figures.draw_gains, evaluation=e))
        }
    if any(model.distribution and math.isfinite(model.distribution.spread[-1].value) for model in models):
        plans["spread"].draw = {
            "Spread by horizon": (6.4, 3.4, partial(_on_axes, draw=figures.draw_spread, evaluation=e))
        }
    plans["actions"].draw = {
        "One-step error with other actions": (
            6.4,
            3.0,
            partial(_on_axes, draw=figures.draw_use_of_actions, evaluation=e),
        )
    }
    if any(model.sensitivity for model in models):
        plans["actions"].draw["Ranks of the true action"] = (
            6.4,
            3.4,
            partial(_on_axes, draw=figures.draw_ranks, evaluation=e),
        )
    if clips := figures.landscape_clips(e):
        rows = len(clips) * (2 if e.base and e.models[e.base].landscapes else 1)
        drawn = partial(figures.draw_landscapes, evaluation=e)
        plans["landscapes"].draw = {
            "Energy around the true action: cross; lowest energy: ring": (9.0, 2.6 * rows, drawn)
        }
    if e.planning is not None:
        plans["planning"].draw = {"Ends of plans": (11.0, 3.6, partial(figures.draw_plans, evaluation=e))}
    if e.episodes:
        plans["episodes"].draw = {
            "Error of every episode": (6.4, 3.0, partial(_on_axes, draw=figures.draw_episodes, evaluation=e))
        }
    if e.decoded is not None:
        plans["decoded"].draw = {
            "PSNR by horizon": (6.4, 3.6, partial(_on_axes, draw=figures.draw_decoded, evaluation=e))
        }
    if charts := len(figures.training_charts(e.training)):
        drawn = partial(figures.draw_training, evaluation=e)
        plans["training"].draw = {"Metrics over optimizer steps": (11.0, 2.8 * -(-charts // 3), drawn)}
    return plans


def _on_axes(figure: Any, draw: Callable[[Any, Evaluation], None], evaluation: Evaluation) -> None:
    draw(figure.subplots(), evaluation)


def _tiles(evaluation: Evaluation, rows: Sequence[Row]) -> list[Row]:
    """Return the most important numbers of the evaluated model."""
    keys = [f"rollout.{L1.name}.{what}.{evaluation.horizon}" for what in ("gain_over_base", "over_persistence")]
    keys += ["cost_of_actions.shuffled", "ranking.rank", "plans.missed_cm"]
    found = {row.key: row for row in rows if row.model == evaluation.trained}
    return [found[key] for key in keys if key in found]


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


def _episodes(scores: Sequence[EpisodeScore]) -> tuple[RowTable, ...]:
    """Return the best and the worst episodes."""
    if not scores:
        return ()
    parts = {f"All {len(scores)} episodes, best first": scores}
    if len(scores) > 2 * _AT_EACH_END:
        parts = {
            f"The {_AT_EACH_END} best of {len(scores)} episodes, best first": scores[:_AT_EACH_END],
            f"The {_AT_EACH_END} worst of {len(scores)} episodes, worst last": scores[-_AT_EACH_END:],
        }
    columns = ("clips", "L1 error / persistence", "gain over the base")
    return tuple(RowTable(title, columns, tuple(map(_episode, part))) for title, part in parts.items())


def _episode(score: EpisodeScore) -> tuple[str, str, tuple[str, ...]]:
    gain = "" if score.gain_over_base is None else f"{score.gain_over_base:+.1%}"
    return score.episode_id, "", (str(score.clips), f"{score.over_persistence:.3f}", gain)


def _examples(evaluation: Evaluation) -> tuple[PageImage, ...]:
    """Return example clips, and their decoded images, in the best quality in which all of them fit."""
    strips = [(figures.example_strip(evaluation, one), one) for one in evaluation.examples[:MOST_CLIPS]]
    decoded = () if evaluation.decoded is None else evaluation.decoded.strips[:MOST_CLIPS]
    every = [*strips, *((figures.decoded_strip(evaluation, one), one) for one in decoded)]
    urls = jpeg_urls([draw_strip(strip) for strip, _ in every], at_most=_BYTES)
    return tuple(
        PageImage(url, f"{'; '.join(row.label.replace(chr(10), ' ') for row in strip.rows)}: row by row", _named(one))
        for url, (strip, one) in zip(urls, every, strict=False)
    )


def _named(one: Any) -> str:
    return f"{one.why}: {one.episode_id}, from control step {one.start}"


def jpeg_urls(images: Sequence[UInt8[np.ndarray, "height width 3"]], *, at_most: int) -> list[str]:
    """Return images as JPEG in data: URLs, in the best quality in which they fit into so many bytes; or none."""
    for quality in _JPEG_QUALITIES:
        encoded = [base64.b64encode(encode_jpeg(one, quality=quality)).decode() for one in images]
        if sum(map(len, encoded)) <= at_most:
            return [f"data:image/jpeg;base64,{one}" for one in encoded]
    return []
