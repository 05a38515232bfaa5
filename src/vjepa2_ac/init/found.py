"""What was found in a data set: the record that a config is made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vjepa2_ac.init.knob import Knob, Knobs


@dataclass(frozen=True)
class FoundData:
    """A data set, as far as its descriptions tell."""

    source: Literal["rlds", "lerobot", "npz", "droid_raw"]
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
    sample: str = ""  # one of its large files
