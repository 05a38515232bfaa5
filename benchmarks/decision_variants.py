"""Names of the variants that compute a decision, and the difference between two decisions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from vjepa2_ac.planning.planner import Plan

PLAIN, OFFICIAL, COMPILED, ADAPTER = "plain", "official", "+compiled", "+adapter"
_OURS = "ours/"
_ACTION_TOLERANCE = 1e-5  # metres, radians, gripper position
_ENERGY_TOLERANCE = 1e-4  # relative to the largest energy


class Variant(NamedTuple):
    """A variant of computing a decision: plain, official, or this package with a batch size."""

    name: str
    at_once: int  # samples per call of the predictor

    @classmethod
    def ours(cls, at_once: int, *, compiled: bool = False, adapter: bool = False) -> Variant:
        """Return the variant of this package with a batch size; optionally with compiled blocks or with an adapter."""
        return cls(f"{_OURS}{at_once}{ADAPTER * adapter}{COMPILED * compiled}", at_once)

    @property
    def has_adapter(self) -> bool:
        """Whether the model has an adapter."""
        return ADAPTER in self.name

    @property
    def settings(self) -> dict[str, str]:
        """The keys of `planning` that belong to the variant."""
        return {"compile": "blocks" if self.name.endswith(COMPILED) else "off"}


@dataclass(frozen=True)
class Difference:
    """The difference between two plans."""

    actions: float  # largest absolute difference of a component of an action
    energies: float | None  # largest difference of the elites' energies, relative to the largest energy; None: unknown

    @classmethod
    def between(cls, ours: Plan, other: Plan | Tensor) -> Difference:
        """Return the difference from another plan, or from the actions of another plan."""
        if isinstance(other, Tensor):
            return cls(float((ours.actions - other).abs().max()), None)
        energies, other_energies = (
            torch.cat([iteration.elite_energies for iteration in plan.iterations]) for plan in (ours, other)
        )
        return cls(
            actions=float((ours.actions - other.actions).abs().max()),
            energies=float((energies - other_energies).abs().max() / energies.max()),
        )

    def __str__(self) -> str:
        energies = "" if self.energies is None else f", energies by at most {self.energies:.1g} of the largest energy"
        return f"actions differ by at most {self.actions:.1g}{energies}"

    @property
    def is_rounding(self) -> bool:
        """Whether rounding explains the difference."""
        return self.actions <= _ACTION_TOLERANCE and (self.energies or 0.0) <= _ENERGY_TOLERANCE
