"""Write the files of an evaluation: metrics.json, metrics.csv, evaluation.png, and one HTML page.

The page begins with the summary and a video. All numbers and plots follow in collapsed sections. The page needs no
network access and no JavaScript.
"""

from __future__ import annotations

import base64
import math
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from vjepa2_ac.episode import shorten_names
from vjepa2_ac.errors import counted
from vjepa2_ac.evaluation.result import L1, Curve, DecodedStrip, Evaluation, Example, over_persistence
from vjepa2_ac.evaluation.rows import Row, RowTable, arrange_tables, make_rows
from vjepa2_ac.evaluation.summary import Summary, Verdict, format_interval, format_percent, summarize, with_closed_loop
from vjepa2_ac.media.figure import draw_strip, figure_to_svg, replace_hidden_characters
from vjepa2_ac.media.images import encode_webp
from vjepa2_ac.reports.evaluation_figures import decoded_strip, evaluation_plots, example_strip, plot_evaluation
from vjepa2_ac.reports.metrics_json import METRICS_FILE, missing_parts, write_csv, write_metrics
from vjepa2_ac.storage import write_atomically

PLOT, REPORT = "evaluation.png", "report.html"
MAX_CLIPS = 4  # maximum number of example clips, and of decoded clips
_MAX_CLIP_BYTES = 3_000_000  # maximum size of all clips together
_BAR_MARGIN = 10.0  # margin on both sides of a bar, in percent of its width
MAX_VIDEO_S = 6.0  # maximum duration of the video, in seconds
MAX_VIDEO_BYTES = 600_000
_STEP_S, _FIRST_S, _LAST_S = 0.5, 1.2, 1.8  # display times of the middle, first and last frames
_QUALITIES = (85, 70, 50, 30, 10)
_GAP_RATIO = 32  # width of an image, divided by the width of a gap or the height of the progress bar
_GREY, _PROGRESS = 170, (31, 111, 180)  # colours of gaps and progress bar, visible on white and on black
_PARTS = {  # id of the part -> title, and a pattern for the keys of the part's rows
    "errors": ("Error by horizon", r"rollout\.\w+\.over_persistence"),
    "base": ("Comparison with the base model", r"rollout\."),
    "actions": ("Sensitivity to actions", "one_step|cost_of|gap_of|ranking"),
    "examples": ("Example clips", "$^"),
    "decoded": ("Decoded images", "decoded"),
    "distribution": ("Distribution of the predictions", "spread|latent_mmd|fvd"),
    "landscapes": ("Energy landscapes", "landscapes"),
}

Frame = UInt8[np.ndarray, "height width 3"]


class PageImage(NamedTuple):
    """An image of the page."""

    url: str
    alt: str  # description for screen readers
    clip: Example | DecodedStrip | None = None  # the clip that the image shows


class PagePart(NamedTuple):
    """A part of the page."""

    id: str
    title: str
    tables: Sequence[RowTable]
    images: Sequence[PageImage]
    notes: Sequence[str]


def render_page(evaluation: Evaluation, summary: Summary) -> str:
    """Return an evaluation and its summary as one HTML page that needs no network, no script and no other file.

    The same evaluation and summary give the same bytes. The page stays below 5 MB, because the numbers of clips, points
    of curves and episodes are limited, and images of clips have the best quality that fits.
    """
    rows = make_rows(evaluation)
    environment = Environment(
        loader=PackageLoader("vjepa2_ac", "assets"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=lambda value: (
            replace_hidden_characters(value) if isinstance(value, str) and not isinstance(value, Markup) else value
        ),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["breakable"] = lambda name: Markup("/<wbr>").join(
        map(replace_hidden_characters, name.split("/"))
    )
    environment.filters |= {
        "quote": shlex.quote,
        "bar": compute_bar_positions,
        "percent": format_percent,
        "interval": format_interval,
    }
    environment.filters |= {"code": render_code, "count": counted}
    environment.filters["number"] = lambda row: f"{format_percent(row.value)} %" if row.better else f"{row.value:.2f}"
    environment.filters["baseline"] = lambda verdict: (
        f"{100 * verdict.baseline:.0f} %" if verdict.unit == "%" else f"{verdict.baseline:.1f} {verdict.unit}"
    )
    return environment.get_template("report.html.jinja").render(
        evaluation=evaluation,
        verdicts=summary,
        tiles=_select_tiles(evaluation, rows, summary),
        video=make_video(evaluation),
        parts=_make_parts(evaluation, rows),
        missing=missing_parts(evaluation),
        short=shorten_names(evaluation.clips.episode_ids),
        style=Markup(resources.files("vjepa2_ac").joinpath("assets/report.css").read_text("utf-8")),  # noqa: S704
    )


def render_code(text: str) -> Markup:
    """Return a text as HTML, with text between backticks as code."""
    parts = [escape(replace_hidden_characters(part)) for part in text.split("`")]
    if len(parts) % 2 == 0:  # an unpaired backtick
        return Markup("`").join(parts)
    return Markup("").join(Markup("<code>{}</code>").format(part) if n % 2 else part for n, part in enumerate(parts))


def compute_bar_positions(verdict: Verdict) -> dict[str, float]:
    """Return the positions of a verdict's number, interval and baseline on a bar, in percent of its width."""
    value = verdict.value
    if value is None:
        return {}
    low, high = (value if end is None else end for end in (verdict.low, verdict.high))
    values = {"point": value, "baseline": verdict.baseline, "low": low, "high": high}
    smallest = min(values.values())
    scale = (100 - 2 * _BAR_MARGIN) / (max(values.values()) - smallest or 1.0)
    return {name: round(_BAR_MARGIN + scale * (each - smallest), 1) for name, each in values.items()}


def _make_parts(evaluation: Evaluation, rows: Sequence[Row]) -> list[PagePart]:
    rows_by_part: dict[str, list[Row]] = {name: [] for name in _PARTS}
    for row in rows:
        rows_by_part[next(name for name, (_, keys) in _PARTS.items() if re.match(keys, row.key))].append(row)
    images: dict[str, list[PageImage]] = {name: [] for name in _PARTS} | _draw_clips(evaluation)
    for part, alt, (width, height), draw in evaluation_plots(evaluation):
        images[part].append(PageImage(figure_to_svg(draw, width, height, evaluation), alt))
    notes = {"decoded": () if evaluation.decoded is None else evaluation.decoded.notes}
    return [
        PagePart(name, title, arrange_tables(rows_by_part[name]), images[name], notes.get(name, ()))
        for name, (title, _) in _PARTS.items()
    ]


def _select_tiles(evaluation: Evaluation, rows: Sequence[Row], summary: Summary) -> list[tuple[str, Row, Row | None]]:
    """Return the most important rows that the summary does not show.

    Each tuple has a label, the row of the evaluated model, and the row of the base model (None: not measured).
    """
    last, ahead = evaluation.horizon, f"{evaluation.seconds_ahead:.1f} s ahead"
    labels = {
        f"rollout.{L1.name}.over_persistence.{last}": f"L1 error relative to persistence, {ahead}",
        "ranking.rank": "action-ranking error",
        "one_step.moving": "one-step L1 error relative to persistence, moving steps",
        f"spread.{last}": f"spread of the predictions, {ahead}",
    }
    if evaluation.base is None:  # the first verdict already shows this error
        del labels[f"rollout.{L1.name}.over_persistence.{last}"]
    if summary.planning is None:
        del labels["ranking.rank"]
    measured = {(row.key, row.model): row for row in rows if not math.isnan(row.value)}
    return [
        (label, measured[key, evaluation.trained], measured.get((key, evaluation.base or "")))
        for key, label in labels.items()
        if (key, evaluation.trained) in measured
    ]


def _draw_clips(evaluation: Evaluation) -> dict[str, list[PageImage]]:
    """Return the image strips of example clips by part, in the best quality within the size limit.

    The strips show decoded frames if there are any, otherwise the errors of each patch over the true frames.
    """
    decoded = () if evaluation.decoded is None else evaluation.decoded.strips[:MAX_CLIPS]
    examples = () if decoded else evaluation.examples[:MAX_CLIPS]
    strips = [example_strip(evaluation, clip) for clip in examples] + [
        decoded_strip(evaluation, clip) for clip in decoded
    ]
    urls = encode_webp_urls([[draw_strip(strip)] for strip in strips], max_bytes=_MAX_CLIP_BYTES)
    images: dict[str, list[PageImage]] = {"examples": [], "decoded": []}
    shown: list[Example | DecodedStrip] = [*examples, *decoded]
    for url, clip, strip in zip(urls, shown, strips, strict=True):
        alt = "; ".join(row.label.replace("\n", " ") for row in strip.rows)
        part = "examples" if isinstance(clip, Example) else "decoded"
        images[part].append(PageImage(url, f"Rows of images: {alt}", clip))
    return images


class PageVideo(NamedTuple):
    """A video of one clip, with data: URLs."""

    url: str  # the animated image
    still: str  # the last frame
    captions: tuple[str, ...]  # captions of the columns
    clip: DecodedStrip


def make_video(evaluation: Evaluation) -> PageVideo | None:
    """Return a video of the decoded clip with the median error, or else of the first decoded clip; None: without clips.

    The first frame is the true frame in all columns, since all models receive it.
    """
    strips = () if evaluation.decoded is None else evaluation.decoded.strips
    if not strips:
        return None
    models = [name for name in (evaluation.base, evaluation.trained) if name is not None]
    strip = next((clip for clip in strips if "median" in clip.why), strips[0])
    true = "truth" if "truth" in strip.rows else "decoded_truth"
    columns = [strip.rows[name] for name in (true, *models)]
    times = range(len(columns[0]))
    frames = [_make_frame([column[time] for column in columns], time / times[-1]) for time in times]
    step = min(_STEP_S, (MAX_VIDEO_S - _FIRST_S - _LAST_S) / max(len(times) - 2, 1))
    seconds = [_FIRST_S, *[step] * (len(times) - 2), _LAST_S]
    (url,) = encode_webp_urls([frames], seconds, max_bytes=MAX_VIDEO_BYTES)
    (still,) = encode_webp_urls([frames[-1:]], max_bytes=MAX_VIDEO_BYTES)
    return PageVideo(url, still, ("true frames", *(f"predicted by {name}" for name in models)), strip)


def _make_frame(images: Sequence[Frame], progress: float) -> Frame:
    """Return images side by side, with a progress bar below that is filled by the fraction `progress`."""
    thickness = max(1, images[0].shape[1] // _GAP_RATIO)
    with_gaps = [np.pad(image, ((0, thickness), (0, thickness), (0, 0)), constant_values=_GREY) for image in images]
    frame = np.concatenate(with_gaps, axis=1)[:, :-thickness]
    frame[-thickness:, : round(progress * frame.shape[1])] = _PROGRESS
    return frame


def encode_webp_urls(
    videos: Sequence[Sequence[Frame]], seconds: Sequence[float] = (1.0,), *, max_bytes: int
) -> list[str]:
    """Encode videos (or images, as single frames) as WebP data: URLs, in the best quality within a size limit.

    Args:
        videos: The frames of each video.
        seconds: Display time of each frame.
        max_bytes: Maximum total size. If the lowest quality exceeds it, the lowest quality is used.
    """
    encoded: list[bytes] = []
    for quality in _QUALITIES:
        encoded = [base64.b64encode(encode_webp(frames, seconds, quality=quality)) for frames in videos]
        if sum(map(len, encoded)) <= max_bytes:
            break
    return [f"data:image/webp;base64,{data.decode()}" for data in encoded]


@dataclass(frozen=True)
class WrittenEvaluation:
    """The result of an evaluation, and the files that were written."""

    evaluation: Evaluation
    summary: Summary  # `str(summary)` is the printed text
    files: tuple[Path, ...]

    @property
    def report(self) -> Path:
        """Path of the HTML page."""
        return self.files[-1]

    @property
    def error_over_persistence(self) -> dict[str, Curve]:
        """L1 rollout error of each model relative to persistence, by horizon (index h - 1)."""
        return {name: over_persistence(model.errors, "rollout") for name, model in self.evaluation.models.items()}


def write_evaluation(evaluation: Evaluation, folder: Path) -> WrittenEvaluation:
    """Write metrics.json, metrics.csv, the plot and the page of an evaluation, each file atomically.

    The summary includes the planning verdict of a closed-loop benchmark of the same checkpoint, if the run has one.
    """
    rows, about = make_rows(evaluation), evaluation.about
    summary = summarize(evaluation, rows)
    if about.checkpoint:
        summary = with_closed_loop(summary, Path(about.subject), about.checkpoint)
    write_atomically(folder / REPORT, render_page(evaluation, summary))
    files = (
        plot_evaluation(evaluation, folder / PLOT),
        write_metrics(evaluation, folder / METRICS_FILE, summary),
        write_csv(rows, (folder / METRICS_FILE).with_suffix(".csv")),
        folder / REPORT,
    )
    return WrittenEvaluation(evaluation, summary, files)
