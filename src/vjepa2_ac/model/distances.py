"""Elementwise distances between latents, whose means are losses, energies and evaluation metrics.

The distances are computed in float32. This module does not import PyTorch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jaxtyping import Float

if TYPE_CHECKING:
    from torch import Tensor


def absolute_difference(
    predicted: Float[Tensor, "*predicted dim"], true: Float[Tensor, "*true dim"]
) -> Float[Tensor, "*broadcast dim"]:
    """Return the absolute difference of each element; its mean is the L1 distance."""
    return (predicted.float() - true.float()).abs()


def squared_difference(
    predicted: Float[Tensor, "*predicted dim"], true: Float[Tensor, "*true dim"]
) -> Float[Tensor, "*broadcast dim"]:
    """Return the squared difference of each element; its mean is the mean squared error."""
    return (predicted.float() - true.float()).square()
