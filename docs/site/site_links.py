"""Links between files of the repository, as links between pages of the site."""

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
    """Return the text of a file with links that lead to the pages of the site.

    A link to a file that has no page becomes its label. A link to a file that does not exist stays, and the build
    reports it. Badges are removed, because the site loads nothing from the network.

    Args:
        text: Markdown.
        file: Where it is in the repository, such as docs/data.md.
        page: Which page it becomes, from the folder `docs`.
    """

    def replaced(match: re.Match[str]) -> str:
        mark, label, target, anchor = match.groups()
        if "://" in target or target.startswith("mailto:"):
            return match[0]
        meant = os.path.normpath(Path(file).parent / target)
        found = _page_of(meant, anchor or "")
        if found is None:
            return label if (ROOT / meant).exists() else match[0]
        place, _, inside = found.partition("#")
        return f"{mark}[{label}]({os.path.relpath(place, Path(page).parent)}{'#' * bool(inside)}{inside})"

    return _LINK.sub(replaced, _BADGE.sub("", text))


def _page_of(path: str, anchor: str) -> str | None:
    """Return the page or the image of a file, from the folder `docs`, with the anchor."""
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
