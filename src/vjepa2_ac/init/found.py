"""What was found in a data set, as values of a config with their reasons, and their text as YAML."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from vjepa2_ac.config.loading import yaml_line

GUESSED = "GUESSED: "
_COLUMN = 34  # of the comments


@dataclass(frozen=True)
class Knob:
    """A value, why it is that, and whether it was guessed."""

    value: Any
    why: str = ""
    is_guess: bool = False

    @property
    def comment(self) -> str:
        """What stands behind the value."""
        return f"{GUESSED if self.is_guess else ''}{self.why}"


Knobs = Mapping[str, "Knob | Knobs"]


def as_yaml(head: Sequence[str], knobs: Knobs) -> str:
    """Return knobs as the text of a config: a comment at the top, and one behind each value that has a reason."""
    lines = [f"# {line}".rstrip() for line in head]
    for name, one in knobs.items():
        if not isinstance(one, Knob):
            lines.append("")
        lines += _lines({name: one}, "")
    return "\n".join(lines) + "\n"


def plain(knobs: Knobs) -> dict[str, Any]:
    """Return the values alone, as reading their text gives them."""
    return {name: one.value if isinstance(one, Knob) else plain(one) for name, one in knobs.items()}


def guesses(knobs: Knobs, prefix: str = "") -> dict[str, str]:
    """Return the reasons of all guesses, by dotted key."""
    found: dict[str, str] = {}
    for name, one in knobs.items():
        if not isinstance(one, Knob):
            found |= guesses(one, f"{prefix}{name}.")
        elif one.is_guess:
            found[prefix + name] = one.why
    return found


def _lines(knobs: Knobs, indent: str) -> Iterator[str]:
    for name, one in knobs.items():
        if not isinstance(one, Knob):
            yield f"{indent}{name}:"
            yield from _lines(one, indent + "  ")
            continue
        line = indent + yaml_line(name, one.value)
        yield f"{line:<{_COLUMN}}  # {one.comment}" if one.comment else line


@dataclass(frozen=True)
class FoundData:
    """A data set, as far as its descriptions tell."""

    source: str  # form of data
    path: str
    knobs: Knobs  # of `data`, beyond source and path: cameras, names of columns
    rate_hz: Knob  # control steps per second
    states: Literal["pose", "vector"] = "pose"
    episodes: int | None = None
    steps: int | None = None  # control steps of all episodes
    usual_steps: int | None = None  # of an episode: the median
    short_steps: int | None = None  # nine of ten episodes have more
    idle: Knobs | None = None  # of `data.idle`; None: no rule
    about: tuple[str, ...] = ()  # what a person should know of it
    extra: str = ""  # of this package, that reads it


def idle_rule(*, has_velocities: bool) -> Knobs:
    """Return the section of `data.idle`: by the commanded velocities if there are any."""
    return {"rule": Knob("commands" if has_velocities else "motion", "pauses teach nothing")}
