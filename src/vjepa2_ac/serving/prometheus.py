"""Figures of a server in Prometheus' text format, version 0.0.4."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

_BOUNDS_S = (0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0)
_PREFIX = "vjepa2_ac_"


@dataclass
class Histogram:
    """How often a duration was at most so long."""

    counts: list[int] = field(default_factory=lambda: [0] * (len(_BOUNDS_S) + 1))
    total_s: float = 0.0

    def add(self, seconds: float) -> None:
        """Count a duration."""
        self.counts[sum(seconds > bound for bound in _BOUNDS_S)] += 1
        self.total_s += seconds

    def lines(self, name: str, about: str) -> list[str]:
        """Return it as text."""
        found, so_far = _head(name, about, "histogram"), 0
        for bound, count in zip((*map(str, _BOUNDS_S), "+Inf"), self.counts, strict=True):
            so_far += count
            found.append(f'{_PREFIX}{name}_bucket{{le="{bound}"}} {so_far}')
        return [*found, f"{_PREFIX}{name}_sum {self.total_s}", f"{_PREFIX}{name}_count {so_far}"]


def counter(name: str, about: str, values: Mapping[str, int], label: str) -> list[str]:
    """Return a counter of several labels as text."""
    rows = [f'{_PREFIX}{name}{{{label}="{_escaped(key)}"}} {value}' for key, value in sorted(values.items())]
    return [*_head(name, about, "counter"), *rows]


def plain(name: str, about: str, value: float, kind: str = "gauge") -> list[str]:
    """Return one number as text."""
    return [*_head(name, about, kind), f"{_PREFIX}{name} {value:g}"]


def text(parts: Sequence[Sequence[str]]) -> str:
    """Return the whole page."""
    return "".join(f"{line}\n" for part in parts for line in part)


def _head(name: str, about: str, kind: str) -> list[str]:
    return [f"# HELP {_PREFIX}{name} {about}", f"# TYPE {_PREFIX}{name} {kind}"]


def _escaped(value: str) -> str:
    return value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
