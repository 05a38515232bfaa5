"""Number formatting: unit, significant digits, and the interval in brackets."""

from __future__ import annotations

import math
from collections.abc import Callable

from markupsafe import Markup

from vjepa2_ac.intervals import Estimate

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


def percent(share: float, digits: int = 0, *, with_sign: bool = False) -> str:
    """Return a share as percentage; also a positive one with its sign if that is asked for."""
    if not math.isfinite(share):
        return NOT_MEASURED
    return f"{'+' if with_sign and share > 0 else ''}{decimal(share * 100, digits)}\N{NO-BREAK SPACE}%"


def seconds(value: float) -> str:
    """Return a time with its unit."""
    return f"{decimal(value, 2)}\N{NO-BREAK SPACE}s"


def value(estimate: Estimate, digits: int = 3) -> Markup:
    """Return an estimate as value [low, high]."""
    return _with_interval(estimate, lambda number: decimal(number, digits))


def signed_value(estimate: Estimate, digits: int = 4) -> Markup:
    """Return a difference as value [low, high], with signs."""
    return _with_interval(estimate, lambda number: signed(number, digits))


def share(estimate: Estimate, digits: int = 1, *, with_sign: bool = False) -> Markup:
    """Return a share in percent as value [low, high]."""
    return _with_interval(estimate, lambda number: percent(number, digits, with_sign=with_sign))


def _with_interval(estimate: Estimate, shown: Callable[[float], str]) -> Markup:
    value, low, high = (shown(number) for number in (estimate.value, estimate.low, estimate.high))
    if not estimate.has_interval:
        return Markup("{}").format(value)
    return Markup('{} <span class="interval">[{}, {}]</span>').format(value, low, high)
