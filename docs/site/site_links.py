"""Convert links between files of the repository to links between pages of the site."""

from __future__ import annotations

import os
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s#]+)(#[^()\s]*)?\)")
_BADGE = re.compile(r"\[!\[[^\]]*\]\(https://[^)]*\)\]\([^)]*\)\n?")
_ROOT_PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "made/changelog.md",
    "CONTRIBUTING.md": "made/contributing.md",
    "SECURITY.md": "made/security.md",
}


def on_site(text: str, file: str, page: str) -> str:
    """Return the text of a file with links to the pages of the site.

    A link to a file without a page is replaced by its label. A link to a file that does not exist is kept, so that the
    build reports it. Badges are removed, because the site loads nothing from the network.

    Args:
        text: The file in Markdown.
        file: Path of the file in the repository, such as docs/data.md.
        page: Path of its page, relative to the folder `docs`.
    """

    def replace_link(match: re.Match[str]) -> str:
        mark, label, target, anchor = match.groups()
        if "://" in target or target.startswith("mailto:"):
            return match[0]
        linked_file = os.path.normpath(Path(file).parent / target)
        address = _page_of(linked_file, anchor or "")
        if address is None:
            return label if (ROOT / linked_file).exists() else match[0]
        path, _, fragment = address.partition("#")
        return f"{mark}[{label}]({os.path.relpath(path, Path(page).parent)}{'#' * bool(fragment)}{fragment})"

    return _LINK.sub(replace_link, _BADGE.sub("", text))


def _page_of(path: str, anchor: str) -> str | None:
    """Return the page or the image of a file, relative to the folder `docs`, with the anchor; None without a page."""
    if path.startswith("docs/"):
        return path.removeprefix("docs/") + anchor
    if path in _ROOT_PAGES:
        return _ROOT_PAGES[path] + anchor
    if path.startswith(("benchmarks/results/", "evidence/results/")):
        return f"made/{path.partition('/')[2]}{anchor}"
    if path.startswith("configs/") and (ROOT / path).exists():
        return f"made/configs.md#{Path(path).stem.replace('_', '-')}"
    if path.startswith("examples") and (ROOT / path).exists():
        return "made/examples.md"
    return None
