"""The walk through the guides (`make walk`) knows every page, and each exception is of a command that is there."""

import re
import runpy
import shlex

import pytest

from paths import ROOT
from vjepa2_ac.cli import program
from vjepa2_ac.config.loading import load_config

WALK = runpy.run_path(str(ROOT / "scripts/walk.py"))
STEPS = [step for page in WALK["PAGES"] for step in WALK["steps_of"](page)]


def test_every_page_with_commands_is_walked_or_says_why_not() -> None:
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")]
    shown = {str(page.relative_to(ROOT)) for page in pages if re.search(r"```(sh|bash)\n", page.read_text())}
    assert shown <= {*WALK["PAGES"], *WALK["NO_GUIDES"]}
    assert all(WALK["steps_of"](page) for page in WALK["PAGES"])


def test_a_command_is_whole_and_has_no_comment() -> None:
    page = "```sh\n# first\nvjepa2-ac train a \\\n    b=1   # why\n\nmake demo    # so\n```\n"
    assert WALK["commands_of"](page) == ["vjepa2-ac train a b=1", "make demo"]


@pytest.mark.parametrize("table", ["GIVEN", "NOT_WALKED"])
def test_no_exception_is_left_of_a_command_that_is_gone(table: str) -> None:
    given = [step.shown for step in STEPS]
    if table == "GIVEN":  # each changes what those before it made
        for pattern, instead in WALK["GIVEN"].items():
            assert any(re.search(pattern, one) for one in given), pattern
            given = [re.sub(pattern, instead, one) for one in given]
    else:
        assert not [pattern for pattern in WALK["NOT_WALKED"] if not any(re.search(pattern, one) for one in given)]


@pytest.mark.parametrize("step", STEPS, ids=lambda step: step.shown)
def test_what_is_shown_is_what_the_program_takes(step, monkeypatch: pytest.MonkeyPatch) -> None:
    words = (step.shown if step.why_not else step.run).partition(" > ")[0]
    words = words.partition("|| ")[2] or words
    assert step.why_not or not re.search(r"[…\[\]]", words), "a placeholder"
    if words.startswith("vjepa2-ac") and "…" not in words:
        monkeypatch.chdir(ROOT)
        options = program.parsed(program._parser(), shlex.split(words)[1:])
        config = str(getattr(options, "config", None))
        if config.startswith(("builtin:", "configs/")):
            load_config(config, getattr(options, "overrides", []))


def test_pages_name_the_extras_of_what_they_do() -> None:
    where = {(step.page, step.where) for step in STEPS}
    assert {("README.md", "[data]"), ("docs/serving.md", "[serve]"), ("docs/data.md", "[sim]")} <= where
    assert {place for page, place in where if page == "docs/QUICKSTART.md"} == {"wheel[sim,data]"}
