"""The report page in a real browser: no errors, no requests, no scripts; light and dark, wide and narrow, folded."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest

from browser import open_page
from evaluation_results import decoded_strips, evaluation, page_of

pytestmark = pytest.mark.usefixtures("drawn")

# Put into a copy of the page that may run it: the page itself runs nothing.
PROBE = """<script>addEventListener("load", () => {
  const root = document.documentElement, end = name => document.querySelector(name).getBoundingClientRect().bottom;
  parent.postMessage({
    paper: getComputedStyle(root).backgroundColor, width: innerWidth, wide: root.scrollWidth, high: root.scrollHeight,
    first: end(".first"), answer: end(".answer"),
    broken: [...document.images].filter(one => !one.complete || !one.naturalWidth).length,
  }, "*");
})</script></head>"""
FRAME = """<!DOCTYPE html><html><head><meta name="color-scheme" content="light dark"><script>
addEventListener("message", told => Object.assign(document.documentElement.dataset, told.data));
</script></head><body><iframe src="probed.html" width="WIDTH" height="900" style="border: 0"></iframe></body></html>"""


@cache
def page() -> str:
    """Return a page of everything that can be measured."""
    return page_of(decoded_strips(evaluation(others=("a run with a rather long name/and/slashes",))))


def probed(folder: Path, *, dark: bool, width: int, opened: bool) -> dict[str, str]:
    """Return what the page is like in a window of a width, which a frame may have less than a browser's least."""
    html = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page(), count=1).replace("</head>", PROBE)
    html = html.replace("<details", "<details open") if opened else html
    (folder / "probed.html").write_text(html, encoding="utf-8")
    (folder / "frame.html").write_text(FRAME.replace("WIDTH", str(width)), encoding="utf-8")
    seen = open_page(folder / "frame.html", folder, dark=dark)
    return dict(re.findall(r'data-(\w+)="([^"]*)"', seen.dom.partition("<head")[0]))


def test_the_page_opens_from_its_file_without_complaint_or_request(tmp_path) -> None:
    (tmp_path / "report.html").write_text(page(), encoding="utf-8")
    seen = open_page(tmp_path / "report.html", tmp_path)
    assert (seen.console, seen.requests) == ((), ())
    assert "What was measured" in seen.dom


def test_what_a_name_smuggles_in_is_not_run_even_if_it_were_not_escaped(tmp_path) -> None:
    smuggled = tmp_path / "smuggled.html"
    smuggled.write_text(page().replace("<main>", '<main><script>document.title = "run"</script>'), encoding="utf-8")
    seen = open_page(smuggled, tmp_path)
    assert "<title>run</title>" not in seen.dom
    assert any("Content Security Policy" in line for line in seen.console)


@pytest.mark.parametrize(("dark", "width", "opened"), [(True, 1280, False), (False, 390, True)])
def test_the_page_fits_the_window_in_its_colours_and_shows_its_images(tmp_path, dark, width, opened) -> None:
    found = probed(tmp_path, dark=dark, width=width, opened=opened)
    assert found["paper"] == ("rgb(20, 23, 27)" if dark else "rgb(255, 255, 255)")
    assert int(found["wide"]) <= int(found["width"]) == width  # nothing makes the whole page scroll sideways
    assert (int(found["high"]) > 2400) == opened  # three screens, folded
    assert float(found["answer"]) <= 844, "four verdicts fit the first screen"
    assert float(found["first"]) <= (800 if width == 1280 else 1100)  # summary, video and tiles
    assert found["broken"] == "0"
