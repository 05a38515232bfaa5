"""The split of each episode: training, validation or test, by a hash of its identity, or of its group's name."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, UInt64

from vjepa2_ac.config import DataConfig
from vjepa2_ac.config.data import Split

_FEWEST_GROUPS = 3  # one for each split


def in_split(
    split_hash: UInt64[np.ndarray, " episodes"],
    config: DataConfig,
    split: Split,
    among: Bool[np.ndarray, " episodes"] | None = None,
) -> Bool[np.ndarray, " episodes"]:
    """Return which episodes belong to a split.

    The hash, as a number in [0, 1), is compared with the shares. Where that leaves validation or test without any,
    as may happen to few episodes, though its share is above 0, the one whose number comes next moves there.

    Args:
        split_hash: Of each episode's identity; with `data.split_by`, of the name of its group.
        config: The shares.
        split: Which split.
        among: Which of them are split, None: all. The split of one depends on the others where these are few: so they
            are the same throughout a run, with those that are broken or left out by `data.exclude`.
    """
    number = split_hash.astype(np.float64) / 2**64
    test, held_out = _bounds(np.unique(number if among is None else number[among]), config)
    low, high = {"test": (0.0, test), "validation": (test, held_out), "train": (held_out, 2.0)}[split]
    return np.asarray((number >= low) & (number < high) & (True if among is None else among))


def _bounds(groups: Float[np.ndarray, " groups"], config: DataConfig) -> tuple[float, float]:
    """Return the numbers below which a group is of test, and of test or validation; `groups` has all, sorted."""
    test, held_out = config.test_share, config.test_share + config.validation_share
    if len(groups) < _FEWEST_GROUPS:
        return test, held_out
    if config.test_share > 0 and not (groups < test).any():
        test = _just_above(groups[0])
    held_out = max(test, held_out)
    left = groups[groups >= test]
    if config.validation_share > 0 and len(left) > 1 and not (left < held_out).any():
        held_out = _just_above(left[0])
    return test, held_out


def _just_above(number: float) -> float:
    return float(np.nextafter(number, 2.0))
