"""Film and FilmRow: frames of one start side by side, each known as given, recorded, decoded, imagined or simulated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from jaxtyping import UInt8

FrameKind = Literal["recorded", "decoded", "imagined", "simulated", "difference"]
"""What a frame is: of a camera; decoded from a recorded frame's latents; decoded from predicted latents; rendered by
the simulator; the difference of two frames."""


@dataclass(frozen=True, eq=False)
class FilmRow:
    """Frames of one source, one for each column of the film from `start` on.

    Raises:
        ValueError: No frames, no label, frames that are not RGB bytes, or numbers that do not fit them.
    """

    label: str  # such as "LoRA: up"
    frames: UInt8[np.ndarray, "time height width 3"]
    kind: FrameKind  # of the frames after the given ones
    given: int  # how many first frames were given to the model, not predicted by it
    given_kind: FrameKind = "recorded"  # of these: "decoded" where they too went through the decoder
    start: int = 0  # the column of the first frame
    captions: tuple[str, ...] | None = None  # a short text for each frame; None: those of the film

    def __post_init__(self) -> None:
        where, count = f"row '{self.label}'", len(self.frames)
        if not self.label.strip():
            raise ValueError("a row of a film has no label")
        if self.frames.ndim != 4 or self.frames.shape[3] != 3 or self.frames.dtype != np.uint8:
            raise ValueError(
                f"{where}: {self.frames.dtype} of shape {self.frames.shape}; frames are uint8 (time, height, width, 3)"
            )
        if 0 in self.frames.shape:
            raise ValueError(f"{where}: no frames (shape {self.frames.shape})")
        if not 0 <= self.given <= count:
            raise ValueError(f"{where}: {self.given} given frames of {count}")
        if self.start < 0:
            raise ValueError(f"{where}: starts in column {self.start}")
        if self.captions is not None and len(self.captions) != count:
            raise ValueError(f"{where}: {len(self.captions)} captions for {count} frames")

    @property
    def end(self) -> int:
        """The column after the last frame's."""
        return self.start + len(self.frames)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of a frame."""
        return self.frames.shape[1], self.frames.shape[2]

    def frame_at(self, column: int) -> UInt8[np.ndarray, "height width 3"] | None:
        """Return the frame in a column of the film; None: the row has none there."""
        return self.frames[column - self.start] if self.start <= column < self.end else None

    def caption_at(self, column: int) -> str:
        """Return the row's own caption in a column; empty: it has none there."""
        return self.captions[column - self.start] if self.captions and self.start <= column < self.end else ""

    def is_given(self, column: int) -> bool:
        """Return whether the frame in a column was given to the model."""
        return self.start <= column < self.start + self.given

    def kind_at(self, column: int) -> FrameKind:
        """Return what the frame in a column is."""
        return self.given_kind if self.is_given(column) else self.kind


@dataclass(frozen=True, eq=False)
class Film:
    """Rows of frames that start together; frames of one column belong to one time.

    Raises:
        ValueError: No rows, frames of different sizes, a row beyond the last column, or numbers that do not fit.
    """

    title: str
    rows: tuple[FilmRow, ...]
    seconds: tuple[float, ...]  # of each column, from the start, increasing: 0.0, 0.27, ...
    captions: tuple[str, ...] = ()  # for each column: the action that led to it; empty: none

    def __post_init__(self) -> None:
        if not self.rows:
            raise ValueError(f"film '{self.title}': no rows")
        first = self.rows[0]
        for row in self.rows:
            if row.size != first.size:
                raise ValueError(
                    f"film '{self.title}': frames of {row.size} pixels in row '{row.label}', of {first.size} in"
                    f" '{first.label}'; resize them to one size"
                )
            if row.end > len(self.seconds):
                raise ValueError(
                    f"film '{self.title}': row '{row.label}' has a frame in column {row.end - 1};"
                    f" there are {len(self.seconds)} times"
                )
        if any(not earlier < later for earlier, later in pairwise(self.seconds)):
            raise ValueError(f"film '{self.title}': times that do not increase: {self.seconds}")
        if self.captions and len(self.captions) != len(self.seconds):
            raise ValueError(
                f"film '{self.title}': {len(self.captions)} captions for {len(self.seconds)} columns;"
                " the first, to which no action led, is ''"
            )

    @property
    def kinds(self) -> tuple[FrameKind, ...]:
        """What its frames are, each once, in order of appearance."""
        return tuple(dict.fromkeys(row.kind_at(column) for row in self.rows for column in range(row.start, row.end)))

    @property
    def is_captioned(self) -> bool:
        """Whether any frame has a text."""
        return any(self.captions) or any(any(row.captions or ()) for row in self.rows)

    @property
    def columns(self) -> int:
        """The number of times at which any row has a frame."""
        return max(row.end for row in self.rows)

    def with_row(self, row: FilmRow) -> Film:
        """Return the film with one more row, the last."""
        return replace(self, rows=(*self.rows, row))


def even_columns(count: int, most: int) -> Sequence[int]:
    """Return at most `most` of `count` columns, the first and the last among them, evenly spread."""
    return [int(column) for column in np.unique(np.linspace(0, count - 1, num=min(count, most)).round())]
