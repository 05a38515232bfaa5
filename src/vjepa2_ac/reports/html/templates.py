"""Templates of the report: HTML and SVG in `assets/report`, filled in by Jinja2, which escapes all text."""

from __future__ import annotations

import re
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from vjepa2_ac.evaluation.result import Evaluation
from vjepa2_ac.reports.html.formatting import decimal, percent, seconds

# Not allowed in HTML, or misleading for a reader: control characters, halves of surrogate pairs, noncharacters,
# and marks that change the direction of text.
_HIDDEN = re.compile("[\\x00-\\x08\\x0b-\\x1f\\x7f-\\x9f\\u202a-\\u202e\\u2066-\\u2069\\ud800-\\udfff\\ufffe\\uffff]")


def render(name: str, **values: Any) -> Markup:
    """Return a template filled in with values: HTML, which other templates do not escape again."""
    return Markup(_environment().get_template(f"report/{name}.jinja").render(values))  # noqa: S704 - escaped


def why_not(evaluation: Evaluation, what: str, otherwise: str) -> str:
    """Return the note of an evaluation that explains why something was not measured."""
    return next((note for note in evaluation.notes if what in note), otherwise)


def visible(text: str) -> str:
    """Return a text without what a page may not show."""
    return _HIDDEN.sub("\N{REPLACEMENT CHARACTER}", text)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("vjepa2_ac", "assets"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_shown,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    filters = {"decimal": decimal, "one_line": _one_line, "percent": percent, "seconds": seconds, "why_not": why_not}
    environment.filters |= filters
    return environment


def _shown(value: Any) -> Any:
    """Return what is written for a value: of text what a page may show, of a number six digits."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, str) and not isinstance(value, Markup):
        return visible(value)
    return value


def _one_line(text: Markup) -> Markup:
    return Markup(re.sub("[ \n]+", " ", text.strip()))  # noqa: S704 - as it was
