"""The site: built strictly, complete, searchable without a network, and its links lead to its pages."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from browser import open_page
from made_pages import commands_page, keys_page
from paths import ROOT
from site_links import on_site
from vjepa2_ac.config.loading import all_keys


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build as `make docs` does: a warning, such as a link that leads nowhere, is an error."""
    folder = tmp_path_factory.mktemp("site")
    words = ["-q", "-W", "--keep-going", "-b", "html", "-d", folder / "doctrees", ROOT / "docs", folder / "html"]
    process = subprocess.run([sys.executable, "-m", "sphinx", *words], capture_output=True, text=True)
    assert process.returncode == 0, process.stderr[-3000:]
    return folder / "html"


def test_pages_send_no_requests_and_search_works_from_a_file(site: Path, tmp_path: Path) -> None:
    page = tmp_path / "search.html"
    page.write_text(f'<meta http-equiv="refresh" content="0; url={(site / "search.html").as_uri()}?q=warmup">')
    opened = open_page(page, tmp_path)
    assert opened.requests == ()
    assert "pages matching the search query" in opened.dom
    assert (site / "made/api.html").read_text().count('<dt class="sig') > 11


def test_commands_page_shows_the_help_of_every_command() -> None:
    page = commands_page()
    for words in ("train", "init", "demo", "data check", "data calibrate", "simulate", "serve", "config"):
        assert f"## {words}\n\n```text\nexample:\n  vjepa2-ac {words} " in page, words


def test_config_keys_page_lists_every_key_with_its_range() -> None:
    page = keys_page()
    sections = {key.rpartition(".")[0] for key in all_keys()}
    keys = {re.sub(r"^replay\.data\.", "data.", key) for key in all_keys() if key not in sections | {"replay.data"}}
    missing = [key for key in sorted(keys) if f"| `{key}` |" not in page]
    assert not missing
    assert "| `training.learning_rate` | number > 0.0 ≤ 1.0 | `0.0001` | Peak learning rate. |" in page


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[a](docs/data.md#clips)", "[a](data.md#clips)"),
        ("![a](docs/demo.png)", "![a](demo.png)"),
        ("[a](configs/own_robot.yaml)", "[a](made/configs.md#own-robot)"),
        ("[a](https://x.org/y) and [b](#here)", "[a](https://x.org/y) and [b](#here)"),
        ("the [b](NOTICE) file", "the b file"),
        ("[a](nothing/there.md)", "[a](nothing/there.md)"),  # the build complains
        ("[![a badge](https://x.org/y.svg)](LICENSE)\nb", "b"),
    ],
)
def test_repository_links_become_links_to_pages(text: str, expected: str) -> None:
    assert on_site(text, "README.md", "index.md") == expected
