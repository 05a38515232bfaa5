"""Findings: the lines of `data check`, and their summary."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from vjepa2_ac.errors import counted

Level = Literal["ok", "warning", "error", "skipped"]


@dataclass(frozen=True)
class Finding:
    """The result of one check of a data set.

    An error: training would not start, or learn nothing. A warning: something is probably wrong. Skipped: the check did
    not run, or could not decide; the text says what it needs.
    """

    level: Level
    about: str  # the name of the check
    text: str


def first_case(about: str, text: str, *cases: tuple[bool, Level, str]) -> Finding:
    """Return the finding of the first case that holds, with its level and explanation; `ok` if none holds."""
    level, words = next(((level, words) for holds, level, words in cases if holds), ("ok", ""))
    return Finding(level, about, f"{text}: {words}" if words else text)


def findings_as_dict(findings: Sequence[Finding]) -> dict[str, Any]:
    """Return the findings as plain values, with the number of errors, warnings and skipped checks."""
    counts = Counter(one.level for one in findings)
    return {
        "findings": [{"level": one.level, "name": one.about, "text": one.text} for one in findings],
        "errors": counts["error"],
        "warnings": counts["warning"],
        "skipped": counts["skipped"],
    }


def summary_of(findings: Sequence[Finding]) -> str:
    """Return the last line of `data check`, such as "0 errors, 1 warning, 3 skipped"."""
    counts = Counter(one.level for one in findings)
    return f"{counted(counts['error'], 'error')}, {counted(counts['warning'], 'warning')}, {counts['skipped']} skipped"
