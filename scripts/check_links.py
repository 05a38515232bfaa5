"""Check the links of every Markdown file: to files and headings of this project, or with --external to other sites.

python scripts/check_links.py [--external]
"""

import re
import sys
import urllib.request
from pathlib import Path

ROOT = Path(__file__).parents[1]
MADE = "docs/made"  # by `make docs`, which checks its links itself
FOLDERS = ("docs", "benchmarks", "examples", "scripts", "src", "tests", ".github")
CODE = re.compile(r"^(```|~~~).*?^\1|`[^`\n]+`", flags=re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\(\s*<?([^)\s>]+)[^)]*\)|^\[[^\]]+\]:\s*(\S+)|\b(?:src|href)=\"([^\"]+)\"", flags=re.MULTILINE)


def pages(root: Path) -> list[Path]:
    """Return every Markdown file of ours."""
    found = [*root.glob("*.md"), *(page for folder in FOLDERS for page in (root / folder).rglob("*.md"))]
    return sorted(page for page in found if not page.is_relative_to(root / MADE))


def links(page: Path) -> list[str]:
    """Return where a page links to, in its order; not what stands in code."""
    return ["".join(found) for found in LINK.findall(CODE.sub("", page.read_text()))]


def anchors(page: Path) -> set[str]:
    """Return the names of a page's headings, as GitHub makes them."""
    found: set[str] = set()
    text = re.sub(r"^(```|~~~).*?^\1", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    for title in re.findall(r"^#{1,6}\s+(.+?)\s*#*$", text, flags=re.MULTILINE):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", title)
        slug = re.sub(r"[^\w\- ]", "", plain.lower()).replace(" ", "-")
        found.add(next(name for name in (slug, *(f"{slug}-{n}" for n in range(1, 100))) if name not in found))
    return found | set(re.findall(r"\b(?:id|name)=\"([^\"]+)\"", text))


def dead_links(root: Path) -> list[str]:
    """Return a line for each link to a file or heading that is not there."""
    dead = []
    for page in pages(root):
        for link in links(page):
            if re.match(r"[a-z]+:", link):
                continue
            path, _, anchor = link.partition("#")
            target = (root / path[1:] if path.startswith("/") else page.parent / path) if path else page
            if not target.exists() or (anchor and target.suffix == ".md" and anchor not in anchors(target)):
                dead.append(f"{page.relative_to(root)}: {link}")
    return dead


def dead_addresses(root: Path) -> list[str]:
    """Return a line for each link to another site that does not answer."""
    dead = []
    for address in sorted({link for page in pages(root) for link in links(page) if link.startswith("http")}):
        try:
            request = urllib.request.Request(address, headers={"User-Agent": "check_links"})  # noqa: S310  # http only
            urllib.request.urlopen(request, timeout=20).close()  # noqa: S310
        except (OSError, ValueError) as error:  # URLError is an OSError
            dead.append(f"{address}: {error}")
    return dead


if __name__ == "__main__":
    wrong = dead_addresses(ROOT) if "--external" in sys.argv[1:] else dead_links(ROOT)
    sys.exit("\n".join(["Dead links:", *wrong]) if wrong else 0)
