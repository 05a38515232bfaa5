"""Rewrite golden files in Meta's format with changes, and compare tensors up to rounding."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor


def rewrite(path: Path, change: Callable[[dict[str, Any]], Any], target: Path) -> Path:
    """Write the content of a file to `target`, after `change` modified it in place or returned new content."""
    content = torch.load(path, weights_only=True)
    changed = change(content)
    torch.save(content if changed is None else changed, target)
    return target


def assert_equal_to_rounding(actual: Tensor, expected: Tensor) -> None:
    """Check that all differences are below 1e-5 of the largest value: float32 rounding of sums in another order."""
    assert actual.shape == expected.shape
    assert (actual - expected).abs().max() <= 1e-5 * expected.abs().max()
