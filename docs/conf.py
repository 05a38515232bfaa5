"""Sphinx's configuration of the site: `make docs`."""

import sys
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent / "site"))
from made_pages import write_pages
from site_links import on_site

write_pages(Path(__file__).parent / "made")

project, author, copyright = "vjepa2-ac", "The vjepa2-ac authors", "The vjepa2-ac authors, Apache-2.0"  # noqa: A001
version = release = version_of("vjepa2-ac")
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns = ["site"]

myst_heading_anchors = 4  # as GitHub makes them
myst_enable_extensions = ["colon_fence"]
suppress_warnings = ["myst.header"]  # results begin at the heading that docs/evidence.md has for them

html_theme = "furo"
html_title = f"vjepa2-ac {version}"
html_static_path = ["site/static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_copy_source = False

napoleon_google_docstring, napoleon_numpy_docstring = True, False
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_preserve_defaults = True
copybutton_exclude = ".linenos, .gp, .go"


def setup(app: Any) -> None:
    """Let the links of the pages in this folder lead to pages of the site."""

    def read(_app: Any, page: str, source: list[str]) -> None:
        if not page.startswith("made/"):
            source[0] = on_site(source[0], f"docs/{page}.md", f"{page}.md")

    app.connect("source-read", read)
