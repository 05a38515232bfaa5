"""Variants of computing a decision, and the difference between two decisions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from vjepa2_ac.planning.planner import Plan

PLAIN, OFFICIAL, COMPILED, ADAPTER = "plain", "official", "+compiled", "+adapter"
_OURS = "ours/"
_SAME_ACTIONS = 1e-5  # metres, and of the gripper
_SAME_ENERGIES = 1e-4  # of the largest


class Way(NamedTuple):
    """How a decision is made: plain, official, or ours with so many samples at once."""

    name: str
    at_once: int

    @classmethod
    def ours(cls, at_once: int, *, compiled: bool = False, adapter: bool = False) -> Way:
        """Return ours, perhaps with compiled blocks, or with an adapter on, as a trained run has one."""
        return cls(f"{_OURS}{at_once}{ADAPTER * adapter}{COMPILED * compiled}", at_once)

    @property
    def has_adapter(self) -> bool:
        """Whether an adapter is on."""
        return ADAPTER in self.name

    @property
    def settings(self) -> dict[str, str]:
        """What `planning` says of it."""
        return {"compile": "blocks" if self.name.endswith(COMPILED) else "off"}


@dataclass(frozen=True)
class Difference:
    """How far two plans are apart."""

    actions: float  # the largest of a number of them
    energies: float | None  # of elites, the largest as a share of the largest energy; None where they are not known

    @classmethod
    def between(cls, ours: Plan, other: Plan | Tensor) -> Difference:
        """Compare with a plan, or with mere actions."""
        if isinstance(other, Tensor):
            return cls(float((ours.actions - other).abs().max()), None)
        energies, others = (torch.cat([one.elite_energies for one in plan.iterations]) for plan in (ours, other))
        return cls(
            float((ours.actions - other.actions).abs().max()), float((energies - others).abs().max() / energies.max())
        )

    def __str__(self) -> str:
        energies = "" if self.energies is None else f", energies by {self.energies:.1g} of the largest"
        return f"actions differ by {self.actions:.1g} at most{energies}"

    @property
    def is_none(self) -> bool:
        """Whether it is rounding."""
        return self.actions <= _SAME_ACTIONS and (self.energies or 0.0) <= _SAME_ENERGIES
