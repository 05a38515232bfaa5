"""The messages between page and server: requests in JSON; answers with a header in JSON, and images behind it."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from jaxtyping import UInt8
from numpy import ndarray
from pydantic import Field

from vjepa2_ac.errors import InputError
from vjepa2_ac.media.images import encode_jpeg
from vjepa2_ac.spaces import Space
from vjepa2_ac.storage.structured import plain, record_of

MOST_BYTES = 1 << 16  # of a request
MOST_STEPS = 16  # of a path: as many as the released model was trained on
_QUALITY = 90

Number = Annotated[float, Field(allow_inf_nan=False)]
Action = Annotated[list[Number], Field(max_length=64)]
Index = Annotated[int, Field(ge=0, le=1 << 40)]


@dataclass(frozen=True)
class GoalFrame:
    """The frame of an episode that is to be reached."""

    episode: Index
    step: Index  # control step


@dataclass(frozen=True)
class PageRequest:
    """What a page asks for; which of the fields count depends on the kind."""

    seq: Index
    kind: Literal["episode", "look", "energy", "plan"]
    episode: Index = 0
    start: Index = 0  # control step of the given frame
    actions: Annotated[list[Action], Field(max_length=MOST_STEPS)] = field(default_factory=list)
    goal: GoalFrame | None = None
    teller: Annotated[str, Field(max_length=200)] = ""  # whose energy it is
    action: Action = field(default_factory=list)  # around which it is shown
    steps: Annotated[int, Field(ge=1, le=8)] = 1  # of a plan


def read_request(text: str | bytes) -> PageRequest:
    """Return a request.

    Raises:
        InputError: It is none.
    """
    try:
        values = json.loads(text)
    except (ValueError, RecursionError):
        raise InputError(where="request", found="no JSON", needed="what explore's own page sends") from None
    return record_of(PageRequest, values, where="request", needed="what explore's own page sends")


@dataclass(frozen=True)
class Image:
    """A picture of an answer."""

    name: str
    pixels: UInt8[ndarray, "height width 3"]
    alt: str  # what it shows, in words


def packed(kind: str, seq: int | None, values: dict[str, Any], images: Sequence[Image] = ()) -> bytes:
    """Return an answer: the length of the header in 4 bytes, the header, and the images as JPEG.

    Args:
        kind: Of the answer.
        seq: Of its request; None: there was none.
        values: The rest of the header; numbers that are not finite become null.
        images: What follows it.
    """
    jpegs = [encode_jpeg(one.pixels, quality=_QUALITY) for one in images]
    about = [{"name": one.name, "bytes": len(data), "alt": one.alt} for one, data in zip(images, jpegs, strict=True)]
    text = json.dumps(plain({"kind": kind, "seq": seq, "images": about, **values}), allow_nan=False).encode()
    return b"".join([len(text).to_bytes(4, "big"), text, *jpegs])


def shown_units(space: Space) -> list[dict[str, Any]]:
    """Return, for each number of a state or an action: its name and unit, and the unit and factor for people."""
    shown = {"m": ("cm", 100.0), "rad": ("°", 180 / math.pi)}
    units = [(name, unit, *shown.get(unit, (unit, 1.0))) for name, unit in zip(space.names, space.units, strict=True)]
    return [dict(zip(("name", "unit", "shown_unit", "factor"), one, strict=True)) for one in units]
