"""The report page in a real browser: no errors, no requests, no scripts."""

from __future__ import annotations

from functools import cache

import pytest

from browser import open_page
from evaluation_results import decoded_strips, evaluation, page_of

pytestmark = pytest.mark.usefixtures("drawn")


@cache
def page() -> str:
    """Return a page of everything that can be measured."""
    return page_of(decoded_strips(evaluation(others=("a run with a rather long name/and/slashes",))))


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
