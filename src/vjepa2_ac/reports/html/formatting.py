"""Number formatting: unit, significant digits, and the interval in brackets."""

from __future__ import annotations

import math

NOT_MEASURED = "\N{EN DASH}"  # in a table; the reason is given beside it


def decimal(value: float, digits: int = 3) -> str:
    """Return a number with fixed digits and a true minus sign; a dash if it is not finite."""
    if not math.isfinite(value):
        return NOT_MEASURED
    shown = f"{value:.{digits}f}"
    return (shown if float(shown) else shown.lstrip("-")).replace("-", "\N{MINUS SIGN}")


def signed(value: float, digits: int = 3) -> str:
    """Return a number with its sign, also if it is positive."""
    shown = decimal(value, digits)
    return f"+{shown}" if math.isfinite(value) and float(f"{value:.{digits}f}") > 0 else shown


def percent(share: float, digits: int = 0) -> str:
    """Return a share as percentage."""
    return f"{decimal(share * 100, digits)}\N{NO-BREAK SPACE}%" if math.isfinite(share) else NOT_MEASURED


def seconds(value: float) -> str:
    """Return a time with its unit."""
    return f"{decimal(value, 2)}\N{NO-BREAK SPACE}s"
