"""What was found: in a data set, as values of a config with their reasons; and on this machine."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from vjepa2_ac import storage
from vjepa2_ac.config.loading import yaml_line
from vjepa2_ac.training.cost.memory import GIGABYTE, USUAL_GPU

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


@dataclass(frozen=True)
class Machine:
    """What a run may use."""

    gpu: str | None
    gpu_bytes: int  # of a usual one, where there is none
    has_bf16: bool  # the GPU
    cores: int
    free_bytes: int  # of the disk where runs and caches go
    flops: float | None = None  # operations a second of the GPU's products, measured

    @property
    def precision(self) -> Literal["bf16", "fp16", "fp32"]:
        """In what it computes best: on a CPU without instructions for it bf16 is many times slower than fp32."""
        if self.gpu is None:
            return "fp32"
        return "bf16" if self.has_bf16 else "fp16"

    @property
    def room(self) -> str:
        """The memory that a batch has to fit on."""
        return f"{self.gpu_bytes / GIGABYTE:.1f} GB" + ("" if self.gpu else ", a usual GPU's")

    @property
    def about(self) -> str:
        """It in a line."""
        size = f"{self.gpu_bytes / GIGABYTE:.1f} GB"
        gpu = f"{self.gpu}, {size}" if self.gpu else "no GPU"
        return f"{gpu}; {self.cores} cores; {self.free_bytes / GIGABYTE:.0f} GB of disk free"


def duration(hours: float) -> str:
    """Return a time for people: hours, or minutes."""
    if hours >= 1:
        return f"about {hours:,.1f} hours"
    minutes = max(1, round(60 * hours))
    return f"about {minutes} minute{'s' if minutes > 1 else ''}"


def this_machine() -> Machine:
    """Return what this machine has."""
    import torch

    from vjepa2_ac.distributed.device import cuda_index, has_bf16, matmul_speed

    cores, free = len(os.sched_getaffinity(0)), storage.free_bytes(Path.cwd())
    if not torch.cuda.is_available():
        return Machine(None, USUAL_GPU, False, cores, free)
    device = torch.device("cuda", cuda_index())
    card, dtype = torch.cuda.get_device_properties(device), torch.bfloat16 if has_bf16() else torch.float16
    return Machine(card.name, card.total_memory, has_bf16(), cores, free, matmul_speed(device, dtype))
