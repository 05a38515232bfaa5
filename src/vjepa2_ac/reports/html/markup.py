"""HTML markup: elements that escape all text and attributes."""

from __future__ import annotations

import re
from html import escape
from typing import TypeAlias

Attribute: TypeAlias = str | int | float | bool | None

# Without an end tag in HTML; those of SVG close themselves, which HTML allows only within SVG.
_VOID = frozenset({"br", "hr", "img", "input", "meta", "wbr"})
_SVG_LEAVES = frozenset({"circle", "image", "line", "path", "polyline", "rect", "use"})

# Not allowed in HTML, or misleading for a reader: control characters, halves of surrogate pairs, noncharacters,
# and marks that change the direction of text.
_HIDDEN = re.compile("[\\x00-\\x08\\x0b-\\x1f\\x7f-\\x9f\\u202a-\\u202e\\u2066-\\u2069\\ud800-\\udfff\\ufffe\\uffff]")


class Markup(str):
    """Text that is HTML already, and is not escaped again. Only `element` and `joined` create it."""

    __slots__ = ()


def text(value: str) -> Markup:
    """Return text escaped as HTML."""
    return value if isinstance(value, Markup) else Markup(escape(_visible(value), quote=True))


def joined(*parts: str, by: str = "") -> Markup:
    """Return parts one after another; those that are no Markup are escaped."""
    return Markup(text(by).join(text(part) for part in parts))


def element(name: str, /, *children: str, **attributes: Attribute) -> Markup:
    """Return an element; children that are no Markup, and values of attributes, are escaped.

    Names of attributes lose a trailing underscore (`class_`), other underscores become hyphens. A value of True is an
    attribute without value; None and False leave it out.
    """
    start = "".join([name, *(_attribute(key, value) for key, value in attributes.items())])
    if name in _VOID:
        return Markup(f"<{start}>")
    if name in _SVG_LEAVES and not children:
        return Markup(f"<{start}/>")
    return Markup(f"<{start}>{joined(*children)}</{name}>")


def _attribute(key: str, value: Attribute) -> str:
    key = key.rstrip("_").replace("_", "-")
    if value is None or value is False:
        return ""
    if value is True:
        return f" {key}"
    shown = f"{value:.6g}" if isinstance(value, float) else str(value)
    return f' {key}="{escape(_visible(shown), quote=True)}"'


def _visible(value: str) -> str:
    return _HIDDEN.sub("\N{REPLACEMENT CHARACTER}", value)
