"""The report page contains all measurements, for any names, and needs no other file."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from importlib import resources
from itertools import pairwise
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from vjepa2_ac.evaluation.verdict import verdict

from evaluation_results import evaluation
from planned import with_plans
from vjepa2_ac.evaluation.result import Evaluation, TrainingCurve
from vjepa2_ac.reports.write import MOST_CLIPS, report_page, write_report

VOID = {"br", "hr", "img", "input", "meta", "wbr"}
HOSTILE = "\"'><script>alert(1)</script><img src=x onerror=alert(2)>&amp;]]>{}\u202e\x00\ud800é"


class Page(HTMLParser):
    """A page taken to pieces: its elements in order, its text, its tables by caption."""

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.tables: dict[str, list[list[str]]] = {}
        self._open: list[str] = []
        self._rows: list[list[str]] = []
        self._caption = ""
        self.feed(html)
        self.close()
        assert self._open == []

    @property
    def shown(self) -> str:
        return "".join(self.words)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)
        if tag == "table":
            self._rows, self._caption = [], ""
        elif tag == "tr":
            self._rows.append([])
        elif tag in {"th", "td"}:
            self._rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag
        if tag == "table":
            self.tables[self._caption] = self._rows

    def handle_data(self, data: str) -> None:
        if "style" in self._open:
            return
        self.words.append(data)
        if "caption" in self._open:
            self._caption += data
        elif self._open and {"th", "td"} & set(self._open):
            self._rows[-1][-1] += data

    def images(self) -> list[bytes]:
        """Return the content of every image."""
        links = [attributes["src"] or "" for tag, attributes in self.elements if tag == "img"]
        return [base64.b64decode(link.partition("base64,")[2]) for link in links]


@cache
def usual() -> tuple[Evaluation, str, Page]:
    """Return an evaluation of which everything was measured, its page, and that in pieces."""
    one = with_plans(evaluation(others=("runs/other",)))
    html = report_page(one)
    return one, html, Page(html)


def test_the_verdict_is_on_top() -> None:
    one, _, page = usual()
    before, _, after = page.shown.partition(verdict(one))
    assert before.strip().endswith("Better than the base.")
    assert "Error by horizon" in after


def test_of_many_episodes_the_best_and_the_worst_are_shown() -> None:
    one = evaluation(episodes=40, clips=80)
    page = Page(report_page(one))
    for place, scores in (("best", one.episodes[:8]), ("worst", one.episodes[-8:])):
        (rows,) = (rows for caption, rows in page.tables.items() if caption.startswith(f"The 8 {place} of 40"))
        assert [row[0] for row in rows[1:]] == [score.episode_id for score in scores]
        assert [row[2] for row in rows[1:]] == [f"{score.over_persistence:.3f}" for score in scores]


def named(name: str) -> Evaluation:
    """Return an evaluation in which everything that has a name of somebody's choice has this one."""
    one = with_plans(evaluation(id_form=name.replace("{", "{{").replace("}", "}}") + "{0}", others=(name,)))
    return replace(
        one,
        about=replace(one.about, subject=name, data=name, checkpoint_path=name, cameras=(name,)),
        examples=tuple(replace(example, why=name) for example in one.examples),
        training=(TrainingCurve(name, (1, 2), (0.5, 0.4)),),
        notes=(name,),
    )


def test_no_name_can_change_the_page_but_for_its_text(request: pytest.FixtureRequest) -> None:
    harmless = Page(report_page(named("a/b")))
    request.getfixturevalue("drawn")
    hostile = Page(report_page(named(HOSTILE)))
    without_breaks = [[one for one in page.elements if one[0] != "wbr"] for page in (harmless, hostile)]
    assert [tag for tag, _ in without_breaks[0]] == [tag for tag, _ in without_breaks[1]]
    assert [set(attributes) for _, attributes in without_breaks[0]] == [set(a) for _, a in without_breaks[1]]
    assert "script" not in {tag for tag, _ in hostile.elements}
    assert "\"'><script>alert(1)</script><img src=x onerror=alert(2)>&amp;]]>{}" in hostile.shown
    assert not {"\u202e", "\x00", "\ud800"} & set(hostile.shown)
    for image in hostile.images():
        if b"<svg" in image:
            tags = {element.tag.rpartition("}")[2] for element in ET.fromstring(image).iter()}  # noqa: S314
            assert not tags & {"script", "foreignObject", "a"}


def test_the_page_refers_to_nothing_but_itself() -> None:
    _, html, page = usual()
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    links = [value for _, attributes in page.elements for key, value in attributes.items() if key in {"href", "src"}]
    for link in links:
        assert link.startswith("data:image/") or link.removeprefix("#") in ids, link[:80]
    assert not re.search(r"https?:|//\w|@import|url\(|\bon\w+=|javascript:", re.sub(r"base64,[^\"]*", "", html))


@pytest.mark.usefixtures("drawn")
def test_the_same_evaluation_gives_the_same_bytes(tmp_path) -> None:
    one, other = (write_report(evaluation(), tmp_path / name) for name in ("one.html", "other.html"))
    assert one.read_bytes() == other.read_bytes()


@pytest.mark.usefixtures("drawn")
def test_the_page_stays_small_whatever_was_measured() -> None:
    rng = np.random.default_rng(0)
    one = evaluation(frames=16, size=512)
    noise = rng.integers(0, 256, size=one.examples[0].frames.shape, dtype=np.uint8)
    long = tuple(range(5_000))
    one = replace(
        one,
        examples=tuple(replace(one.examples[0], frames=noise) for _ in range(6)),
        training=tuple(TrainingCurve(f"loss {n}", long, tuple(map(float, long))) for n in range(4)),
    )
    html = report_page(one)
    assert len(html.encode()) < 5_000_000
    assert html.count("data:image/jpeg") == MOST_CLIPS


def test_what_was_not_measured_is_named_with_the_reason() -> None:
    one = evaluation(with_base=False)
    adapter = replace(one.models["adapter"], sensitivity=None, landscapes=None, distribution=None)
    bare = replace(one, models={"adapter": adapter}, examples=(), training=(), strata=(), episodes=())
    bare = replace(bare, copies=None)
    page = Page(report_page(bare))
    for what in (
        "Differences to the base", "Energy landscapes", "Example clips", "Training curves", "Other strides",
        "Spread of the predictions", "Decoded images", "Plans",
    ):  # fmt: skip
        assert f"{what}: not measured." in page.shown
    asked = replace(bare, notes=("--sensitivity-clips is 0: no other actions and no energy landscapes.",))
    assert "not measured. --sensitivity-clips is 0: no" in Page(report_page(asked)).shown


def test_examples_are_images_with_or_without_photographs() -> None:
    one, _, page = usual()
    for each in (page, Page(report_page(replace(one, examples=tuple(replace(x, frames=None) for x in one.examples))))):
        photographs = [image for image in each.images() if image.startswith(b"\xff\xd8")]
        assert len(photographs) == len(one.examples)
    described = [attributes["alt"] or "" for tag, attributes in page.elements if tag == "img"]
    assert any("true frames; error of persistence; error of base" in words for words in described)


def test_one_episode_has_no_intervals_and_nothing_is_written_as_nan() -> None:
    html = report_page(evaluation(episodes=1))
    assert not re.search(r"\bnan\b|\binf\b", re.sub(r"base64,[^\"]*", "", html))
    assert "Not clearly different from the base" in html


def test_better_than_the_base_but_not_than_doing_nothing_is_no_success() -> None:
    one, _, _ = usual()
    kind, models = ("persistence", "rollout", "l1"), {}
    for name, model in one.models.items():
        arrays = {**model.errors.arrays, kind: model.errors.arrays[kind] / 3}
        models[name] = replace(model, errors=replace(model.errors, arrays=arrays))
    html = report_page(replace(one, models=models))
    assert "Better than the base, and worse than doing nothing." in html
    assert 'class="verdict unclear"' in html


def test_images_are_described_tables_have_captions_and_headings_do_not_jump() -> None:
    _, _, page = usual()
    levels = [int(tag[1]) for tag, _ in page.elements if re.fullmatch("h[1-6]", tag)]
    assert levels.count(1) == 1
    assert levels[0] == 1
    assert all(below <= above + 1 for above, below in pairwise(levels))
    assert all(attributes.get("alt") for tag, attributes in page.elements if tag == "img")
    assert "" not in page.tables


def contrast(one: str, other: str) -> float:
    """Source: WCAG 2.2, contrast ratio and relative luminance."""

    def luminance(colour: str) -> float:
        channels = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
        return float(np.dot([0.2126, 0.7152, 0.0722], linear))

    high, low = sorted((luminance(one), luminance(other)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def test_every_colour_can_be_read_on_the_paper_in_light_dark_and_print() -> None:
    style = resources.files("vjepa2_ac").joinpath("assets/report.css").read_text(encoding="utf-8")
    palettes = [dict(re.findall(r"--(\w+): (#\w{6});", part)) for part in style.split(":root {")[1:]]
    assert len(palettes) == 3
    for palette in palettes:
        for name in set(palette) - {"paper", "raised", "rule"}:
            assert contrast(palette[name], palette["paper"]) >= 4.5, name
        for name in ("ink", "soft", "better", "unclear", "worse"):
            assert contrast(palette[name], palette["raised"]) >= 4.5, name
