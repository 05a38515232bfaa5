"""The report page in a real browser: no errors, no requests, no scripts; light and dark, wide and narrow."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest

from browser import open_page
from evaluation_results import evaluation
from vjepa2_ac.reports.write import report_page, write_report

# Put into a copy of the page that may run it: the page itself runs nothing.
PROBE = """<script>addEventListener("load", () => {
  const root = document.documentElement, style = getComputedStyle(root);
  parent.postMessage({
    dark: matchMedia("(prefers-color-scheme: dark)").matches, paper: style.backgroundColor, ink: style.color,
    width: innerWidth, wide: root.scrollWidth,
    broken: [...document.images].filter(one => !one.complete || !one.naturalWidth).length,
  }, "*");
})</script></head>"""
FRAME = """<!DOCTYPE html><html><head><meta name="color-scheme" content="light dark"><script>
addEventListener("message", told => Object.assign(document.documentElement.dataset, told.data));
</script></head><body><iframe src="probed.html" width="WIDTH" height="900" style="border: 0"></iframe></body></html>"""


@cache
def page() -> str:
    return report_page(evaluation(others=("a run with a name that is rather long/and/has/slashes",)))


def probed(folder: Path, *, dark: bool, width: int) -> dict[str, str]:
    """Return what the page is like in a window of a width, which a frame may have less than a browser's least."""
    html = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page(), count=1).replace("</head>", PROBE)
    (folder / "probed.html").write_text(html, encoding="utf-8")
    frame = folder / "frame.html"
    frame.write_text(FRAME.replace("WIDTH", str(width)), encoding="utf-8")
    seen = open_page(frame, folder, dark=dark)
    return dict(re.findall(r'data-(\w+)="([^"]*)"', seen.dom.partition("<head")[0]))


def test_the_page_opens_from_its_file_without_complaint_or_request(tmp_path) -> None:
    seen = open_page(write_report(evaluation(), tmp_path / "report.html"), tmp_path)
    assert seen.console == ()
    assert seen.requests == ()
    assert "What was measured" in seen.dom


def test_the_browser_of_these_tests_would_tell_of_requests_and_complaints(tmp_path) -> None:
    page = tmp_path / "page.html"
    page.write_text('<img src="http://127.0.0.1:9/picture.png"><script>missing()</script>')
    seen = open_page(page, tmp_path)
    assert seen.requests == ("http://127.0.0.1:9/picture.png",)
    assert any("missing is not defined" in line for line in seen.console)


def test_what_a_name_smuggles_in_is_not_run_even_if_it_were_not_escaped(tmp_path) -> None:
    html = report_page(evaluation()).replace("<main>", '<main><script>document.title = "run"</script>')
    page = tmp_path / "smuggled.html"
    page.write_text(html, encoding="utf-8")
    seen = open_page(page, tmp_path)
    assert "<title>run</title>" not in seen.dom
    assert any("Content Security Policy" in line for line in seen.console)


@pytest.mark.usefixtures("drawn")
@pytest.mark.parametrize(("dark", "width"), [(True, 1400), (False, 400)])
def test_the_page_fits_the_window_in_its_colours_and_shows_its_images(tmp_path, dark, width) -> None:
    found = probed(tmp_path, dark=dark, width=width)
    assert found["dark"] == str(dark).lower()
    assert found["paper"] == ("rgb(20, 23, 27)" if dark else "rgb(255, 255, 255)")
    assert found["ink"] == ("rgb(230, 233, 236)" if dark else "rgb(28, 33, 39)")
    assert int(found["width"]) == width
    assert int(found["wide"]) <= int(found["width"])  # nothing makes the whole page scroll sideways
    assert found["broken"] == "0"
