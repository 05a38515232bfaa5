"""Report section on decoded rollouts: similarity by horizon beside the neighbours, the numbers, and the images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import UInt8
from markupsafe import Markup

from vjepa2_ac.evaluation.decoded.estimates import (
    Curve,
    cycle_of,
    fvd_of,
    hand_of,
    lpips_of,
    moving_share_of,
    similarity_of,
    skill_of,
)
from vjepa2_ac.evaluation.decoded.record import (
    ABSENT,
    DECODED_PERSISTENCE,
    DECODED_TRUTH,
    MEANING,
    RAW_PERSISTENCE,
    TRUE_FRAMES,
    DecodedRollouts,
    DecodedStrip,
    Found,
    Reference,
    Region,
    Similarity,
)
from vjepa2_ac.evaluation.result import Evaluation
from vjepa2_ac.evaluation.video.record import FVD_LABEL, FVD_MEANING, LPIPS_MEANING, FrechetVideoDistance
from vjepa2_ac.reports.figures.film import FilmStrip, Kind, Row, draw_strip
from vjepa2_ac.reports.html.charts import Line, axis_at, line_chart, nice_axis
from vjepa2_ac.reports.html.formatting import NOT_MEASURED, decimal, percent, seconds, value
from vjepa2_ac.reports.html.images import jpeg_urls
from vjepa2_ac.reports.html.series import models_of
from vjepa2_ac.reports.html.templates import render

MOST_STRIPS = 4
_BYTES = 1_000_000  # of all strips together
_MOST_PIXELS = 1600  # of a strip along a side
_NAMES = {
    DECODED_TRUTH: ("decoded truth", "s-decoded-truth"),
    DECODED_PERSISTENCE: ("decoded persistence", "s-persistence"),
    RAW_PERSISTENCE: ("raw persistence", "s-raw-persistence"),
}


def decoded_section(evaluation: Evaluation) -> Markup:
    """Return the section on the images of the rollouts; without a decoder a sentence that says how to get it."""
    found = evaluation.decoded
    if found is None:
        return render("decoded", found=None)
    reference, region, metric = _charted(found)
    lines = _lines(evaluation, found, reference, region, metric)
    reached = [each for line in lines for side in (line.y, line.low, line.high) if side is not None for each in side]
    times = [(h + 1) * evaluation.about.seconds_per_step for h in range(found.horizon)]
    words = "; ".join(f"{line.name} from {line.y[0]:.2f} to {line.y[-1]:.2f}" for line in reversed(lines))
    chart = line_chart(
        f"{_TITLES[metric]} by horizon: {words}.",
        lines,
        axis_at("seconds ahead", times, [f"{time:.2f}" for time in times]),
        nice_axis(_TITLES[metric], reached),
        key=list(reversed(lines)),
    )
    head, rows = _table(found)
    strips = [(strip, draw_strip(_film(evaluation, found, strip))) for strip in found.strips[:MOST_STRIPS]]
    urls = jpeg_urls([[image] for _, image in strips], at_most=_BYTES, most_pixels=_MOST_PIXELS)
    shown = [(strip, url[0], _described(strip)) for (strip, _), url in zip(strips, urls, strict=True) if url]
    share = moving_share_of(found)[-1]
    return render(
        "decoded",
        found=found,
        title=_TITLES[metric],
        where="where something moves" if region == "moving" else "of the whole image",
        against="the truth" if reference == "truth" else "the decoded truth",
        share="" if share.estimate is None else percent(share.value),
        chart=chart,
        head=head,
        rows=rows,
        ahead=seconds(evaluation.seconds_ahead),
        notes=_notes(found),
        meanings=_meanings(found),
        strips=shown,
    )


_TITLES: dict[Similarity, str] = {"psnr_db": "PSNR (dB)", "ssim": "SSIM", "ms_ssim": "MS-SSIM"}


def _charted(found: DecodedRollouts) -> tuple[Reference, Region, Similarity]:
    """Return what the chart shows: where something moves, against the truth, if there are true frames and motion."""
    if "truth" in found.absent:
        return "decoded_truth", "whole", "ssim"
    moving = similarity_of(found, DECODED_PERSISTENCE, "truth", "moving", "psnr_db")
    return "truth", "moving" if any(one.estimate is not None for one in moving) else "whole", "psnr_db"


def _lines(
    evaluation: Evaluation, found: DecodedRollouts, reference: Reference, region: Region, metric: Similarity
) -> list[Line]:
    shown = [(source, *named) for source, named in _NAMES.items()]
    shown += [(one.model.name, one.label, one.style) for one in models_of(evaluation)]
    lines = []
    for source, label, style in shown:
        curve = similarity_of(found, source, reference, region, metric)
        if any(one.estimate is not None for one in curve):
            lines.append(_line(evaluation, curve, label, style))
    return lines


def _line(evaluation: Evaluation, curve: Curve, label: str, style: str) -> Line:
    x = [(h + 1) * evaluation.about.seconds_per_step for h in range(len(curve))]
    low, high = (
        [math.nan if one.estimate is None else getattr(one.estimate, side) for one in curve] for side in ("low", "high")
    )
    has_band = any(map(math.isfinite, low)) and style not in {named[1] for named in _NAMES.values()}
    return Line(label, x, [one.value for one in curve], style, low if has_band else None, high if has_band else None)


def _table(found: DecodedRollouts) -> tuple[list[str], list[list[Any]]]:
    """Return the numbers at the last horizon, a row for each source."""
    names = {**{name: label for name, (label, _) in _NAMES.items()}, **{name: name for name in found.models}}
    against: Reference = "decoded_truth" if "truth" in found.absent else "truth"
    rows = []
    for source, label in names.items():
        cells = [
            _cell(similarity_of(found, source, against, "whole", "psnr_db"), 1),
            _cell(similarity_of(found, source, against, "moving", "psnr_db"), 1),
            _cell(similarity_of(found, source, against, "whole", "ssim")),
            _cell(similarity_of(found, source, against, "whole", "ms_ssim")),
            _cell(skill_of(found, source, against, "moving", "psnr_db"), 2),
            _cell(skill_of(found, source, against, "whole", "ssim"), 2),
            _cell(cycle_of(found, source)),
            _cell(hand_of(found, source), 1),
            _video_cell(found, source),
            *([] if found.lpips is None else [_cell(lpips_of(found, source, against))]),
            *([] if found.fvd is None else [_fvd_cell(fvd_of(found, source, against))]),
        ]
        rows.append([label, *cells])
    head = ["PSNR (dB)", "PSNR where something moves", "SSIM", "MS-SSIM", "skill by PSNR where something moves"]
    head += ["skill by SSIM", "cycle error", "hand off by (px)", "V-JEPA 2 MMD to the truth"]
    head += [] if found.lpips is None else [f"LPIPS ({found.lpips.backbone})"]
    head += [] if found.fvd is None else [FVD_LABEL]
    return ["", *head], rows


def _cell(curve: Curve, digits: int = 3) -> Markup | str:
    return _shown(curve[-1], digits)


def _shown(found: Found, digits: int) -> Markup | str:
    return NOT_MEASURED if found.estimate is None else value(found.estimate, digits)


def _video_cell(found: DecodedRollouts, source: str) -> Markup | str:
    one = None if found.video is None else found.video.against_truth.get(source)
    return NOT_MEASURED if one is None else value(one.squared, 4) + f"; p {decimal(one.p_value)}"


def _fvd_cell(found: FrechetVideoDistance) -> str:
    return NOT_MEASURED if found.value is None else decimal(found.value, 1)


def _meanings(found: DecodedRollouts) -> dict[str, str]:
    """Return the words that stand beside metrics, by their names."""
    return {
        **({} if found.video is None else {"V-JEPA 2 MMD": MEANING}),
        **({} if found.lpips is None else {f"LPIPS ({found.lpips.backbone})": LPIPS_MEANING}),
        **({} if found.fvd is None else {FVD_LABEL: f"of {found.fvd.clips} clips. {FVD_MEANING}"}),
    }


def _notes(found: DecodedRollouts) -> list[str]:
    """Return why something is absent, and how good the probe is."""
    notes = [f"{ABSENT.get(what, what)}: not measured, {reason}." for what, reason in found.absent.items()]
    skill = skill_of(found, found.models[-1], "truth", "moving", "psnr_db")[-1]
    if skill.estimate is None and "truth" not in found.absent:
        notes.append(f"Skill by PSNR where something moves: {skill.reason}.")
    if found.video is not None:
        floor = found.video.noise_floor.get(TRUE_FRAMES)
        notes += (
            []
            if floor is None
            else [f"Two halves of the true episodes stay below a V-JEPA 2 MMD of {decimal(floor, 4)}."]
        )
        notes += found.video.notes
    if found.fvd is not None:
        notes += [f"{FVD_LABEL}: {note}." for note in found.fvd.notes]
    if found.hand is not None:
        frames, episodes = found.hand.fitted_on
        notes.append(
            f"The hand is read by a ridge regression from pixels, fitted on {frames} true frames of {episodes} training"
            f" episodes. On held-out true frames it is off by {decimal(found.hand.held_out.value, 2)} of"
            f" {found.hand.size} px; the mean position by {decimal(found.hand.mean_position, 1)}."
        )
    return notes


def _film(evaluation: Evaluation, found: DecodedRollouts, strip: DecodedStrip) -> FilmStrip:
    labels: dict[str, tuple[str, Kind]] = {
        TRUE_FRAMES: ("what happened", "recorded"),
        DECODED_TRUTH: ("what happened,\nencoded and decoded", "decoded"),
        **{name: (f"{name} imagines,\nsame actions", "imagined") for name in found.models},
    }
    rows = tuple(Row(*labels[name], _frames(frames)) for name, frames in strip.rows.items())
    times = range(len(rows[0].frames))
    title = f"{strip.why}: control step {strip.start}"
    return FilmStrip(title, rows, tuple(time * evaluation.about.seconds_per_step for time in times))


def _frames(frames: UInt8[np.ndarray, "time size size 3"]) -> UInt8[np.ndarray, "time size size 3"]:
    return np.ascontiguousarray(frames)


def _described(strip: DecodedStrip) -> str:
    rows: Sequence[str] = [name.replace("_", " ") for name in strip.rows]
    return f"Frames of {strip.episode_id} from control step {strip.start}, row by row: {', '.join(rows)}."
