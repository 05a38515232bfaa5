"""Page elements: sections, figures with a reading hint, tables, collapsible parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from vjepa2_ac.evaluation.intervals import Estimate
from vjepa2_ac.evaluation.result import Evaluation
from vjepa2_ac.reports.html.formatting import decimal, percent, signed
from vjepa2_ac.reports.html.markup import Markup, element, joined, text


@dataclass(frozen=True)
class ReportSection:
    """A section of the page, with an entry in the contents."""

    id: str
    title: str
    body: Markup

    def markup(self) -> Markup:
        """Return the section as HTML."""
        heading = element("h2", self.title, id=f"{self.id}-title")
        return element("section", heading, self.body, id=self.id, aria_labelledby=f"{self.id}-title")


def paragraph(*words: str, class_: str | None = None) -> Markup:
    """Return a paragraph."""
    return element("p", *words, class_=class_)


def why_not(evaluation: Evaluation, what: str, otherwise: str) -> str:
    """Return the note of an evaluation that explains why something was not measured."""
    return next((note for note in evaluation.notes if what in note), otherwise)


def not_measured(what: str, why: str) -> Markup:
    """Return a note that something was not measured, and why."""
    return paragraph(element("strong", f"{what}: not measured."), f" {why}", class_="missing")


def figure(title: str, body: str, how_to_read: str) -> Markup:
    """Return a figure or chart under its title, with a reading hint."""
    caption = element("figcaption", element("h3", title), element("p", how_to_read, class_="how"))
    return element("figure", caption, element("div", body, class_="drawing"))


def side_by_side(*figures: str) -> Markup:
    """Return figures beside each other where the page is wide enough."""
    return element("div", *figures, class_="side-by-side") if any(figures) else Markup()


def table(caption: str, head: Sequence[str], rows: Sequence[Sequence[str]], *, class_: str | None = None) -> Markup:
    """Return a table; the first cell of a row is its header. It scrolls by itself if the page is narrow."""
    header = element("thead", element("tr", *(element("th", name, scope="col") for name in head)))
    lines = [
        element("tr", element("th", row[0], scope="row"), *(element("td", cell) for cell in row[1:])) for row in rows
    ]
    whole = element(
        "table", element("caption", element("span", caption)), header, element("tbody", *lines), class_=class_
    )
    return scrolling(whole, caption)


def scrolling(body: str, label: str) -> Markup:
    """Return wide content in a box that scrolls sideways, also by the keyboard."""
    return element("div", body, class_="scroll", tabindex=0, role="region", aria_label=label)


def folded(summary: str, *body: str) -> Markup:
    """Return collapsible content, which is expanded in print."""
    return element("details", element("summary", summary), *body)


def listed(*lines: str) -> Markup:
    """Return lines as a list."""
    return element("ul", *(element("li", line) for line in lines))


def value(estimate: Estimate, digits: int = 3) -> Markup:
    """Return an estimate as value [low, high]."""
    shown = decimal(estimate.value, digits)
    if not estimate.has_interval:
        return text(shown)
    return _with_interval(shown, decimal(estimate.low, digits), decimal(estimate.high, digits))


def signed_value(estimate: Estimate, digits: int = 4) -> Markup:
    """Return a difference as value [low, high], with signs."""
    shown = signed(estimate.value, digits)
    if not estimate.has_interval:
        return text(shown)
    return _with_interval(shown, signed(estimate.low, digits), signed(estimate.high, digits))


def share(estimate: Estimate, digits: int = 1, *, with_sign: bool = False) -> Markup:
    """Return a share in percent as value [low, high]."""

    def shown(number: float) -> str:
        return ("+" if with_sign and number > 0 else "") + percent(number, digits)

    if not estimate.has_interval:
        return text(shown(estimate.value))
    return _with_interval(shown(estimate.value), shown(estimate.low), shown(estimate.high))


def _with_interval(shown: str, low: str, high: str) -> Markup:
    return joined(shown, " ", element("span", f"[{low}, {high}]", class_="interval"))
