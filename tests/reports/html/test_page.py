"""The report page contains all measurements, for any names, and needs no other file."""

from __future__ import annotations

import base64
import io
import re
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from importlib import resources
from itertools import pairwise

import numpy as np
import pytest
from PIL import Image

from evaluation_results import evaluation
from vjepa2_ac.evaluation.estimates import difference_to, gain_over, mean_error, over_persistence, stratum_gain
from vjepa2_ac.evaluation.metrics import L1, L2
from vjepa2_ac.evaluation.result import Evaluation, TrainingCurve
from vjepa2_ac.intervals import Estimate
from vjepa2_ac.reports.html.charts import Line, line_chart, nice_axis
from vjepa2_ac.reports.html.examples import MOST_EXAMPLES
from vjepa2_ac.reports.html.formatting import decimal, percent, signed
from vjepa2_ac.reports.html.heatmaps import MapAxis, heat_map
from vjepa2_ac.reports.html.images import jpeg_urls, png_url
from vjepa2_ac.reports.html.page import report_page, write_report
from vjepa2_ac.reports.html.templates import render

VOID = {"br", "hr", "img", "input", "meta", "wbr"}
VERDICT = "The adapter predicts 0.8 s ahead 18 % better than the base."
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

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

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


def page_of(one: Evaluation) -> str:
    return report_page(one, VERDICT)


@cache
def usual() -> tuple[Evaluation, str, Page]:
    """Return an evaluation of which everything was measured, its page, and that in pieces."""
    one = evaluation(others=("runs/other",))
    html = page_of(one)
    return one, html, Page(html)


def plain(estimate: Estimate, digits: int = 3) -> str:
    value, low, high = (decimal(x, digits) for x in (estimate.value, estimate.low, estimate.high))
    return f"{value} [{low}, {high}]"


def table_of(page: Page, caption: str) -> list[list[str]]:
    found = [rows for name, rows in page.tables.items() if name.startswith(caption)]
    assert len(found) == 1, list(page.tables)
    return found[0]


def test_the_verdict_is_on_top() -> None:
    _, _, page = usual()
    assert VERDICT in page.shown
    before, _, after = page.shown.partition(VERDICT)
    assert before.strip().endswith("Better than the base.")
    assert "Error by horizon" in after
    assert "Error by horizon" not in before.partition("Skip")[2]


@pytest.mark.parametrize("mode", ["rollout", "teacher_forced"])
def test_each_cell_of_the_tables_by_horizon_is_the_estimate_of_its_row_and_column(mode) -> None:
    one, _, page = usual()
    words = {"rollout": "open-loop rollout", "teacher_forced": "teacher-forced"}[mode]
    trained = one.models["adapter"].errors
    for metric, name in ((L1, "L1"), (L2, "L2")):
        head, *rows = table_of(page, f"{name} error over persistence by horizon, {words}")
        assert head[1:] == ["base", "runs/other", "adapter", "adapter, zero actions", "adapter, shuffled actions"]
        columns = [over_persistence(each.errors, mode, metric) for each in one.models.values()]
        columns += [over_persistence(trained, mode, metric, actions) for actions in ("zero", "shuffled")]
        assert [row[1:] for row in rows] == [[plain(column[h]) for column in columns] for h in range(one.horizon)]
        head, *rows = table_of(page, f"{name} error by horizon, {words}")
        means = [mean_error(trained, mode, metric, "persistence")]
        means += [mean_error(each.errors, mode, metric) for each in one.models.values()]
        assert head[1:5] == ["persistence", "base", "runs/other", "adapter"]
        assert [row[1:5] for row in rows] == [[plain(column[h], 4) for column in means] for h in range(one.horizon)]
        assert [row[0] for row in rows] == ["1 (0.27\xa0s)", "2 (0.53\xa0s)", "3 (0.80\xa0s)"]


def test_differences_to_the_base_are_those_of_the_pairs() -> None:
    one, _, page = usual()
    _, *rows = table_of(page, "adapter against base")
    pair = one.models["adapter"].errors, one.models["base"].errors
    gain, difference = gain_over(*pair)[-1], difference_to(*pair)[-1]
    assert rows[-1][1] == f"+{percent(gain.value, 1)} [+{percent(gain.low, 1)}, +{percent(gain.high, 1)}]"
    assert rows[-1][2] == f"{signed(difference.value, 4)} [{signed(difference.low, 4)}, {signed(difference.high, 4)}]"
    assert difference.value < 0


def test_spread_and_discrepancy_stand_beside_those_of_persistence() -> None:
    one, _, page = usual()
    head, *rows = table_of(page, "Spread over that of the truth")
    kinds = [one.persistence_distribution.copies, *(model.distribution for model in one.models.values())]
    assert head[1:] == ["persistence", "base", "runs/other", "adapter"]
    assert [row[1:] for row in rows] == [[plain(kind.spread[h]) for kind in kinds] for h in range(one.horizon)]
    head, *rows = table_of(page, "Squared MMD of predicted and true latents")
    assert rows[1][1:5] == [f"{plain(kind.mmd[1].squared)}; p 0.040" for kind in kinds]
    assert rows[1][5] == "0.031"


def test_strata_ranks_landscapes_and_episodes_are_those_of_the_result() -> None:
    one, _, page = usual()
    _, moving, _idle = table_of(page, "One-step L1 error over persistence by motion")
    gain = stratum_gain(one.models["adapter"].errors, one.models["base"].errors, one.strata[0])
    assert moving[:2] == ["moving", str(one.strata[0].steps.sum())]
    assert moving[-1].startswith(f"+{percent(gain.value, 1)} ")
    ranks = table_of(page, "How much predictions change with the action")
    sensitivity = one.models["adapter"].sensitivity
    assert ranks[5][:2] == ["adapter", plain(sensitivity.change)]
    assert ranks[5][3] == plain(sensitivity.rankings[0].mean_rank)
    assert ranks[5][5].endswith(f"(chance {percent(5 / 65, 1)})")
    landscape = table_of(page, "Where the energy is lowest")[3]
    assert landscape[2] == plain(one.models["adapter"].landscapes.distance, 2) + " cm"
    assert landscape[3] == "8.10 cm"
    axes = table_of(page, "Calibrated axes")
    assert (axes[1][0], axes[-1][0]) == ("base", "adapter")
    assert axes[1][1] == plain(one.models["base"].axes.yaw_degrees, 0)
    assert axes[-1][5] == plain(one.models["adapter"].axes.condition, 1)
    assert landscape[6] == "\N{EN DASH}"  # no clip moves along that axis
    episodes = table_of(page, "All 12 episodes")[1:]
    assert [row[0] for row in episodes] == [score.episode_id for score in one.episodes]
    assert [row[2] for row in episodes] == [decimal(score.over_persistence) for score in one.episodes]


def test_strides_are_shown_with_their_errors_or_the_reason_why_not() -> None:
    error = {"value": 0.9, "low": 0.8, "high": 1.0}
    measured = {"stride": 4, "seconds_per_step": 0.25, "error_over_persistence": error, "clips": 7, "episodes": 3}
    found = {"verdict": "Best: stride 4.", "strides": [measured], "impossible": {"15": "episodes are too short"}}
    page = Page(page_of(replace(usual()[0], calibration=found)))
    assert table_of(page, "One-step, teacher-forced error at each stride")[1] == (
        ["4", "0.25", "0.900 [0.800, 1.000]", "7", "3"]
    )
    assert "Best: stride 4." in page.shown
    assert "Stride 15 could not be measured: episodes are too short." in page.shown


def test_curves_of_training_stand_in_charts_by_what_they_show_speed_folded_away() -> None:
    _, html, page = usual()
    assert "training loss over optimizer steps: train/loss from 0.7 to 0.4" in html
    main, _, folded = html.partition("Speed, memory and other metrics")
    assert "<h3>validation: error / persistence</h3>" in main
    assert "<h3>learning rate</h3>" in main
    assert "<h3>data wait share</h3>" in folded
    assert "rollout over persistence last" in page.shown


def test_of_many_episodes_the_best_and_the_worst_are_shown() -> None:
    one = evaluation(episodes=40, clips=80)
    page = Page(page_of(one))
    best = [row[0] for row in table_of(page, "The 8 best of 40")[1:]]
    worst = [row[0] for row in table_of(page, "The 8 worst of 40")[1:]]
    assert best == [score.episode_id for score in one.episodes[:8]]
    assert worst == [score.episode_id for score in one.episodes[-8:]]


def named(name: str) -> Evaluation:
    """Return an evaluation in which everything that has a name of somebody's choice has this one."""
    one = evaluation(id_form=name.replace("{", "{{").replace("}", "}}") + "{0}", others=(name,))
    return replace(
        one,
        about=replace(one.about, subject=name, data=name, checkpoint_path=name, cameras=(name,)),
        examples=tuple(replace(example, why=name) for example in one.examples),
        training=(TrainingCurve(name, (1, 2), (0.5, 0.4)),),
        calibration={"verdict": name, "strides": []},
        notes=(name,),
    )


def test_no_name_can_change_the_page_but_for_its_text() -> None:
    harmless = Page(page_of(named("a/b")))
    hostile = Page(page_of(named(HOSTILE)))
    assert [tag for tag, _ in hostile.elements] == [tag for tag, _ in harmless.elements]
    assert [set(attributes) for _, attributes in hostile.elements] == [set(a) for _, a in harmless.elements]
    assert "script" not in {tag for tag, _ in hostile.elements}
    assert "\"'><script>alert(1)</script><img src=x onerror=alert(2)>&amp;]]>{}" in hostile.shown
    assert not {"\u202e", "\x00", "\ud800"} & set(hostile.shown)


def test_the_page_refers_to_nothing_but_itself() -> None:
    _, html, page = usual()
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    links = [value for _, attributes in page.elements for key, value in attributes.items() if key in {"href", "src"}]
    assert links
    for link in links:
        assert link.startswith("data:image/") or link.removeprefix("#") in ids, link[:80]
    assert not re.search(r"https?:|//\w|@import|url\(|\bon\w+=|javascript:", re.sub(r"base64,[^\"]*", "", html))


def test_the_same_evaluation_gives_the_same_bytes(tmp_path) -> None:
    one, other = (write_report(evaluation(), VERDICT, tmp_path / name) for name in ("one.html", "other.html"))
    assert one.read_bytes() == other.read_bytes()


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
    html = page_of(one)
    assert len(html.encode()) < 5_000_000
    assert html.count('class="example"') == MOST_EXAMPLES


def test_what_was_not_measured_is_named_with_the_reason() -> None:
    one = evaluation(with_base=False)
    adapter = replace(one.models["adapter"], sensitivity=None, landscapes=None, distribution=None)
    bare = replace(one, models={"adapter": adapter}, examples=(), training=(), strata=(), episodes=())
    bare = replace(bare, persistence_distribution=None)
    page = Page(page_of(bare))
    for what in (
        "Differences to the base", "Strata", "Action sensitivity and ranks", "Energy landscapes", "Episodes",
        "Example clips", "Training curves", "Other strides", "Spread of the predictions",
    ):  # fmt: skip
        assert f"{what}: not measured." in page.shown
    assert "data calibrate" in page.shown
    assert "against" not in page.tables
    asked = replace(bare, notes=("--sensitivity-clips is 0: no other actions and no energy landscapes.",))
    assert page_of(asked).count("--sensitivity-clips is 0") == 2, "where ranks and landscapes would be"
    assert page_of(replace(bare, notes=("No example clips.",))).count("No example clips.") == 1


def test_of_a_long_clip_the_first_the_last_and_frames_between_are_shown() -> None:
    html = page_of(evaluation(frames=40, size=32))
    page = Page(html)
    shown = [int(name) for name in re.findall(r'<image id="e0f(\d+)"', html)]
    assert shown[0] == 0
    assert shown[-1] == 39
    assert 16 <= len(shown) < 40
    assert {int(name) for name in re.findall(r'href="#e0f(\d+)"', html)} == set(shown)
    assert html.count("animation:turn-16 ") == 16
    assert "+10.40\xa0s" in page.shown


def test_clips_without_photographs_show_their_latents_and_errors() -> None:
    one, _, _ = usual()
    html = page_of(replace(one, examples=tuple(replace(example, frames=None) for example in one.examples)))
    assert "a cache that holds no frames" in html
    assert "image/jpeg" not in html
    assert "True latents as colours, now" in html
    assert "<use" not in html


def test_one_episode_has_no_intervals_and_nothing_is_written_as_nan() -> None:
    html = page_of(evaluation(episodes=1))
    page = Page(html)
    assert table_of(page, "L1 error over persistence by horizon, open")[1][1].count("[") == 0
    assert not re.search(r"\bnan\b|\binf\b", re.sub(r"base64,[^\"]*", "", html))
    assert "Not clearly different from the base" in page.shown


def test_better_than_the_base_but_not_than_doing_nothing_is_no_success() -> None:
    one, _, _ = usual()
    kind, models = ("persistence", "rollout", "l1"), {}
    for name, model in one.models.items():
        arrays = {**model.errors.arrays, kind: model.errors.arrays[kind] / 3}
        models[name] = replace(model, errors=replace(model.errors, arrays=arrays))
    html = page_of(replace(one, models=models))
    assert "Better than the base, and worse than doing nothing." in html
    assert 'class="verdict unclear"' in html


def test_images_are_described_tables_have_captions_and_headings_do_not_jump() -> None:
    _, html, page = usual()
    levels = [int(tag[1]) for tag, _ in page.elements if re.fullmatch("h[1-6]", tag)]
    assert levels.count(1) == 1
    assert levels[0] == 1
    assert all(below <= above + 1 for above, below in pairwise(levels))
    for tag, attributes in page.elements:
        if tag == "svg":
            assert attributes.get("aria-label") or attributes.get("aria-hidden") == "true"
        if tag == "div" and attributes.get("class") == "scroll":
            assert attributes["tabindex"] == "0"
            assert attributes["aria-label"]
    tags = [tag for tag, _ in page.elements]
    assert tags.count("table") == tags.count("caption") == len(re.findall("<table[^>]*><caption>", html))
    assert 'lang="en"' in html


def test_every_moving_image_turns_through_its_frames_and_can_be_halted() -> None:
    one = evaluation(frames=6)
    html = page_of(one)
    assert html.count('class="halt"') == len(one.examples)
    assert ".film:has(.halt:checked) .frame" in html
    delays = [float(x) for x in re.findall(r"\.film-6 \.f\d\{animation:turn-6 3s step-end (-[\d.]+)s infinite\}", html)]
    assert delays == [-3.0, -2.5, -2.0, -1.5, -1.0, -0.5]


def test_words_are_escaped_once_and_markup_is_not_escaped_again() -> None:
    axis = nice_axis("", [0.0, 1.0])
    chart = line_chart('1 < "2" & 3 \x07\ud800', [], axis, axis)
    assert "<title>1 &lt; &#34;2&#34; &amp; 3 \N{REPLACEMENT CHARACTER}\N{REPLACEMENT CHARACTER}</title>" in chart
    assert 'aria-label="1 &lt; &#34;2&#34; &amp; 3 ' in chart
    assert chart in render("base", evaluation=evaluation(), chart=chart, tables=[])


def test_numbers_have_a_true_minus_and_no_negative_zero() -> None:
    assert decimal(-0.0004) == "0.000"
    assert decimal(-1.5, 1) == "\N{MINUS SIGN}1.5"
    assert signed(0.25, 2) == "+0.25"
    assert signed(0.0001, 2) == "0.00"
    assert percent(0.181) == "18\xa0%"
    assert decimal(float("nan")) == "\N{EN DASH}"


@pytest.mark.parametrize(
    "values", [[0.0, 1.0], [0.31, 0.32], [-5.0, 123.0], [7.0, 7.0], [0.0, 0.0], [1e-6, 3e-3], [0.0, 13.1]]
)
def test_an_axis_holds_its_values_between_round_ticks(values) -> None:
    axis = nice_axis("", values)
    assert axis.low <= min(values) <= max(values) <= axis.high
    assert 2 <= len(axis.ticks) <= 9
    assert [float(shown.replace("\N{MINUS SIGN}", "-")) for shown in axis.shown] == pytest.approx(axis.ticks)


@pytest.mark.parametrize(
    ("highest", "shown"),
    [
        (60_000.0, "40000"),
        (300_000.0, "150k"),
        (2_000_000.0, "1.5M"),
        (4.25e-5, "3e\N{MINUS SIGN}5"),
        (0.003, "0.0015"),
    ],
)
def test_large_and_tiny_ticks_are_written_short(highest, shown) -> None:
    assert shown in nice_axis("", [0.0, highest]).shown


def test_a_curve_has_a_gap_where_a_value_is_missing() -> None:
    line = Line("a", [0.0, 1.0, 2.0, 3.0, 4.0], [1.0, 2.0, float("nan"), 2.0, 1.0], "s-base")
    axis = nice_axis("", [0.0, 4.0])
    chart = line_chart("a chart", [line], axis, axis)
    assert chart.count("<polyline") == 2
    assert chart.count("<circle") == 4
    assert "nan" not in chart


def test_png_holds_the_pixels_it_was_given() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, size=(5, 7, 3), dtype=np.uint8)
    image = Image.open(io.BytesIO(base64.b64decode(png_url(pixels).partition("base64,")[2])))
    assert np.array_equal(np.asarray(image), pixels)


def test_photographs_take_the_best_quality_in_which_all_of_them_fit_or_are_left_out() -> None:
    rng = np.random.default_rng(0)
    clips = [[rng.integers(0, 256, size=(300, 600, 3), dtype=np.uint8) for _ in range(2)] for _ in range(2)]
    fine, coarse, none = ([len("".join(clip)) for clip in jpeg_urls(clips, at_most=n)] for n in (10**6, 30_000, 1000))
    assert 30_000 < sum(fine) <= 10**6
    assert 0 < sum(coarse) <= 30_000
    assert none == [0, 0]
    image = Image.open(io.BytesIO(base64.b64decode(jpeg_urls(clips, at_most=10**6)[0][0].partition("base64,")[2])))
    assert image.size == (200, 100)


def test_the_darkest_point_of_a_map_is_under_the_ring() -> None:
    across, up = np.array([-3.0, -1.0, 1.0, 4.0]), np.array([-2.0, 0.0, 2.0])
    energy = np.full((4, 3), 1.0)
    energy[3, 0] = 0.0  # at (4, -2): to the right, below
    axes = (MapAxis("dx (cm)", across, 1.0, 4.0), MapAxis("dy (cm)", up, 0.0, -2.0))
    drawn = heat_map("a map", energy, *axes, (0.0, 1.0))
    image = Image.open(io.BytesIO(base64.b64decode(re.search(r"base64,([^\"]*)", drawn)[1])))
    left, top, width, height = (float(re.search(rf'<image[^>]* {key}="([\d.]+)"', drawn)[1]) for key in
                                ("x", "y", "width", "height"))  # fmt: skip
    x, y = (float(re.search(rf'<circle[^>]* {key}="([\d.]+)"', drawn)[1]) for key in ("cx", "cy"))
    at_ring = image.getpixel((int((x - left) / width * image.width), int((y - top) / height * image.height)))
    assert at_ring == (0x44, 0x01, 0x54)
    cross = re.search(r'transform="translate\(([\d.]+) ([\d.]+)\)" class="cross', drawn)
    x, y = float(cross[1]), float(cross[2])
    at_cross = image.getpixel((int((x - left) / width * image.width), int((y - top) / height * image.height)))
    assert at_cross == (0xFD, 0xE7, 0x25)


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
