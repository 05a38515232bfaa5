"""Check that every weight is finite, when weights are loaded and before they are saved."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from vjepa2_ac.errors import InputError


def first_not_finite(tensors: Mapping[str, Tensor]) -> str | None:
    """Return the name of the first tensor that holds NaN or infinity; None if there is none.

    Minimum and maximum show it in one pass, without extra memory: a second for a thousand million numbers.
    """
    for name, value in tensors.items():
        if value.is_floating_point() and value.numel() and not torch.stack(torch.aminmax(value)).isfinite().all():
            return name
    return None


def require_finite(tensors: Mapping[str, Tensor], *, where: str, fix: str) -> None:
    """Refuse tensors that hold NaN or infinity.

    Args:
        tensors: By name.
        where: Their owner, for messages.
        fix: How to fix it, as a sentence.

    Raises:
        InputError: Names the first such tensor.
    """
    name = first_not_finite(tensors)
    if name is not None:
        raise InputError(where=where, found=f"{name} holds NaN or infinity", needed="finite weights", fix=fix)
