"""The page of explore in a real browser: the way of a new user, by keys alone, on a phone; and what may go wrong."""

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from vjepa2_ac.explore.views import Views
from windows import chromium, serving, watched

LARGE, PHONE = {"width": 1400, "height": 900}, {"width": 390, "height": 844}


@pytest.fixture(scope="module")
def started() -> Iterator[Any]:
    with chromium() as one:
        yield one


@pytest.fixture
def opened(started: Any) -> Iterator[Any]:
    """Return a function that opens a page, which may complain of nothing."""
    contexts, complaints = [], []

    def open_one(url: str, **context: Any) -> Any:
        contexts.append(started.new_context(**{"viewport": LARGE, **context}))
        page, wrong = watched(contexts[-1])
        complaints.append(wrong)
        page.goto(url)
        steps_are(page, 0)
        return page

    yield open_one
    for context in contexts:
        context.close()
    assert not any(complaints)


def role(page: Any, name: str) -> Any:
    return page.locator(f'[data-role="{name}"]')


def steps_are(page: Any, count: int) -> None:
    """Wait until so many steps of a path are shown."""
    page.wait_for_function(
        "count => document.querySelectorAll('[data-role=trail] [aria-current=step]').length === 1"
        " && document.querySelectorAll('[data-role=trail] li').length === count + 1"
        " && document.querySelector('[data-role=main]').getAttribute('aria-busy') === 'false'",
        arg=count,
    )


def shown(page: Any, of: str) -> str:
    """Return the large picture of a teller: what its pixels are."""
    return str(
        page.evaluate(
            """of => {
              const image = document.querySelector(`[data-of="${of}"] [data-role=large]`);
              const canvas = Object.assign(document.createElement("canvas"), {width: 64, height: 64});
              canvas.getContext("2d").drawImage(image, 0, 0, 64, 64);
              return canvas.toDataURL();
            }""",
            of,
        )
    )


def test_a_new_user_takes_an_action_sees_what_is_true_and_comes_back(live: Views, opened: Any) -> None:
    with serving(live) as url:
        page = opened(url)
        before = [shown(page, of) for of in ("base", "adapter", "truth")]
        page.get_by_role("button", name=re.compile("left$")).first.click()
        steps_are(page, 1)
        after = [shown(page, of) for of in ("base", "adapter", "truth")]
        assert all(one != other for one, other in zip(before, after, strict=True))
        assert re.search(r"error \d\.\d+.*copying \d\.\d+", role(page, "sentence").inner_text())
        role(page, "undo").click()
        steps_are(page, 0)
        assert [shown(page, of) for of in ("base", "adapter", "truth")] == before


def test_all_of_it_can_be_done_by_keys(live: Views, opened: Any) -> None:
    with serving(live) as url:
        page = opened(url)
        for count, key in enumerate(("a", "r", "c", "Space", "n"), start=1):
            page.keyboard.press(key)
            if key != "n":
                steps_are(page, count)
        assert "no recorded action" in role(page, "sentence").inner_text()
        page.keyboard.press("0")
        steps_are(page, 0)
        page.keyboard.press("n")
        steps_are(page, 1)
        page.keyboard.press("m")
        cells = page.locator('[data-role="energy-map"] button')
        cells.first.wait_for()
        cells.nth(3).focus()
        page.keyboard.press("ArrowDown")
        page.keyboard.press("Enter")
        steps_are(page, 2)
        page.keyboard.press("t")
        assert role(page, "picture").locator("visible=true").count() >= 2
        page.keyboard.press("?")
        assert page.get_by_role("dialog").is_visible()
        page.keyboard.press("Escape")
        page.keyboard.press("p")
        role(page, "best").locator("figure").first.wait_for()
        steps_are(page, 5)


def test_keys_do_not_act_while_a_number_is_typed(live: Views, opened: Any) -> None:
    with serving(live) as url:
        page = opened(url)
        role(page, "goal").locator("summary").first.click()
        role(page, "plan-steps").fill("4")
        role(page, "plan-steps").press("d")
        page.keyboard.press("Control+a")
        page.wait_for_timeout(300)
        steps_are(page, 0)


def test_a_link_restores_the_state_in_another_tab_and_tabs_do_not_disturb_each_other(live: Views, opened: Any) -> None:
    with serving(live) as url:
        first = opened(url)
        for count, key in enumerate("awd", start=1):
            first.keyboard.press(key)
            steps_are(first, count)
        context = first.context
        second = context.new_page()
        second.goto(first.url)
        steps_are(second, 3)
        assert shown(second, "adapter") == shown(first, "adapter")
        second.keyboard.press("f")
        steps_are(second, 4)
        first.keyboard.press("z")
        steps_are(first, 2)
        steps_are(second, 4)


def test_nothing_is_beyond_the_edge_of_a_phone(live: Views, opened: Any) -> None:
    with serving(live) as url:
        page = opened(url, viewport=PHONE)
        page.get_by_role("button", name=re.compile("up$")).first.click()
        steps_are(page, 1)
        assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
        page.set_viewport_size({"width": 360, "height": 640})
        assert page.evaluate("document.documentElement.scrollWidth") <= 360


def test_a_lost_server_is_said_and_the_page_goes_on_where_it_was(live: Views, started: Any) -> None:
    context = started.new_context()
    page, _ = watched(context)  # a browser complains of a lost socket, and may
    with serving(live) as url:
        page.goto(url)
        steps_are(page, 0)
        page.keyboard.press("a")
        steps_are(page, 1)
        seen = shown(page, "adapter")
    role(page, "lost").wait_for(state="visible")
    assert "does not answer" in role(page, "lost").inner_text()
    with serving(live, port=int(url.rstrip("/").rpartition(":")[2])):
        role(page, "lost").wait_for(state="hidden")
        steps_are(page, 1)
        assert shown(page, "adapter") == seen
        page.keyboard.press("a")
        steps_are(page, 2)
    context.close()


def test_a_hostile_name_is_text(live: Views, opened: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "<img src=x onerror=alert(1)>\x1b[31m<script>alert(2)<b>"
    monkeypatch.setattr(type(live.explorer), "name", lambda _self, number: f"{name}{number}")
    with serving(replace(live)) as url:  # names are cached
        page = opened(url)
        page.keyboard.press("a")
        steps_are(page, 1)
        assert name.replace("\x1b", "") in role(page, "episode").inner_text().replace("\x1b", "")
        assert not page.locator("img[src=x]").count()
