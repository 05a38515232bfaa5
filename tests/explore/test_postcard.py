"""The postcard is one file that plays without anybody: every future is in it, and nothing that could do harm."""

import base64
import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from browser import browser
from vjepa2_ac.episode import no_progress
from vjepa2_ac.explore.explorer import Place
from vjepa2_ac.explore.postcard import MOVES, write_postcard
from vjepa2_ac.explore.views import Views
from windows import chromium, watched

DEPTH = 2
HOSTILE = "</script><img src=x onerror=alert(1)>"


@pytest.fixture
def postcard(live: Views, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(type(live.explorer), "name", lambda *_: HOSTILE)
    return write_postcard(live, tmp_path / "postcard", no_progress, DEPTH)


def test_every_future_is_in_it_and_is_what_the_model_imagines(postcard: Path, live: Views, tmp_path: Path) -> None:
    text = postcard.read_text()
    data = json.loads(re.findall(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)[0])
    assert len(data["places"]) == 1 + MOVES + MOVES**2
    assert data["episode"] == HOSTILE
    actions, first = [live.action(move) for move in live.moves[:MOVES]], live.middle()
    for number, path in ((0, ()), (3, (2,)), (1 + MOVES + 4 * MOVES + 1, (4, 1))):
        place = Place(first.episode, first.start, tuple(actions[move] for move in path))
        (tmp_path / "image.webp").write_bytes(base64.b64decode(data["places"][number]["imagined"]))
        shown = np.asarray(Image.open(tmp_path / "image.webp").convert("RGB")).astype(int)
        wanted = live.explorer.decoded(live.explorer.imagined(len(live.explorer.contenders) - 1, place))
        assert np.abs(shown - wanted).mean() < 12  # of a random decoder's noise, much compressed
        assert {"true", "error", "copying", "at"} <= data["places"][number].keys()


def test_it_asks_nobody_and_a_name_ends_no_script(postcard: Path) -> None:
    text = postcard.read_text()
    assert not re.findall(r"(?:https?:)?//[\w.]+\.\w|src=[\"']|href=[\"']|@import|url\(", text)
    assert text.count("</script>") == 2
    assert "<img src=x" not in text


def test_keys_and_thumbs_walk_the_tree_and_come_back(postcard: Path) -> None:
    browser()
    with chromium() as started:
        page, wrong = watched(started.new_context(viewport={"width": 360, "height": 700}))
        page.goto(postcard.as_uri())
        said, image = page.locator("#said"), "document.getElementById('imagined').src"
        page.wait_for_function(f"() => {image}.startsWith('data:')")
        first = page.evaluate(image)
        page.keyboard.press("a")
        page.wait_for_function("() => document.getElementById('said').textContent.startsWith('left')")
        page.get_by_role("button", name="up").click()
        page.wait_for_function("() => document.getElementById('said').textContent.startsWith('left, up')")
        assert page.get_by_role("button", name="up").is_disabled()
        assert "copying the first frame" in page.locator("#verdict").inner_text()
        assert page.evaluate("document.documentElement.scrollWidth") <= 360
        page.keyboard.press("z")
        page.keyboard.press("0")
        page.wait_for_function(f"first => {image} === first", arg=first)
        assert said.inner_text() == "The given frame."
        assert not wrong
