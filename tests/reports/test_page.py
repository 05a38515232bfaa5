"""The page begins with the summary and a video, contains all measurements, and needs no other file."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from PIL import Image, ImageSequence

from browser import open_page
from evaluation_results import decoded_strips, evaluation, page_of
from vjepa2_ac.evaluation.result import Evaluation
from vjepa2_ac.evaluation.rows import make_rows
from vjepa2_ac.evaluation.summary import PLANNING, Verdict, summarize
from vjepa2_ac.reports import write
from vjepa2_ac.reports.metrics_json import metrics_as_dict
from vjepa2_ac.reports.write import (
    MAX_CLIPS,
    MAX_VIDEO_BYTES,
    MAX_VIDEO_S,
    compute_bar_positions,
    make_video,
    render_page,
)

HOSTILE = "\"'><script>alert(1)</script><img src=x onerror=alert(2)>&amp;]]>{}\u202e\x00\ud800é"
SOLVED = Verdict(
    PLANNING,
    "no",
    "success rate 4.0 % on 50 reach problems",
    0.04,
    0.01,
    0.1,
    reference="(random 6.0 %)",
    baseline=0.06,
)


class Page(HTMLParser):
    """The elements of a page in order, and the text of the page."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.shown = ""
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.shown += data


FullPage = tuple[Evaluation, str, Page]


@pytest.fixture(scope="module")
def full_page(_undrawn: Callable[[pytest.MonkeyPatch], None]) -> FullPage:
    """Return an evaluation with all measurements, its page with all figures, and the parsed page."""
    result = decoded_strips(evaluation(others=("runs/other",)))
    with pytest.MonkeyPatch.context() as patch:
        _undrawn(patch)
        html = page_of(result)
    return result, html, Page(html)


def leave_figures_empty(patch: pytest.MonkeyPatch) -> None:
    """Replace all images by empty images, which does not change text and tables."""
    patch.setattr(write, "figure_to_svg", lambda *_: "data:image/svg+xml;base64,")
    patch.setattr(write, "draw_strip", lambda _: np.zeros((8, 8, 3), np.uint8))


@pytest.fixture
def without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    leave_figures_empty(monkeypatch)


def images(html: str) -> list[bytes]:
    """Return the content of every image."""
    return [base64.b64decode(data) for data in re.findall('base64,([^"]*)"', html)]


@pytest.mark.usefixtures("without_figures")
def test_first_screen_shows_the_console_summary_and_further_numbers(full_page: FullPage) -> None:
    for result, changes in ((full_page[0], {}), (evaluation(episodes=2, clips=8), {"planning": SOLVED})):
        summary = replace(summarize(result, make_rows(result)), **changes)
        first = render_page(result, summary).partition("<details")[0]
        shown = " ".join(Page(re.sub("<[^>]*>", " ", first.partition("</style>")[2])).shown.split())
        printed = [line for line in str(summary).splitlines() if not line.startswith("  Brackets: ")]
        assert not [word for word in " ".join(printed).split() if word not in shown]
        assert summary.sentence in shown
        assert first.count("<li") == len(summary.verdicts) == 4
        assert ("<dt>action-ranking error" in first) == bool(changes), "a tile repeats a verdict"
        tiles = re.findall("<dt>(.*?)</dt>", first)
        assert len(set(tiles)) == len(tiles) == 3 + bool(changes)
        assert first.count("is better)") + first.count("1: as varied as the true frames; lower: smoother") == len(tiles)


def test_bar_positions_have_the_order_of_their_values() -> None:
    for value, baseline in ((0.3, 0.0), (-0.3, 0.0), (0.3, 0.5), (0.7, 0.5)):
        verdict = Verdict(PLANNING, "yes", "", value, value - 0.04, value + 0.05, baseline=baseline)
        bar = compute_bar_positions(verdict)
        assert 0 < min(bar.values()) < max(bar.values()) < 100
        assert bar["low"] < bar["point"] < bar["high"]
        assert (bar["baseline"] < bar["low"]) == (baseline < value)
        assert len(set(compute_bar_positions(replace(verdict, low=None, high=None)).values())) == 2
    assert not compute_bar_positions(replace(verdict, value=None))


def test_the_video_shows_the_clip_with_the_median_error_and_is_short_and_small() -> None:
    result = decoded_strips(evaluation(frames=16), size=256)
    best = replace(result.decoded.strips[0], why="best")
    result = replace(result, decoded=replace(result.decoded, strips=(best, result.decoded.strips[1])))
    video = make_video(result)
    assert video.clip.why == "median"
    assert video.clip is result.decoded.strips[1]
    frames, times = [], []
    for file in images(f'{video.url}"{video.still}"'):
        assert len(file) <= MAX_VIDEO_BYTES
        for frame in ImageSequence.Iterator(Image.open(io.BytesIO(file))):
            frames.append(np.asarray(frame.convert("RGB"), dtype=float))
            times.append(frame.info.get("duration", 0))
    assert sum(times) <= 1000 * MAX_VIDEO_S
    for column, name in enumerate(("truth", "base", "adapter")):
        for shown, true in zip(frames, [*video.clip.rows[name], video.clip.rows[name][-1]], strict=True):
            assert np.abs(shown[:256, column * 264 : column * 264 + 256] - true).mean() < 4


def evaluation_with_names(name: str) -> Evaluation:
    """Return an evaluation in which every user-defined name is this name."""
    form = name.replace("{", "{{").replace("}", "}}") + "{0}"
    result = decoded_strips(evaluation(id_form=form, others=(name,)))
    return replace(
        result,
        about=replace(result.about, subject=name, data=name, checkpoint_path=name, cameras=(name,)),
        examples=tuple(replace(example, why=name) for example in result.examples),
        notes=(name,),
    )


@pytest.mark.usefixtures("drawn")
def test_hostile_names_change_only_text_of_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    html = page_of(evaluation_with_names(HOSTILE))
    leave_figures_empty(monkeypatch)
    harmless, hostile = Page(page_of(evaluation_with_names("a/b"))), Page(html)
    without_breaks = [[element for element in page.elements if element[0] != "wbr"] for page in (harmless, hostile)]
    assert [tag for tag, _ in without_breaks[0]] == [tag for tag, _ in without_breaks[1]]
    assert [set(attributes) for _, attributes in without_breaks[0]] == [set(a) for _, a in without_breaks[1]]
    assert "script" not in {tag for tag, _ in hostile.elements}
    assert "\"'><script>alert(1)</script><img src=x onerror=alert(2)>&amp;]]>{}" in hostile.shown
    assert not {"\u202e", "\x00", "\ud800"} & set(hostile.shown)
    for image in images(html):
        if b"<svg" in image:
            tags = {element.tag.rpartition("}")[2] for element in ET.fromstring(image).iter()}  # noqa: S314
            assert not tags & {"script", "foreignObject", "a"}


@pytest.mark.usefixtures("drawn")
def test_page_is_self_contained_and_deterministic(full_page: FullPage) -> None:
    result, html, page = full_page
    links = [values[key] or "" for _, values in page.elements for key in ("href", "src", "srcset") if key in values]
    assert all(link.startswith("data:image/") for link in links)
    assert not re.search(r"https?:|//\w|@import|url\(|\bon\w+=|javascript:", re.sub(r"base64,[^\"]*", "", html))
    assert page_of(result) == html


@pytest.mark.usefixtures("drawn")
def test_page_stays_below_its_size_limit(full_page: FullPage, monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(full_page[1]) < 2_000_000, "with all figures"
    monkeypatch.setattr(write, "figure_to_svg", lambda *_: "")
    rng = np.random.default_rng(0)
    result = evaluation(frames=16, size=256)
    noise = rng.integers(0, 256, size=result.examples[0].frames.shape, dtype=np.uint8)
    html = page_of(replace(result, examples=(replace(result.examples[0], frames=noise),) * 6))
    assert len(html.encode()) < 3_000_000
    assert html.count("data:image/webp") == MAX_CLIPS


def test_unmeasured_parts_are_listed_with_the_reason() -> None:
    result = evaluation(with_base=False)
    adapter = replace(result.models["adapter"], ranking=None, landscapes=None, distribution=None)
    bare = replace(result, models={"adapter": adapter}, examples=(), copies=None)
    noted = replace(bare, notes=("--ranking-clips is 0: no energy landscapes.",))
    shown = Page(page_of(noted)).shown
    for part in (
        "Comparison with the base model", "Energy landscapes", "Example clips", "Distribution of the predictions",
        "Decoded images",
    ):  # fmt: skip
        assert f"{part}: not measured." in shown
    assert "Energy landscapes: not measured. --ranking-clips is 0: no" in shown
    assert "`" not in shown, "a command is shown as code"
    reasons = metrics_as_dict(noted)["not_measured"]
    assert len(reasons) == 5
    assert all(reason.replace("`", "") in shown for reason in reasons.values()), "page and metrics.json agree"
    assert "No video: vjepa2-ac evaluate runs/kitchen --decoder FOLDER" in shown


def test_single_episode_without_images_has_no_intervals_and_no_nan() -> None:
    result = evaluation(episodes=1)
    html = page_of(replace(result, examples=tuple(replace(example, frames=None) for example in result.examples)))
    assert not re.search(r"\bnan\b|\binf\b", re.sub(r"base64,[^\"]*", "", html))
    assert html.count("data:image/webp") == len(result.examples)


def test_images_are_described_tables_have_captions_and_headings_do_not_jump(full_page: FullPage) -> None:
    _, html, page = full_page
    levels = "".join(tag[1] for tag, _ in page.elements if re.fullmatch("h[1-6]", tag))
    assert re.fullmatch("1(2+3*)+", levels)
    assert all(attributes.get("alt") for tag, attributes in page.elements if tag == "img")
    assert html.count("<table>") == len(re.findall("<table><caption>[^<]", html))


# ---- in a real browser: no errors, no requests, no scripts ----


@cache
def page() -> str:
    """Return a page with all measurements."""
    return page_of(decoded_strips(evaluation(others=("a run with a rather long name/and/slashes",))))


@pytest.mark.slow
@pytest.mark.usefixtures("drawn")
def test_page_opens_in_a_browser_without_errors_or_requests(tmp_path) -> None:
    (tmp_path / "report.html").write_text(page(), encoding="utf-8")
    opened = open_page(tmp_path / "report.html", tmp_path)
    assert (opened.console, opened.requests) == ((), ())
    assert "Model and data" in opened.dom


@pytest.mark.slow
@pytest.mark.usefixtures("drawn")
def test_content_security_policy_blocks_injected_scripts(tmp_path) -> None:
    injected = tmp_path / "injected.html"
    injected.write_text(page().replace("<main>", '<main><script>document.title = "run"</script>'), encoding="utf-8")
    opened = open_page(injected, tmp_path)
    assert "<title>run</title>" not in opened.dom
    assert any("Content Security Policy" in line for line in opened.console)
