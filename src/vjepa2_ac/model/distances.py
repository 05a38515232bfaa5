"""Distances between latents, number by number: the loss, the energy of a plan and the evaluation take means of them.

Both are computed in float32. PyTorch is not imported.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jaxtyping import Float

if TYPE_CHECKING:
    from torch import Tensor


def absolute_difference(
    predicted: Float[Tensor, "*predicted dim"], true: Float[Tensor, "*true dim"]
) -> Float[Tensor, "*broadcast dim"]:
    """Return the size of each difference: its mean is the L1 distance."""
    return (predicted.float() - true.float()).abs()


def squared_difference(
    predicted: Float[Tensor, "*predicted dim"], true: Float[Tensor, "*true dim"]
) -> Float[Tensor, "*broadcast dim"]:
    """Return the square of each difference: its mean is the squared L2 distance."""
    return (predicted.float() - true.float()).square()
