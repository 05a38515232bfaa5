"""The postcard is one file that plays without anybody: every future is in it, and nothing that could do harm."""

import base64
import io
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from browser import browser
from paths import ROOT
from vjepa2_ac.episode import no_progress
from vjepa2_ac.explore.explorer import Place
from vjepa2_ac.explore.postcard import MOVES, _fitting, write_postcard
from vjepa2_ac.explore.views import Views
from windows import chromium, watched

DEPTH = 2
HOSTILE = "</script><img src=x onerror=alert(1)>"


@pytest.fixture
def postcard(live: Views, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(type(live.explorer), "name", lambda *_: HOSTILE)
    return write_postcard(live, tmp_path / "postcard", no_progress, DEPTH)


def content_of(text: str) -> dict[str, Any]:
    found = re.findall(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    return dict(json.loads(found[0]))


def seen(image: str, first: str) -> np.ndarray:
    """Return an image as the page shows it: where it is transparent, that of the first place lies behind it."""
    above, below = (Image.open(io.BytesIO(base64.b64decode(one))).convert("RGBA") for one in (image, first))
    return np.asarray(Image.alpha_composite(below, above).convert("RGB")).astype(int)


def test_every_future_is_in_it_and_is_what_the_models_imagine(postcard: Path, live: Views) -> None:
    content = content_of(postcard.read_text())
    places, first = content["places"], live.middle()
    assert len(places) == 1 + MOVES + MOVES**2
    assert content["tellers"] == ["base", "adapter"]
    assert content["episode"] == HOSTILE
    actions = [live.action(move) for move in live.moves[:MOVES]]
    for number, path in ((0, ()), (3, (2,)), (1 + MOVES + 4 * MOVES + 1, (4, 1))):
        place = Place(first.episode, first.start, tuple(actions[move] for move in path))
        shown = [seen(*images) for images in zip(places[number]["images"], places[0]["images"], strict=True)]
        for teller in range(2):
            wanted = live.explorer.decoded(live.explorer.imagined(teller, place))
            assert np.abs(shown[teller] - wanted).mean() < 12  # of a random decoder's noise, much compressed
        true = live.truth.outcome(place)
        assert true is not None
        assert np.abs(shown[2] - true.pixels).mean() < 12
        assert {"errors", "copying", "at", "reached"} <= places[number].keys()


def test_of_data_that_were_only_recorded_the_first_frame_alone_is_true(recorded: Views, tmp_path: Path) -> None:
    text = write_postcard(recorded, tmp_path / "postcard", no_progress, 1).read_text()
    first, *others = content_of(text)["places"]
    assert len(first["images"]) == 3
    assert all(len(one["images"]) == 2 and "errors" not in one for one in others)


def test_images_that_take_too_much_become_smaller_until_they_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (4, 112, 112, 3), dtype=np.uint8)
    images = [[one] for one in noise]

    def size_and_side(most: int) -> tuple[int, int]:
        monkeypatch.setattr("vjepa2_ac.explore.postcard.MOST_BYTES", most)
        texts = [one for place in _fitting(images) for one in place]
        return sum(map(len, texts)), Image.open(io.BytesIO(base64.b64decode(texts[-1]))).width

    best, side = size_and_side(10**6)
    assert side == 112
    less, _ = size_and_side(best - 1)
    assert less < best
    assert size_and_side(1)[1] == 64


def test_the_one_on_the_site_is_small_and_whole() -> None:
    page = ROOT / "docs/site/static/postcard.html"
    assert page.stat().st_size < 4_500_000  # 6 MB are promised
    content = content_of(page.read_text())
    assert content["tellers"] == ["base", "adapter"]
    assert len(content["places"]) == 1555
    for place in content["places"]:
        shown = [seen(*images) for images in zip(place["images"], content["places"][0]["images"], strict=True)]
        assert {one.shape for one in shown} == {(96, 96, 3)}


def test_it_asks_nobody_and_a_name_ends_no_script(postcard: Path) -> None:
    text = postcard.read_text()
    assert not re.findall(r"(?:https?:)?//[\w.]+\.\w|src=[\"']|href=[\"']|@import|url\((?!\$\{first)", text)
    assert text.count("</script>") == 2
    assert "<img src=x" not in text


def test_keys_and_thumbs_walk_the_tree_and_come_back(postcard: Path) -> None:
    browser()
    with chromium() as started:
        page, wrong = watched(started.new_context(viewport={"width": 360, "height": 700}))
        page.goto(postcard.as_uri())
        image = "document.querySelector('figure:nth-of-type(3) img').src"
        said = "document.getElementById('said').textContent"
        page.wait_for_function(f"() => {image}.startsWith('data:')")
        first = page.evaluate(image)
        page.keyboard.press("a")
        page.wait_for_function(f"() => {said}.startsWith('left: ')")
        assert page.evaluate(image) != first
        page.get_by_role("button", name="up").click()
        page.wait_for_function(f"() => {said}.startsWith('left, up: ')")
        page.keyboard.press("s")  # deeper are none
        assert page.get_by_role("button", name="up").get_attribute("aria-disabled") == "true"
        told = page.locator("#said").inner_text()
        assert re.search(r"Errors: base [\d.]+, .*; adapter [\d.]+, .*; copying the first frame", told)
        assert page.get_by_role("img", name="the adapter imagines, after left, up").is_visible()
        assert page.locator(".verdict[data-is]:not([data-is=''])").count() == 2
        assert page.evaluate("document.documentElement.scrollWidth") <= 360
        page.keyboard.press("z")
        page.wait_for_function(f"() => {said}.startsWith('left: ')")
        page.keyboard.press("0")
        page.wait_for_function(f"first => {image} === first", arg=first)
        assert page.locator("#said").inner_text().startswith("The given frame")
        assert not wrong


def test_a_failure_is_shown_on_demand_on_the_site_page() -> None:
    browser()
    with chromium() as started:
        page, wrong = watched(started.new_context(color_scheme="dark"))
        page.goto((ROOT / "docs/site/static/postcard.html").as_uri())
        page.keyboard.press("x")
        page.wait_for_selector("figure:nth-of-type(3) [data-is='not understood']")
        assert not wrong
