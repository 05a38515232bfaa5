"""Metrics of predictions: METRICS is the one list that tables, report, metrics.json, verdict and comparison take.

A metric is of layer-normalised latents, of which the cosine distance is half of L2: so that is no metric of its own.
PyTorch is not imported.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from vjepa2_ac.distances import absolute_difference, squared_difference
from vjepa2_ac.intervals import Estimate

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class Metric:
    """A measure of predictions, of positive numbers: they are shown as ratios to those of persistence."""

    name: str  # in metrics.json
    label: str  # in tables and sentences
    explanation: str
    of: Callable[[Tensor, Tensor], Tensor]  # predicted and true [batch time tokens dim] -> [batch time]
    smaller_is_better: bool = True

    @property
    def heading(self) -> str:
        """The label, and which way is better if that is not the usual one."""
        return self.label if self.smaller_is_better else f"{self.label} (larger is better)"

    def side(self, of_ratio: Estimate) -> int:
        """Return 1 or -1 if the whole interval of a ratio of two results is better or worse than 1, else 0."""
        return of_ratio.side(of=1.0) * (-1 if self.smaller_is_better else 1)


def _l1(predicted: Tensor, true: Tensor) -> Tensor:
    return absolute_difference(predicted, true).mean(dim=(2, 3))


def _l2(predicted: Tensor, true: Tensor) -> Tensor:
    return squared_difference(predicted, true).mean(dim=(2, 3))


L1 = Metric("l1", "L1", "mean absolute difference", _l1)
L2 = Metric("l2", "L2", "mean squared difference", _l2)

METRICS: tuple[Metric, ...] = (L1, L2)  # L1, which models are trained on, comes first: the others stand beside it
