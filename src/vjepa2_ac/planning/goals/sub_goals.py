"""Sub-goals: goal images with the rule by which each gives way to the next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from vjepa2_ac.errors import InputError

GripperMode = Literal["rounded", "free", "held", "open", "close"]


@dataclass(frozen=True, eq=False)
class SubGoal:
    """A goal image, how long it applies, and what the gripper may do meanwhile.

    Raises:
        InputError: The numbers contradict each other.
    """

    image: np.ndarray  # RGB, height x width x 3, uint8; checked where it is used
    name: str = ""
    at_least: int = 1  # model steps
    at_most: int | None = None  # likewise; None: no bound, and always of the last goal
    share: float | None = None  # the next goal follows below this share of the energy at the beginning; None: by count
    gripper: GripperMode | None = None  # None: planning.limits.gripper_mode
    floor: float = 0.0  # noise of camera and encoder: no threshold is below this energy

    def __post_init__(self) -> None:
        if self.at_least < 1 or (self.at_most is not None and self.at_most < self.at_least):
            found = f"at least {self.at_least} and at most {self.at_most} steps"
            raise InputError(where=self._where, found=found, needed="1 <= at_least <= at_most")
        if self.share is not None and not 0.0 < self.share < 1.0:
            raise InputError(where=self._where, found=f"share {self.share}", needed="a number between 0 and 1, or none")
        if not 0.0 <= self.floor < np.inf:
            raise InputError(where=self._where, found=f"a noise floor of {self.floor}", needed="an energy of 0 or more")

    @property
    def _where(self) -> str:
        return f"goal {self.name!r}" if self.name else "goal"
