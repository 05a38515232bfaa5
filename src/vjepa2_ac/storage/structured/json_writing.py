"""JSON that this program writes: times, numbers that are finite or null, lists of numbers on one line."""

from __future__ import annotations

import json
import math
import re
import time
from typing import Any

_PLAIN_LIST = re.compile(r"\[\s+((?:(?:-?\d[\d.e+-]*|null|true|false),?\s+)+)\]")


def utc_now() -> str:
    """Return the time in UTC, to the second, as ISO 8601."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())


def finite_or_none(value: float) -> float | None:
    """Return a number; None for NaN and infinity, which JSON does not have."""
    return value if math.isfinite(value) else None


def json_text(value: Any) -> str:
    """Return plain values as indented JSON, each list of plain values on one line.

    Raises:
        ValueError: A number is not finite.
    """
    text = json.dumps(value, indent=1, allow_nan=False)
    return _PLAIN_LIST.sub(lambda found: "[" + " ".join(found[1].split()) + "]", text) + "\n"
