"""Meta's files among the golden ones: written again with changes, and compared up to rounding."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor


def rewrite(path: Path, change: Callable[[dict[str, Any]], Any], target: Path) -> Path:
    """Write a file again, changed by a function of what is in it; return the new file."""
    whole = torch.load(path, weights_only=True)
    changed = change(whole)
    torch.save(whole if changed is None else changed, target)
    return target


def assert_equal_to_rounding(found: Tensor, expected: Tensor) -> None:
    """Within 1e-5 of the largest value: fp32 rounding of sums in another order."""
    assert found.shape == expected.shape
    assert (found - expected).abs().max() <= 1e-5 * expected.abs().max()
