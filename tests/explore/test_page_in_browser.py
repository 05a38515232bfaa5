"""The page of `explore` in a real browser: with mouse, with keys, on a phone, and after a lost connection."""

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from vjepa2_ac.explore.views import Views
from windows import chromium, open_watched_page, serving

LARGE, PHONE = {"width": 1400, "height": 900}, {"width": 390, "height": 844}


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as started:
        yield started


@pytest.fixture
def open_page(browser: Any) -> Iterator[Any]:
    """Return a function that opens a page; afterwards the pages must not have reported any error."""
    contexts, errors = [], []

    def open_page_at(url: str, **context: Any) -> Any:
        contexts.append(browser.new_context(**{"viewport": LARGE, **context}))
        page, page_errors = open_watched_page(contexts[-1])
        errors.append(page_errors)
        page.goto(url)
        wait_for_steps(page, 0)
        return page

    yield open_page_at
    for context in contexts:
        context.close()
    assert not any(errors)


def role(page: Any, name: str) -> Any:
    return page.locator(f'[data-role="{name}"]')


def wait_for_steps(page: Any, count: int) -> None:
    """Wait until the page shows a path with `count` steps."""
    page.wait_for_function(
        "count => document.querySelectorAll('[data-role=trail] [aria-current=step]').length === 1"
        " && document.querySelectorAll('[data-role=trail] li').length === count + 1"
        " && document.querySelector('[data-role=main]').getAttribute('aria-busy') === 'false'",
        arg=count,
    )


def get_pixels(page: Any, name: str) -> str:
    """Return the pixels of the large image of a model or of the ground truth."""
    return str(
        page.evaluate(
            """of => {
              const image = document.querySelector(`[data-of="${of}"] [data-role=large]`);
              const canvas = Object.assign(document.createElement("canvas"), {width: 64, height: 64});
              canvas.getContext("2d").drawImage(image, 0, 0, 64, 64);
              return canvas.toDataURL();
            }""",
            name,
        )
    )


def test_action_changes_all_images_and_undo_restores_them(live: Views, open_page: Any) -> None:
    with serving(live) as url:
        page = open_page(url)
        before = [get_pixels(page, name) for name in ("base", "adapter", "truth")]
        page.get_by_role("button", name=re.compile("left$")).first.click()
        wait_for_steps(page, 1)
        after = [get_pixels(page, name) for name in ("base", "adapter", "truth")]
        assert all(old != new for old, new in zip(before, after, strict=True))
        assert re.search(r"error \d\.\d+.*persistence \d\.\d+", role(page, "sentence").inner_text())
        assert re.search(r"turn left \d\.\d°: ", role(page, "sentence").inner_text())
        role(page, "undo").click()
        wait_for_steps(page, 0)
        assert [get_pixels(page, name) for name in ("base", "adapter", "truth")] == before


def test_all_functions_are_available_by_keys(live: Views, open_page: Any) -> None:
    with serving(live) as url:
        page = open_page(url)
        for count, key in enumerate(("a", "r", "c", "Space", "n"), start=1):
            page.keyboard.press(key)
            if key != "n":
                wait_for_steps(page, count)
        assert "no recorded action" in role(page, "sentence").inner_text()
        page.keyboard.press("0")
        wait_for_steps(page, 0)
        page.keyboard.press("n")
        wait_for_steps(page, 1)
        page.keyboard.press("m")
        cells = page.locator('[data-role="energy-map"] button')
        cells.first.wait_for()
        cells.nth(3).focus()
        page.keyboard.press("ArrowDown")
        page.keyboard.press("Enter")
        wait_for_steps(page, 2)
        page.keyboard.press("t")
        assert role(page, "view").locator("visible=true").count() >= 2
        page.keyboard.press("?")
        assert page.get_by_role("dialog").is_visible()
        page.keyboard.press("Escape")
        page.keyboard.press("p")
        role(page, "best").locator("figure").first.wait_for()
        wait_for_steps(page, 5)
        assert not re.findall("undefined|NaN|\\[object", page.locator("body").inner_text())


def test_typing_a_number_commands_no_motion(live: Views, open_page: Any) -> None:
    with serving(live) as url:
        page = open_page(url)
        role(page, "goal").locator("summary").first.click()
        role(page, "plan-steps").fill("4")
        role(page, "plan-steps").press("d")
        page.keyboard.press("Control+a")
        page.wait_for_timeout(300)
        wait_for_steps(page, 0)


def test_link_restores_the_state_in_an_independent_tab(live: Views, open_page: Any) -> None:
    with serving(live) as url:
        first = open_page(url)
        for count, key in enumerate("awd", start=1):
            first.keyboard.press(key)
            wait_for_steps(first, count)
        context = first.context
        second = context.new_page()
        second.goto(first.url)
        wait_for_steps(second, 3)
        assert get_pixels(second, "adapter") == get_pixels(first, "adapter")
        second.keyboard.press("f")
        wait_for_steps(second, 4)
        first.keyboard.press("z")
        wait_for_steps(first, 2)
        wait_for_steps(second, 4)


def test_page_fits_the_width_of_a_phone(live: Views, open_page: Any) -> None:
    with serving(live) as url:
        page = open_page(url, viewport=PHONE)
        page.get_by_role("button", name=re.compile("up$")).first.click()
        wait_for_steps(page, 1)
        assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
        page.set_viewport_size({"width": 360, "height": 640})
        assert page.evaluate("document.documentElement.scrollWidth") <= 360


def test_page_reconnects_and_keeps_its_state(live: Views, browser: Any) -> None:
    context = browser.new_context()
    page, _ = open_watched_page(context)  # its errors are ignored: the browser may report the lost socket
    with serving(live) as url:
        page.goto(url)
        wait_for_steps(page, 0)
        page.keyboard.press("a")
        wait_for_steps(page, 1)
        before = get_pixels(page, "adapter")
    role(page, "disconnected").wait_for(state="visible")
    assert "No connection to the server" in role(page, "disconnected").inner_text()
    with serving(live, port=int(url.rstrip("/").rpartition(":")[2])):
        role(page, "disconnected").wait_for(state="hidden")
        wait_for_steps(page, 1)
        assert get_pixels(page, "adapter") == before
        page.keyboard.press("a")
        wait_for_steps(page, 2)
    context.close()


def test_markup_in_episode_names_is_shown_as_text(live: Views, open_page: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "<img src=x onerror=alert(1)>\x1b[31m<script>alert(2)<b>"
    monkeypatch.setattr(type(live.explorer), "get_episode_name", lambda _self, number: f"{name}{number}")
    with serving(replace(live)) as url:  # a copy without cached names
        page = open_page(url)
        page.keyboard.press("a")
        wait_for_steps(page, 1)
        assert name.replace("\x1b", "") in role(page, "episode").inner_text().replace("\x1b", "")
        assert not page.locator("img[src=x]").count()
