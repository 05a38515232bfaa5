"""The report of an evaluation: measured, and written as metrics.json, evaluation.png, and one HTML page.

The page has the verdict first, then every number and its figure; it needs no network and no script.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from vjepa2_ac.evaluation.answer import Answer, answer, with_closed_loop
from vjepa2_ac.evaluation.calibration.axes import infer_axes
from vjepa2_ac.evaluation.calibration.variants import calibrate_model
from vjepa2_ac.evaluation.estimates import Curve, gain_over, over_persistence
from vjepa2_ac.evaluation.evaluate_run import measure_subject
from vjepa2_ac.evaluation.request import EvaluationOptions
from vjepa2_ac.evaluation.result import L1, DecodedStrip, EpisodeScore, Evaluation, Example, Row, RowTable, sections
from vjepa2_ac.evaluation.rows import rows_of
from vjepa2_ac.media.figure import svg_of, visible
from vjepa2_ac.media.film import draw_strip
from vjepa2_ac.media.images import encode_jpeg
from vjepa2_ac.reporter import SILENT, Reporter
from vjepa2_ac.reports.figures.evaluation import decoded_strip, drawings, example_strip, plot_evaluation
from vjepa2_ac.reports.metrics_json import METRICS_FILE, write_metrics
from vjepa2_ac.reports.paper import write_tables
from vjepa2_ac.storage import write_atomically

PLOT, REPORT = "evaluation.png", "report.html"
MOST_CLIPS = 4  # example clips, and as many decoded ones
_AT_EACH_END = 8  # episodes in a table
_JPEG_QUALITIES = (85, 70, 50, 30)
_BYTES = 3_000_000  # of all clips together
_COLOURS = {1: "better", 0: "unclear", -1: "worse"}

_PARTS = {  # title, and how the keys of the rows begin; what it means stands in the template
    "errors": ("Error by horizon", r"(rollout|teacher_forced)\.\w+\.(over_pers|error)"),
    "base": ("Compared with the base", r"(rollout|teacher_forced)\.|one_step_gain"),
    "spread": ("Is it as varied as the truth?", "spread|latent_mmd"),
    "steps": ("Where it helps: moving and idle, small and large actions", "one_step"),
    "actions": ("Does it use the actions?", "cost_of|gap_of|sensitivity|ranking|axes"),
    "landscapes": ("Energy landscapes", "landscapes"),
    "planning": ("Plans beside demonstrations", "plans"),
    "episodes": ("Episodes, best and worst", "$^"),
    "examples": ("Example clips", "$^"),
    "decoded": ("What the model imagines, decoded", "decoded"),
    "training": ("Training", "$^"),
    "strides": ("Length of a model step", "strides"),
    "others": ("Further measurements", ""),
}


@dataclass(frozen=True)
class PageImage:
    """An image of the page."""

    url: str
    described: str
    title: str = ""


@dataclass(frozen=True)
class PagePart:
    """A part of the page."""

    id: str
    title: str
    sections: Sequence[RowTable]
    details: Sequence[RowTable]  # folded
    images: Sequence[PageImage]
    notes: Sequence[str]


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
        answer=answer(evaluation, rows),
        side=side,
        outcome=outcome,
        tiles=_tiles(evaluation, rows),
        parts=_parts(evaluation, rows),
        style=Markup(resources.files("vjepa2_ac").joinpath("assets/report.css").read_text("utf-8")),  # noqa: S704
    )


def _parts(evaluation: Evaluation, rows: Sequence[Row]) -> list[PagePart]:
    of_part: dict[str, list[Row]] = {name: [] for name in _PARTS}
    for row in rows:
        of_part[next(name for name, (_, keys) in _PARTS.items() if re.match(keys, row.key))].append(row)
    images: dict[str, list[PageImage]] = {name: [] for name in _PARTS} | {"examples": _examples(evaluation)}
    for one in drawings(evaluation):
        url = svg_of(one.draw, one.width, one.height, evaluation)
        images[one.part].append(PageImage(url, one.described))
    notes = {
        "decoded": () if evaluation.decoded is None else evaluation.decoded.notes,
        "strides": tuple(str(one.as_dict().get("verdict", "")) for one in evaluation.beside.values()),
    }
    parts = []
    for name, (title, _) in _PARTS.items():
        shown = {row.group for row in of_part[name] if not row.detail}
        tables = sections(of_part[name])
        open_ones = [one for one in tables if one.title in shown or len(tables) == 1]
        details = [one for one in tables if one not in open_ones]
        open_ones += _episodes(evaluation.episodes) if name == "episodes" else []
        if name != "others" or tables:
            parts.append(PagePart(name, title, open_ones, details, images[name], notes.get(name, ())))
    return parts


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


def _episodes(scores: Sequence[EpisodeScore]) -> list[RowTable]:
    """Return the best and the worst episodes."""
    parts = {f"All {len(scores)} episodes, best first": scores} if scores else {}
    if len(scores) > 2 * _AT_EACH_END:
        parts = {
            f"The {_AT_EACH_END} best of {len(scores)} episodes, best first": scores[:_AT_EACH_END],
            f"The {_AT_EACH_END} worst of {len(scores)} episodes, worst last": scores[-_AT_EACH_END:],
        }
    columns = ("clips", "L1 error / persistence", "gain over the base")
    return [RowTable(title, columns, tuple(map(_episode, part))) for title, part in parts.items()]


def _episode(score: EpisodeScore) -> tuple[str, str, tuple[str, ...]]:
    gain = "" if score.gain_over_base is None else f"{score.gain_over_base:+.1%}"
    return score.episode_id, "", (str(score.clips), f"{score.over_persistence:.3f}", gain)


def _examples(evaluation: Evaluation) -> list[PageImage]:
    """Return example clips, and their decoded images, in the best quality in which all of them fit."""
    examples = evaluation.examples[:MOST_CLIPS]
    decoded = () if evaluation.decoded is None else evaluation.decoded.strips[:MOST_CLIPS]
    strips = [example_strip(evaluation, one) for one in examples] + [decoded_strip(evaluation, one) for one in decoded]
    urls = jpeg_urls([draw_strip(strip) for strip in strips], at_most=_BYTES)
    images = []
    shown: list[Example | DecodedStrip] = [*examples, *decoded]
    for url, one, strip in zip(urls, shown, strips, strict=False):
        described = "; ".join(row.label.replace("\n", " ") for row in strip.rows)
        named = f"{one.why}: {one.episode_id}, from control step {one.start}"
        images.append(PageImage(url, f"{described}: row by row", named))
    return images


def jpeg_urls(images: Sequence[UInt8[np.ndarray, "height width 3"]], *, at_most: int) -> list[str]:
    """Return images as JPEG in data: URLs, in the best quality in which they fit into so many bytes; or none."""
    for quality in _JPEG_QUALITIES:
        encoded = [base64.b64encode(encode_jpeg(one, quality=quality)).decode() for one in images]
        if sum(map(len, encoded)) <= at_most:
            return [f"data:image/jpeg;base64,{one}" for one in encoded]
    return []


@dataclass(frozen=True)
class Evaluated:
    """The result of an evaluation, and its files."""

    evaluation: Evaluation
    files: tuple[Path, ...]  # written files

    @property
    def answer(self) -> Answer:
        """Does it predict better, does it use the actions, does it plan better; as text by `str`."""
        found = answer(self.evaluation, rows_of(self.evaluation))
        about = self.evaluation.about
        return with_closed_loop(found, Path(about.subject), about.checkpoint) if about.checkpoint else found

    @property
    def report(self) -> Path:
        """The page."""
        return self.files[-1]

    @property
    def error_over_persistence(self) -> dict[str, Curve]:
        """The L1 error of each model's rollout over that of copying the first frame, by horizon (index h - 1)."""
        return {name: over_persistence(one.errors, "rollout") for name, one in self.evaluation.models.items()}


def evaluate_subject(subject: str, asked: EvaluationOptions | None = None, reporter: Reporter = SILENT) -> Evaluated:
    """Measure as `measure_subject` does, and write metrics.json, report and figure.

    Raises:
        InputError: As `measure_subject`.
    """
    asked = asked or EvaluationOptions()
    evaluation = measure_subject(subject, asked, reporter=reporter, find_axes=infer_axes, calibrate=calibrate_model)
    folder = asked.out or Path(subject)
    files = (
        plot_evaluation(evaluation, folder / PLOT),
        write_metrics(evaluation, folder / METRICS_FILE),
        *write_tables(rows_of(evaluation), folder / METRICS_FILE),
        write_report(evaluation, folder / REPORT),
    )
    return Evaluated(evaluation, files)
