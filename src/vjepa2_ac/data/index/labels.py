"""Labels of episodes in a data set, such as scene or task: short names, a few bytes per episode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int32

_MISSING = -1


@dataclass(frozen=True, eq=False)
class Labels:
    """One name for each episode, as an index into a list of all names."""

    names: tuple[str, ...]
    number: Int32[np.ndarray, " episodes"]  # into the names; -1: unknown

    def __post_init__(self) -> None:
        """Refuse numbers without a name, which a damaged file may contain."""
        if len(self.number) and not _MISSING <= self.number.min() <= self.number.max() < len(self.names):
            raise ValueError(f"labels of {len(self.names)} names with numbers up to {self.number.max()}")

    @classmethod
    def of(cls, values: Sequence[str | None]) -> Labels:
        """Make labels; None or an empty name: unknown."""
        names = sorted({value for value in values if value})
        place = {name: number for number, name in enumerate(names)}
        return cls(tuple(names), np.array([place.get(value or "", _MISSING) for value in values], np.int32))

    def of_episode(self, index: int) -> str | None:
        """Return the name of one episode, or None if unknown."""
        number = int(self.number[index])
        return None if number == _MISSING else self.names[number]


def labels_of(values: Sequence[Mapping[str, str | None]]) -> dict[str, Labels]:
    """Return the labels of episodes, each given as {label: name}; unused labels are dropped."""
    every = {label for of_one in values for label in of_one}
    found = {label: Labels.of([of_one.get(label) for of_one in values]) for label in sorted(every)}
    return {label: labels for label, labels in found.items() if labels.names}
